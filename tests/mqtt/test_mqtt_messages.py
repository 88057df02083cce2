"""Content and timing of messages, without a broker.

JSON is compared with values that cantools decodes. Discovery follows Home Assistant's rules.
"""

import json
import re
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import pytest
from cantools.database.can import Database
from hypothesis import given, settings
from hypothesis import strategies as st
from packer_oracle import read
from simulated_bus import START_S, STEP_NS, Timed, flight, layout_of, with_errors

from kontronik_can_gw.config.keys import MqttConfig
from kontronik_can_gw.desk.dbc.writer import copies_text
from kontronik_can_gw.desk.mqtt.messages import Publication, Publisher, iso
from kontronik_can_gw.desk.mqtt.published import MIN_PAUSE_NS, Topics
from kontronik_can_gw.desk.receiver.unpacker import SignalReader
from kontronik_can_gw.esc.kontronik.simulator import (
    SECOND_NS,
    ErrorWindow,
    EscOptions,
    Faults,
    Phase,
)
from kontronik_can_gw.esc.kontronik.states import OperatingError, OperatingState, SelfTestError

pytestmark = pytest.mark.promise("mqtt")

TOPICS = Topics("fleet", "boat")
MS = 1_000_000
OWN_KEYS = {
    "time",
    "available",
    "age",
    "motor",
    "errors",
    "problem",
    "selftest",
    "link_state",
    "firmware",
}
"""Keys of the JSON that are not the names of values."""
QUIET = EscOptions(profile=(Phase("off", 1000, 0, OperatingState.MotorOff, 0),))


bus_of = cache(layout_of)


def publisher(*names: str, rate: float = 1, **options: Any) -> Publisher:
    return Publisher(bus_of(names), TOPICS, MqttConfig(rate=rate, **options))


Published = list[tuple[int, Publication]]


def run(
    made: Publisher,
    frames: Timed,
    until_s: float,
    step_ns: int = STEP_NS,
) -> Published:
    """Pass the frames at their times, and collect the messages at each step."""
    published: Published = []
    waiting = list(reversed(frames))
    for now in range(0, round(until_s * SECOND_NS), step_ns):
        while waiting and waiting[-1][0] <= now:
            time_ns, frame = waiting.pop()
            made.take(frame, time_ns)
        wall_ns = START_S * SECOND_NS + now
        for message in made.messages(now, wall_ns):
            published.append((now, message))
    return published


def payloads(published: Published, topic: str) -> list[tuple[int, bytes]]:
    """Return the payloads of the messages with a topic, with their times."""
    return [(now, message.payload) for now, message in published if message.topic == topic]


def states(published: Published, esc: str = "esc1") -> list[tuple[int, dict[str, Any]]]:
    """Return the states of an ESC with their times."""
    found = payloads(published, TOPICS.of(esc, "state"))
    return [(now, json.loads(payload)) for now, payload in found]


def snake(signal: str, prefix: str) -> str:
    name = signal.removeprefix(prefix).removesuffix("Percent")
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()


def by_cantools(database: Database, frames: Timed, prefix: str) -> dict[str, Any]:
    """Return the values after these frames by source, as cantools decodes them.

    A value that is not available is None.
    """
    found: dict[str, Any] = {}
    for _, frame in frames:
        decoded = database.decode_message(frame.can_id, frame.data)
        assert isinstance(decoded, dict)
        for name, value in decoded.items():
            if not name.startswith(prefix):
                continue
            plain: float | str | None = str(value)
            if isinstance(value, (int, float)):
                plain = value
            elif plain in ("NotAvailable", "Error"):
                plain = None
            found[snake(name, prefix)] = plain
    return found


# --- content


@pytest.mark.parametrize(
    "names",
    [
        ("esc1",),
        ("left", "right"),
    ],
)
def test_json_has_each_value_as_cantools_decodes_it(names: tuple[str, ...]) -> None:
    bus = layout_of(names)
    database = read(copies_text(bus.database, [*bus.copies().values()]))
    frames = flight(bus, 12)
    made = publisher(*names)
    last = run(made, frames, 12)
    flags = {bit.text for bit in (*OperatingError, *SelfTestError)}
    columns = SignalReader(bus.layout).columns
    for index, name in enumerate(names):
        when, found = states(last, name)[-1]
        prefix = name.capitalize() if len(names) > 1 else ""
        before = [(time_ns, frame) for time_ns, frame in frames if time_ns <= when]
        wanted = by_cantools(database, before, prefix)
        compared = found.keys() - (OWN_KEYS - {"link_state"})
        for source in compared:
            value = found[source]
            if isinstance(value, float):
                assert value == pytest.approx(wanted[source]), source
            else:
                assert value == wanted[source], source
        # Every signal is included except flags, which are in lists, and values of the gateway.
        signals = {column.source for column in columns if column.esc == index}
        assert compared == signals - flags
        assert found["electrical_speed"] > 0
        assert found["firmware"] == "4.17"


def test_errors_have_name_severity_meaning_and_set_problem() -> None:
    bits = (
        OperatingError.UNDERVOLTAGE,
        OperatingError.POWER_STAGE_OVERTEMP_WARNING,
        SelfTestError.TEST_UNDERVOLTAGE,
    )
    frames = flight(layout_of(["esc1"]), 4, [with_errors(*bits)])
    published = run(publisher("esc1"), frames, 4)
    _, found = states(published)[-1]
    errors = {error["name"]: error for error in found["errors"]}
    undervoltage = errors["undervoltage"]
    assert undervoltage["severity"] == "error"
    assert undervoltage["meaning"] == "battery voltage too low"
    hot = errors["power_stage_overtemp_warning"]
    assert hot["severity"] == "warning"
    assert hot["meaning"] == "power stage hot"
    assert [error["name"] for error in found["selftest"]] == ["test_undervoltage"]
    assert found["problem"] is True


# --- timing


@settings(max_examples=40, deadline=None)
@given(
    rate=st.one_of(st.floats(0.01, 20), st.sampled_from([0.01, 0.5, 1.0, 3.0, 20.0])),
    steps=st.lists(st.integers(1, 3000), min_size=30, max_size=200),
)
def test_rate_does_not_depend_on_the_times_of_calls(rate: float, steps: list[int]) -> None:
    """Without a change, there is one message in each period, at the first call in it."""
    made = publisher("esc1", rate=rate)
    period = round(SECOND_NS / rate)
    first = SECOND_NS // 2
    topic = TOPICS.of("esc1", "state")
    now = 0
    told = []
    expected: dict[int, int] = {}
    for step in [0, *steps]:
        now += step * MS
        topics = [message.topic for message in made.messages(now, now)]
        told += [now] * topics.count(topic)
        if now >= first:
            expected.setdefault((now - first) // period, now)
    assert told == list(expected.values())


def changes(published: Published, key: str) -> list[tuple[int, Any]]:
    """Return time and new value of each change of a key in the published messages."""
    found: list[tuple[int, Any]] = []
    for now, state in states(published):
        if not found or found[-1][1] != state[key]:
            found.append((now, state[key]))
    return found


def test_only_notable_changes_are_published_at_once() -> None:
    """There is an error from 3 to 4 s. The motor runs after 6 s. The line is silent after 9 s."""
    window = ErrorWindow(OperatingError.OVERVOLTAGE, 3 * SECOND_NS, SECOND_NS)
    off = Phase("off", 5, 0, OperatingState.MotorOff, 0)
    go = Phase("go", 90, 60, OperatingState.Forward, 5)
    options = EscOptions(profile=(off, go), faults=Faults(errors=(window,)))
    frames = flight(layout_of(["esc1"]), 11, [options], until=9)
    published = run(publisher("esc1", rate=0.01), frames, 11)
    times = [now for now, value in changes(published, "problem") if value is not None]
    for told, happened in zip(times[1:], (3 * SECOND_NS, 4 * SECOND_NS), strict=True):
        assert 0 <= told - happened <= 0.2 * SECOND_NS + 2 * STEP_NS
    kinds = changes(published, "motor")
    assert [kind for _, kind in kinds] == ["idle", "run", None]
    assert abs(kinds[1][0] - 6 * SECOND_NS) <= 0.25 * SECOND_NS  # after a second of power-up
    lost = next(now for now, found in states(published) if found["link_state"] == "Lost")
    assert lost - 9 * SECOND_NS <= 1.3 * SECOND_NS  # the gateway's own timeout is included
    assert len(states(published)) <= 10
    available = payloads(published, TOPICS.of("esc1", "available"))
    assert [payload for _, payload in available] == [b"online", b"offline"]
    for _, message in published:
        assert not (message.retain and message.topic.endswith("/state"))


def test_esc_without_live_values_is_available_with_any_value() -> None:
    bus = layout_of(["esc1"])
    messages = tuple(each for each in bus.layout.messages if each.name == "EscLink")
    layout = replace(bus.layout, messages=messages)
    lean = replace(bus, layout=layout)
    published = run(Publisher(lean, TOPICS, MqttConfig()), flight(bus, 3), 3)
    available = payloads(published, TOPICS.of("esc1", "available"))
    assert [payload for _, payload in available] == [b"online"]


def test_rate_of_notable_changes_is_limited() -> None:
    windows = []
    for start in range(0, 20 * SECOND_NS, 60 * MS):
        windows.append(ErrorWindow(OperatingError.OVERVOLTAGE, start, 30 * MS))
    options = EscOptions(profile=QUIET.profile, faults=Faults(errors=tuple(windows)))
    frames = flight(layout_of(["esc1"]), 20, [options])
    published = run(publisher("esc1", rate=0.01), frames, 20)
    times = [now for now, _ in states(published)]
    gaps = [after - before for before, after in pairwise(times)]
    assert len(times) > 50
    assert min(gaps) >= MIN_PAUSE_NS


def test_silent_gateway_is_offline_after_three_seconds() -> None:
    bus = layout_of(["esc1"])
    frames = []
    for now, frame in flight(bus, 10):
        if not 4 * SECOND_NS < now < 9 * SECOND_NS:
            frames.append((now, frame))
    published = run(publisher("esc1"), frames, 10)
    for esc in ("esc1", ""):
        available = payloads(published, TOPICS.of(esc, "available"))
        assert [payload for _, payload in available] == [b"online", b"offline", b"online"]
    _, (offline_ns, _), (online_ns, _) = payloads(published, TOPICS.of("", "available"))
    assert 7 * SECOND_NS <= offline_ns <= 7.3 * SECOND_NS
    assert 9 * SECOND_NS <= online_ns <= 9.3 * SECOND_NS
    found = states(published)
    heard = [state for now, state in found if now < 4 * SECOND_NS][-1]
    assert heard["errors"] == []
    assert heard["selftest"] == []
    assert heard["problem"] is False
    silent = [state for now, state in found if 7 * SECOND_NS < now < 9 * SECOND_NS][-1]
    for key in ("time", "available", "age"):
        del silent[key]
    assert set(silent.values()) == {None}


def test_message_has_its_time_in_utc() -> None:
    assert iso(1_700_000_000_123_456_789) == "2023-11-14T22:13:20.123Z"


# --- Home Assistant

# Units and state classes of each device class, from Home Assistant's documentation of sensors.
ANY = {"measurement", "total", "total_increasing"}
DEVICE_CLASSES: dict[str | None, tuple[set[str | None], set[str | None]]] = {
    "voltage": ({"V", "mV", "µV"}, {"measurement"}),
    "current": ({"A", "mA"}, {"measurement"}),
    "power": ({"W", "kW", "mW"}, {"measurement"}),
    "energy": ({"Wh", "kWh", "J"}, {"total", "total_increasing"}),
    "temperature": ({"°C", "°F", "K"}, {"measurement"}),
    "frequency": ({"Hz", "kHz"}, {"measurement"}),
    "duration": ({"d", "h", "min", "s", "ms"}, {*ANY}),
    "enum": ({None}, {None}),
    None: ({"rpm", "%", "mAh", "µs", None}, {*ANY, None}),
}
COMPONENT_KEYS = {
    "platform",
    "name",
    "unique_id",
    "value_template",
    "device_class",
    "state_class",
    "unit_of_measurement",
    "options",
    "entity_category",
    "suggested_display_precision",
    "availability",
    "availability_mode",
}


def test_every_entity_is_valid_and_shows_a_key_of_the_state() -> None:
    frames = flight(layout_of(["left", "right"]), 3)
    published = run(publisher("left", "right", discovery="ha"), frames, 3)
    ids: list[str] = []
    for esc in ("left", "right", ""):
        topic = TOPICS.discovery("ha", esc)
        _, newest = states(published, esc)[-1]
        _, announced = payloads(published, topic)[0]
        for key, component in json.loads(announced)["components"].items():
            assert component["unique_id"] == f"{topic.split('/')[2]}_{key}"
            ids.append(component["unique_id"])
            check_component(key, component, newest)
    assert len(ids) == len(set(ids)) > 100


def check_component(key: str, component: dict[str, Any], newest: dict[str, Any]) -> None:
    """Check an entity of Home Assistant, which shows keys of the newest state."""
    assert set(component) <= COMPONENT_KEYS, key
    assert component["name"]
    shown = re.findall(r"value_json\.(\w+)", component["value_template"])
    assert shown, key
    assert set(shown) <= set(newest), key
    assert component.get("entity_category") in (None, "diagnostic")
    kind = component.get("device_class")
    if component["platform"] == "binary_sensor":
        assert kind == "problem"
        return
    assert component["platform"] == "sensor"
    units, classes = DEVICE_CLASSES[kind]
    assert component.get("unit_of_measurement") in units, key
    assert component.get("state_class") in classes, key
    options = component.get("options", [])
    assert len(options) == len(set(options))
    assert (len(options) > 1) == (kind == "enum")


def test_esc_is_announced_when_heard_and_again_when_identified() -> None:
    bus = layout_of(["esc1"])
    columns = SignalReader(bus.layout).columns
    info = {column.key for column in columns if column.source in ("device", "firmware_main")}
    frames = []
    for now, frame in flight(bus, 10):
        if now > 4 * SECOND_NS or frame.key not in info:
            frames.append((now, frame))
    topic = TOPICS.discovery("ha", "esc1")
    silent = run(publisher("esc1", discovery="ha"), [], 10)
    assert payloads(silent, topic) == []
    published = run(publisher("esc1", discovery="ha"), frames, 10)
    first, second = payloads(published, topic)
    unknown = json.loads(first[1])["device"]
    identified = json.loads(second[1])["device"]
    assert unknown["model"] == "ESC"
    assert "sw_version" not in unknown
    assert identified["model"] == "KOSMIK"
    assert "sw_version" in identified
