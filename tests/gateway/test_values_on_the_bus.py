"""What a message holds at a known time, from bytes to bits: values that are easily taken for others."""

import pytest

from kontronik_can_gw.dbc_output.layout import DbcSettings, parse_database
from kontronik_can_gw.dbc_output.prepare import prepare
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.protocol import Device, InfoData, Layout, LiveData, encode
from kontronik_can_gw.protocol.fields import device_and_variant
from kontronik_can_gw.telemetry import INFO_TIMEOUT_NS, MS, SECOND, EscSettings

HEAD = 'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: Gw Car\n\nBO_ 256 M: 8 Gw\n'
PERIOD = 10 * MS


class Bench:
    """One message that follows each live frame, of a gateway that reads each frame whole."""

    def __init__(self, signals: str, tables: str = "") -> None:
        esc = EscSettings("esc1")
        text = f"{HEAD}{signals}\n{tables}"
        layout = prepare(parse_database(text.encode(), "t.dbc"), "t.dbc", (esc,), DbcSettings(), fd_allowed=False)[1]
        self.gateway = Gateway((esc,), layout, 0)
        self.now = 0
        self.gateway.start(0)

    def live(self, **values: int) -> int:
        """A period later a live frame comes; what the message holds then."""
        return self._read(encode(LiveData(**values), Layout.V4))

    def info(self, device: Device) -> None:
        self._read(encode(InfoData(device_and_variant=device_and_variant(device, 120), cell_count=6), Layout.V4))

    def _read(self, data: bytes) -> int:
        self.now += PERIOD
        self.gateway.advance(self.now)
        self.gateway.receive_bytes(0, data, self.now, self.now)
        self.gateway.advance(self.now)
        self.gateway.take_frames()
        return self.gateway.message_bits(0, self.now)


BEC_CURRENT = ' SG_ BecCurrent : 0|16@1+ (0.01,0) [0|655] "A" Car\n'
NO_BEC_CURRENT = 0xFFFF


@pytest.mark.parametrize(("device", "then"), [(Device.JIVEPRO, NO_BEC_CURRENT), (Device.KOSMIK, 5)])
def test_a_jivepros_bec_current_stays_unavailable_when_its_information_has_expired(device: Device, then: int) -> None:
    bench = Bench(BEC_CURRENT)
    bench.info(device)
    assert bench.live(bec_current=50) & 0xFFFF == then
    end = bench.now + INFO_TIMEOUT_NS + SECOND
    while bench.now < end:
        assert bench.live(bec_current=50) & 0xFFFF == then
    assert bench.gateway.escs[0].info is None


def test_energy_is_what_was_drawn_between_two_frames_and_nothing_that_was_fed_back() -> None:
    bench = Bench(' SG_ EnergyUsed : 0|32@1+ (0.001,0) [0|4000000] "Wh" Car\n')
    steps = [(2400, 1000), (2400, 1000), (2000, -500), (2000, -500), (0, 1000), (2400, 0), (1000, 3000)]
    drawn = 0  # 10 mV times 0.1 A times a period of 10 ms
    for n in range(7 * 400):
        voltage, current = steps[n % 7]
        bits = bench.live(battery_voltage=voltage, battery_current=current)
        wh = drawn / 1000 / 100 / 3600
        assert abs((bits & 0xFFFFFFFF) - wh * 1000) <= 1
        drawn += max(0, voltage * current)
    assert drawn / 1000 / 100 / 3600 > 8


@pytest.mark.parametrize(("throttle", "raw"), [(99, 99), (100, 101), (101, 101), (102, 102)])
def test_a_value_that_equals_the_code_for_not_available_is_sent_as_the_error_code(throttle: int, raw: int) -> None:
    bench = Bench(
        ' SG_ PwmInput : 0|16@1+ (1,0) [0|65535] "us" Car\n', 'VAL_ 256 PwmInput 100 "NotAvailable" 101 "Error" ;\n'
    )
    assert bench.gateway.message_bits(0, 0) & 0xFFFF == 100, "before the first frame"
    assert bench.live(pwm_input=throttle) & 0xFFFF == raw
