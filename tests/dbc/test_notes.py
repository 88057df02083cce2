"""What is said of a signal that cannot carry all that its source gives: states, codes."""

import pytest
from dbc_bench import compiled
from packer_oracle import Msg, Sig, dbc_text

CODES = {255: "NotAvailable", 254: "Error"}
NO_NAMES = "the value table has no name of it: sent as the ESC's number"


def volts(length: int, factor: str, **more: object) -> Sig:
    return Sig("BatteryVoltage", 0, length, **{"factor": factor, "unit": "V"} | more)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("signal", "expected"),
    [
        (volts(16, "0.01"), ["not available is sent as 655.35"]),
        (volts(17, "0.01"), ["not available is sent as 1310.71"]),
        (volts(16, "0.01", texts={65535: "NotAvailable", 65534: "Error"}), []),
        (volts(32, "1", signed=True, is_float=True), []),
        (Sig("CrcErrors", 0, 8, texts=CODES), ["starts again at 0 after 253"]),
        (Sig("CrcErrors", 0, 8, maximum="99"), ["starts again at 0 after 99"]),
        (Sig("OperatingState", 0, 8), [NO_NAMES, "not available is sent as 255"]),
        (Sig("OperatingState", 0, 8, texts={1: "Asleep"} | CODES), [NO_NAMES]),
        (Sig("LinkState", 0, 8, texts={9: "Ok", 8: "LOST", 7: "Searching", 6: "never_seen"} | CODES),
         ["sent as Error, not in the value table: Degraded, PortError"]),
        (Sig("Undervoltage", 0, 1), ["not available is sent as 0"]),
        # a source without names leaves a value table alone
        (Sig("CellCount", 0, 8, texts={0: "unknown", 6: "six"} | CODES), []),
    ],
    ids=lambda value: value.line if isinstance(value, Sig) else "",
)  # fmt: skip
def test_what_a_signal_cannot_carry_is_noted(signal: Sig, expected: list[str]) -> None:
    layout = compiled(dbc_text([Msg("EscPower", 0x100, 8, [signal])]))
    assert list(layout.messages[0].signals[0].notes) == expected
