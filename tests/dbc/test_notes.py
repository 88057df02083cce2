"""What is said of a signal that cannot carry all that its source gives: resolution, range, states, codes."""

import pytest
from dbc_bench import compiled
from packer_oracle import Msg, Sig, dbc_text

CODES = {255: "NotAvailable", 254: "Error"}
SIGNED_CODES = {-128: "NotAvailable", -127: "Error"}
NO_NAMES = "the value table has no name of it: sent as the ESC's number"


def volts(length: int, factor: str, **more: object) -> Sig:
    return Sig("BatteryVoltage", 0, length, **{"factor": factor, "unit": "V"} | more)  # type: ignore[arg-type]


def percent(**more: object) -> Sig:
    return Sig("Throttle", 0, 8, signed=True, unit="%", texts=SIGNED_CODES, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("signal", "expected"),
    [
        # the source: 0 to 655.35 V in steps of 0.01 V
        (volts(16, "0.01"), ["not available is sent as 655.35"]),
        (volts(17, "0.01"), ["not available is sent as 1310.71"]),
        (volts(24, "0.005", texts={0xFFFFFF: "SNA"}), []),
        (volts(16, "0.01", texts={65535: "NotAvailable", 65534: "Error"}), []),
        (volts(16, "0.1", texts={65535: "NotAvailable"}), ["resolution 0.1 V"]),
        (volts(16, "100", texts={65535: "NotAvailable"}, unit="mV"), ["resolution 100 mV"]),
        (volts(16, "0.1", texts={65535: "NotAvailable"}, unit=""), ["resolution 0.1 V"]),
        (volts(8, "0.1", texts=CODES), ["resolution 0.1 V", "range 0 to 25.3 V, beyond it Error"]),
        (
            volts(8, "-0.1", offset="25.5", texts=CODES),
            ["resolution 0.1 V", "range 0.2 to 25.5 V, beyond it Error"],
        ),
        (volts(16, "0.1", offset="10", texts={65535: "SNA"}),
         ["resolution 0.1 V", "range 10 to 6563.4 V, beyond it Error"]),
        # two steps less than the source has cost no more than the two codes
        (volts(16, "0.01", maximum="655.33", texts={65535: "NotAvailable"}), []),
        (volts(16, "0.01", maximum="655.32", texts={65535: "NotAvailable"}),
         ["range 0 to 655.32 V, beyond it Error"]),
        # -128 to 127 % in steps of 1 %
        (percent(), []),
        (percent(minimum="-125", maximum="127"), ["range -125 to 127 %, beyond it Error"]),
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
