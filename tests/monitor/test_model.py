"""The model of the monitor: values by the names of sources, extremes, states and errors.

A value that is not available is None.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated_bus import STEP_NS, Timed, flight, layout_of, with_errors

from kontronik_can_gw.assembly.assemble import assemble
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.desk.member import alarms_of
from kontronik_can_gw.desk.monitor.model import HISTORY_S, Monitor, Track
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.esc.decoder import Severity
from kontronik_can_gw.esc.kontronik.simulator import SECOND_NS
from kontronik_can_gw.esc.kontronik.states import OperatingError, SelfTestError
from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.frames import CanFrame

pytestmark = pytest.mark.promise("monitor")

ONE = layout_of(["esc1"])
TWO = layout_of(["left", "right"])


def id_of(source: str) -> int:
    """Return the id of the message with a source in the shipped DBC."""
    for plan in ONE.layout.messages:
        for signal in plan.signals:
            if signal.source and signal.source.name == source:
                return plan.can_id
    raise KeyError(source)


LINK_ID = id_of("link_state")


def watched(bus: BusLayout, frames: Timed, until: float | None = None) -> Monitor:
    """Return a monitor that has received frames, and whose clock is at ``until`` (s)."""
    monitor = Monitor(bus)
    monitor.advance(0)
    for now, frame in frames:
        monitor.take(frame, now)
        monitor.advance(now)
    if until is not None:
        monitor.advance(round(until * SECOND_NS))
    return monitor


VALUE = st.one_of(st.none(), st.integers(0, 65533), st.integers(-200, 200))
FRAME = st.tuples(st.integers(0, 0x1FFFFFFF), st.binary(max_size=8), st.booleans())


@given(st.lists(VALUE, min_size=1, max_size=30))
@settings(max_examples=50, deadline=None)
def test_extremes_and_availability_are_right_for_any_values(values: list[int | None]) -> None:
    """The frames are packed by cantools. None is sent as NotAvailable."""
    message = ONE.database.get_message_by_name("EscCurrent")
    monitor = Monitor(ONE)
    esc = monitor.escs[0]
    sent: list[float] = []
    for step, value in enumerate(values):
        current = None
        data: dict[str, float | str] = {signal.name: 0 for signal in message.signals}
        data["BatteryCurrent"] = "NotAvailable"
        if value is not None:
            current = max(-3276.0, min(3276.0, value / 10))
            data["BatteryCurrent"] = current
            sent.append(current)
        frame = CanFrame(message.frame_id, message.encode(data))
        monitor.take(frame, step * STEP_NS)
        assert esc.number("battery_current") == pytest.approx(current)
        track = esc.tracks["battery_current"]
        if sent:
            assert track.low == pytest.approx(min(sent))
            assert track.high == pytest.approx(max(sent))
        else:
            assert track.low is None
            assert track.high is None
    monitor.reset()
    track = esc.tracks["battery_current"]
    assert track.low is None
    assert track.high is None
    assert list(track.history) == []


@given(st.lists(FRAME, max_size=40), st.data())
@settings(max_examples=50, deadline=None)
def test_any_frames_are_accepted_without_an_exception(
    frames: Sequence[tuple[int, bytes, bool]], data: st.DataObject
) -> None:
    """The frames have foreign ids, short data and any bits, and their times jump."""
    monitor = Monitor(ONE)
    ids = sorted(key for key in monitor.view.reader.keys)
    for number, content, known in frames:
        can_id = ids[number % len(ids)] if known else number
        now = data.draw(st.integers(0, 10 * SECOND_NS))
        monitor.take(CanFrame(can_id, content, can_id > 0x7FF, remote=number % 7 == 0), now)
        monitor.advance(now)
        json.dumps(monitor.document(), allow_nan=False)
        for esc in monitor.escs:
            assert not any(isinstance(esc.value(source), bool) for source in esc.units)
            for track in esc.tracks.values():
                check_track(track)


def check_track(track: Track) -> None:
    assert len(track.history) <= HISTORY_S
    if track.low is None:
        assert track.high is None
    else:
        assert track.high is not None
        assert track.low <= track.high


def test_old_values_are_not_shown_after_the_last_frame() -> None:
    frames = flight(ONE, 2)
    monitor = watched(ONE, frames)
    assert monitor.escs[0].number("battery_voltage") is not None
    assert monitor.escs[0].state is not None
    monitor.advance(7 * SECOND_NS)
    esc = monitor.escs[0]
    assert all(esc.value(source) is None for source in esc.units)
    assert esc.state is None
    assert esc.link is None
    assert esc.device_text == ""
    assert esc.active == []
    assert monitor.gateway.text("gateway_state") is None
    assert monitor.gateway.text("can_state") is None
    assert monitor.silent_ns >= 5 * SECOND_NS
    assert esc.tracks["battery_voltage"].high is not None, "extremes stay"


def test_history_has_a_value_for_each_second_with_data() -> None:
    """The line is silent after 3.5 s, and the values end with the timeout of telemetry."""
    monitor = watched(ONE, flight(ONE, 6, until=3.5), 7.05)
    history = list(monitor.escs[0].tracks["battery_voltage"].history)
    assert len(history) == 7
    assert all(value is not None and 20 < value < 26 for value in history[:3])
    assert history[4:] == [None] * 3
    monitor.advance(10_000 * SECOND_NS)
    assert list(monitor.escs[0].tracks["battery_voltage"].history) == [None] * HISTORY_S


def test_link_is_not_lost_because_its_message_is_received_later() -> None:
    """An older message with the link state may be received after newer values.

    The next message with the link state is received a cycle later.
    """
    frames = flight(ONE, 3, until=1)
    (esc,) = watched(ONE, frames).escs
    assert esc.number("battery_voltage") is None
    assert normalize(esc.link or "") == "lost"
    lost = [frame for _, frame in frames if frame.can_id == LINK_ID][-1]
    monitor = watched(ONE, flight(ONE, 2))
    monitor.take(lost, 2 * SECOND_NS)
    (esc,) = monitor.escs
    assert esc.number("battery_voltage") is not None
    assert normalize(str(esc.value("link_state"))) == "lost"
    assert normalize(esc.link or "") == "ok"


def test_errors_are_shown_first_and_with_their_meaning() -> None:
    bits = (
        OperatingError.POWER_STAGE_OVERTEMP_WARNING,
        OperatingError.UNDERVOLTAGE,
        OperatingError.OPERATING_ERROR_FOUND,
        OperatingError.PROGRAMMING_ALLOWED,
        SelfTestError.TEST_EEPROM_EMPTY,
    )
    (esc,) = watched(ONE, flight(ONE, 3, [with_errors(*bits)])).escs
    assert {active.text for active in esc.active} == {bit.text for bit in bits}
    alarms = alarms_of(esc.active)
    assert [(active.text, active.severity) for active in alarms] == [
        ("undervoltage", Severity.ERROR),
        ("test_eeprom_empty", Severity.ERROR),
        ("power_stage_overtemp_warning", Severity.WARNING),
    ]
    assert alarms[0].meaning == OperatingError.UNDERVOLTAGE.meaning
    assert alarms[0].remedy == OperatingError.UNDERVOLTAGE.remedy


USERS_DBC = """VERSION ""
NS_ :
BS_:
BU_: Gw
BO_ 2566844672 Main: 8 Gw
 SG_ PackVolt : 0|16@1+ (1,0) [0|65533] "mV" Gw
 SG_ StageTemp : 16|16@1+ (0.1,0) [0|6553.3] "K" Gw
 SG_ ErrorWord : 32|32@1+ (1,0) [0|4294967293] "" Gw
BO_ 257 Other: 8 Gw
 SG_ Zustand : 0|8@1+ (1,0) [0|253] "" Gw
 SG_ Zellen : 8|8@1+ (1,0) [0|253] "" Gw
BA_DEF_ BO_  "GenMsgCycleTime" INT 0 65535;
BA_DEF_DEF_  "GenMsgCycleTime" 20;
"""


def test_users_dbc_with_other_names_and_units_shows_the_same(tmp_path: Path) -> None:
    """The DBC also has a 29-bit id."""
    (tmp_path / "car.dbc").write_text(USERS_DBC)
    bind = {
        "PackVolt": "battery_voltage",
        "StageTemp": "power_stage_temperature",
        "ErrorWord": "operating_errors",
        "Zustand": "operating_state",
        "Zellen": "cell_count",
    }
    dbc = {"file": str(tmp_path / "car.dbc"), "bind": bind}
    tables = {"dbc": dbc, "esc": [{"port": "/dev/ttyX"}]}
    loaded = assemble(parse(tables, str(tmp_path / "c.toml")))
    assert loaded.database is not None
    users = BusLayout(loaded.database, loaded.layout, loaded.escs, loaded.config)
    monitor = Monitor(users)
    (esc,) = monitor.escs
    word = 1 << int(OperatingError.UNDERVOLTAGE) | 1 << 30
    main = users.database.get_message_by_name("Main")
    data = main.encode({"PackVolt": 22200, "StageTemp": 333.2, "ErrorWord": word})
    monitor.take(CanFrame(main.frame_id, data, extended=True), STEP_NS)
    assert not monitor.is_complete
    monitor.take(CanFrame(257, bytes((26, 6, 0, 0, 0, 0, 0, 0))), 2 * STEP_NS)
    assert monitor.is_complete
    assert esc.number("battery_voltage") == 22.2
    assert esc.number("power_stage_temperature") == pytest.approx(60.05)
    assert esc.tracks["battery_voltage"].low == 22.2
    assert esc.state == "RPMControl"
    assert [(active.text, active.severity) for active in alarms_of(esc.active)] == [
        ("undervoltage", Severity.ERROR),
        ("bit30", Severity.WARNING),
    ]
    assert not esc.has("motor_speed")
    assert esc.number("motor_speed") is None
    assert esc.link is None
    assert monitor.document()["units"]["battery_voltage"] == "V"
