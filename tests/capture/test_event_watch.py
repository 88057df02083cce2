"""Events are noticed in the frame that causes them, with both cores."""

from dataclasses import dataclass, field
from typing import Any

import pytest

from kontronik_can_gw.config.keys import RecordConfig
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData
from kontronik_can_gw.esc.kontronik.states import OperatingError, SelfTestError
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.files.event_watch import EventWatch
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.times import MS, SECOND

pytestmark = [
    pytest.mark.promise("events"),
    pytest.mark.parametrize("core_language", ["C", "Python"], indirect=True),
]
START = 100 * SECOND
LIVE = LiveData(**(dict.fromkeys(LiveData._fields, 0) | {"battery_voltage": 2400}))
INFO = InfoData(**(dict.fromkeys(InfoData._fields, 0) | {"device_and_variant": 1 << 10 | 5}))


@dataclass
class Watched:
    """A gateway of two ESCs whose events are collected."""

    config: RecordConfig = field(default_factory=RecordConfig)
    now: int = START
    events: list[tuple[int, str, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        escs = [EscSettings("left"), EscSettings("right")]
        self.gateway = Gateway(CoreSettings(escs, MessageLayout("", "", ())), START)
        EventWatch(self.gateway, self.config, self._event, lambda: 1.0)
        self.gateway.start(START)

    def _event(self, now: int, wall: float, esc: str, reason: str) -> None:
        assert wall == 1.0
        self.events.append((now, esc, reason))

    def frames(self, *data: Any, esc: int = 0, after_ms: int = 10) -> None:
        """Feed frames that arrive in one read."""
        since = self.now
        self.now += after_ms * MS
        wire = b"".join(encode(each, WireLayout.V4) for each in data)
        self.gateway.receive_bytes(esc, wire, self.now, max(since, self.now - 8 * MS))
        self.gateway.advance(self.now)
        self.gateway.take_frames(self.now)

    def live(self, esc: int = 0, errors: int = 0, **values: int) -> None:
        self.frames(LIVE._replace(operating_errors=errors, **values), esc=esc)

    def silent(self, seconds: float) -> None:
        end = self.now + int(seconds * SECOND)
        while self.now < end:
            self.now = min(end, max(self.now + 1, self.gateway.next_deadline()))
            self.gateway.advance(self.now)
            self.gateway.take_frames(self.now)

    def taken(self) -> list[str]:
        found = [f"{esc}: {reason}" for _, esc, reason in self.events]
        self.events.clear()
        return found


UNDERVOLTAGE = 1 << OperatingError.UNDERVOLTAGE
HOT = 1 << OperatingError.POWER_STAGE_OVERTEMP_WARNING
STATUS = 1 << OperatingError.SWITCHED_OFF_BY_RUNNING_DOWN


def test_each_rise_of_an_error_bit_is_an_event() -> None:
    it = Watched()
    it.live()
    it.live(errors=UNDERVOLTAGE)
    assert it.events == [(it.now, "left", "undervoltage")]
    it.taken()
    it.live(errors=UNDERVOLTAGE | HOT)
    it.live(errors=UNDERVOLTAGE | HOT, esc=1)
    assert it.taken() == [
        "left: power_stage_overtemp_warning",
        "right: undervoltage",
        "right: power_stage_overtemp_warning",
    ]
    _steady(it, 1.1)
    it.taken()
    it.live(errors=HOT)
    assert it.taken() == ["left: power_stage_overtemp_warning"]


def test_bit_that_flickers_is_one_event_until_it_is_clear_for_a_second() -> None:
    it = Watched()
    for _ in range(100):
        it.live(errors=UNDERVOLTAGE)
        it.live()
    assert it.taken() == ["left: undervoltage"]
    it.live(errors=UNDERVOLTAGE | HOT)
    assert it.taken() == ["left: power_stage_overtemp_warning"]
    _steady(it, 0.9)
    it.live(errors=UNDERVOLTAGE)
    assert it.taken() == []
    _steady(it, 1.1)
    it.live(errors=UNDERVOLTAGE)
    assert it.taken() == ["left: undervoltage"]


def test_bit_that_is_set_in_one_frame_of_a_read_is_noticed() -> None:
    it = Watched()
    it.live()
    it.frames(LIVE._replace(operating_errors=UNDERVOLTAGE), LIVE)
    assert it.taken() == ["left: undervoltage"]


def test_only_the_chosen_bits_are_events() -> None:
    every = UNDERVOLTAGE | HOT | STATUS | 1 << 30
    for errors, expected in (
        (("error", "warning"), ["undervoltage", "power_stage_overtemp_warning", "bit30"]),
        (("status",), ["switched_off_by_running_down"]),
        (("power_stage_overtemp_warning",), ["power_stage_overtemp_warning"]),
        ((), []),
    ):
        it = Watched(RecordConfig(errors=errors))
        it.live(errors=every)
        assert it.taken() == [f"left: {name}" for name in expected]


def test_self_test_errors_are_events_too() -> None:
    it = Watched()
    it.frames(INFO)
    short = SelfTestError.TEST_SHORT_TO_GROUND
    it.frames(INFO._replace(selftest_errors=1 << short))
    it.frames(INFO._replace(selftest_errors=1 << short))
    assert it.taken() == ["left: test_short_to_ground"]


def test_loss_of_telemetry_and_of_the_port_is_one_event_each() -> None:
    it = Watched()
    it.live()
    it.silent(1)
    assert it.taken() == ["left: telemetry lost"]
    it.silent(10)
    it.live()
    it.gateway.port(0, False, it.now)
    it.gateway.port(0, False, it.now)
    assert it.taken() == ["left: telemetry lost"]


def test_bit_that_stays_set_during_a_loss_is_no_new_event() -> None:
    it = Watched()
    it.live(errors=UNDERVOLTAGE)
    it.silent(1)
    it.live(errors=UNDERVOLTAGE)
    assert it.taken() == ["left: undervoltage", "left: telemetry lost"]


def test_value_that_crosses_its_limit_in_one_frame_is_an_event() -> None:
    it = Watched(RecordConfig(when=("battery_voltage < 20 V", "right.throttle >= 90")))
    it.live()
    it.frames(LIVE._replace(battery_voltage=1999), LIVE)
    assert it.taken() == ["left: battery_voltage < 20 V"]
    it.live(throttle=95)
    it.live(throttle=89, esc=1)
    assert it.taken() == []
    it.live(throttle=90, esc=1)
    assert it.taken() == ["right: throttle >= 90"]


def _steady(it: Watched, seconds: float, **values: int) -> None:
    for _ in range(int(100 * seconds)):
        it.live(**values)


def test_noise_at_a_limit_is_one_event_until_the_value_is_good_for_a_second() -> None:
    it = Watched(RecordConfig(when=("battery_voltage < 20",)))
    it.live()
    for _ in range(100):
        it.live(battery_voltage=1999)
        it.live(battery_voltage=2001)
    assert it.taken() == ["left: battery_voltage < 20"]
    _steady(it, 0.9)
    it.live(battery_voltage=1999)
    assert it.taken() == []
    _steady(it, 1.1)
    it.live(battery_voltage=1999)
    assert it.taken() == ["left: battery_voltage < 20"]


def test_missing_value_is_no_event_and_does_not_arm_a_condition() -> None:
    it = Watched(RecordConfig(when=("battery_voltage < 20",), errors=()))
    it.silent(3)
    assert it.taken() == []
    it.live()
    it.live(battery_voltage=1999)
    it.silent(5)
    it.live(battery_voltage=1999)
    assert it.taken() == ["left: battery_voltage < 20", "left: telemetry lost"]


def test_condition_that_is_met_when_its_value_becomes_known_is_no_event() -> None:
    it = Watched(RecordConfig(when=("battery_voltage < 20",), errors=()))
    _steady(it, 2, battery_voltage=1999)
    assert it.taken() == []
    _steady(it, 1.1)
    it.silent(2)
    assert it.taken() == ["left: telemetry lost"]
    _steady(it, 1, battery_voltage=1500)
    assert it.taken() == [], "the ESC was switched on again"
    _steady(it, 1.1)
    it.live(battery_voltage=1999)
    assert it.taken() == ["left: battery_voltage < 20"]


def test_condition_about_the_link_of_an_esc_that_was_never_heard_is_no_event() -> None:
    it = Watched(RecordConfig(when=("frame_rate < 50", "crc_errors > 5"), errors=()))
    damaged = encode(LIVE, WireLayout.V4)[:-1] + b"x"
    for _ in range(20):
        it.now += 10 * MS
        it.gateway.receive_bytes(0, damaged, it.now, it.now - 8 * MS)
    it.silent(3)
    assert it.gateway.escs[0].counters.crc_errors > 5
    assert it.taken() == []
    _steady(it, 3)
    assert it.taken() == [], "the rate is low until the first second has passed"
    it.silent(3)
    assert sorted(it.taken()) == ["left: frame_rate < 50", "left: telemetry lost"]


@pytest.mark.parametrize(
    ("condition", "change"),
    [
        ("battery_power > 1 kW", {"battery_current": 1000}),
        ("mean_cell_voltage <= 3000 mV", {"battery_voltage": 1800}),
        ("energy_used > 0", {"battery_current": 30000}),
        ("live_frames > 200", {}),
        ("max_battery_voltage > 60", {}),
        ("undervoltage > 0", {"errors": UNDERVOLTAGE}),
    ],
)
def test_values_of_each_kind_can_have_a_condition(condition: str, change: dict[str, int]) -> None:
    it = Watched(RecordConfig(when=(condition,), errors=()))
    it.frames(INFO._replace(cell_count=6))
    _steady(it, 0.5)
    assert it.taken() == []
    _steady(it, 3, **change)
    it.frames(INFO._replace(cell_count=6, max_battery_voltage=6100))
    assert it.taken() == [f"left: {condition}"]


def test_live_frames_reach_python_only_for_conditions_about_them(core_language: str) -> None:
    if core_language == "Python":
        return
    assert Watched().gateway.core.note == ""
    without_live = RecordConfig(when=("max_battery_voltage > 60", "crc_errors > 5"))
    assert Watched(without_live).gateway.core.note == ""
    assert "live frame" in Watched(RecordConfig(when=("throttle > 5",))).gateway.core.note
