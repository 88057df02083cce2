"""The screen fits into any terminal.

At 60x20, 80x24 and 120x40 it shows the important values of one to eight ESCs.
"""

import re
from functools import cache
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.text import Text
from simulated_bus import flight, layout_of, with_errors

from kontronik_can_gw.desk.monitor.lines import number, shorten
from kontronik_can_gw.desk.monitor.model import Monitor
from kontronik_can_gw.desk.monitor.screen import screen, sparkline
from kontronik_can_gw.desk.monitor.watch import obey
from kontronik_can_gw.desk.quantities import QUANTITIES, Quantity
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.sources import DemoBus, Source
from kontronik_can_gw.esc.kontronik.simulator import SECOND_NS, EscOptions
from kontronik_can_gw.esc.kontronik.states import Device, OperatingError
from kontronik_can_gw.frames import CanFrame

pytestmark = pytest.mark.promise("monitor")


def source_of(monitor: Monitor, name: str = "can0", problem: str = "") -> Source:
    made = Source(name, bus_of(len(monitor.escs)))
    made.problem = problem
    made.hints = ("Is the gateway running?",)
    return made


@cache
def bus_of(count: int) -> BusLayout:
    return layout_of([f"esc{index + 1}" for index in range(count)])


LABELS = [quantity.label for quantity in QUANTITIES]
KINDS = ["good", "errors", "lost", "silent", "replay", "none"]


@cache
def seen(count: int, kind: str = "good") -> Monitor:
    """Return a monitor of ``count`` ESCs in flight.

    With some kinds the first ESC has errors, or all ESCs or the gateway become silent.
    """
    bus = bus_of(count)
    errors = with_errors(OperatingError.UNDERVOLTAGE, OperatingError.BEC_OVERCURRENT)
    first = errors if kind == "errors" else EscOptions(device=Device.JIVEPRO)
    monitor = Monitor(bus)
    monitor.advance(0)
    seconds = 0 if kind == "none" else 3.2
    until = 1.5 if kind == "lost" else 9
    frames = flight(bus, seconds, [first], replay=kind == "replay", until=until)
    for now, frame in frames:
        monitor.take(frame, now)
        monitor.advance(now)
    end_s = {"silent": 10.4, "none": 1}.get(kind, 3.2)
    monitor.advance(round(end_s * SECOND_NS))
    return monitor


def texts(
    monitor: Monitor,
    size: tuple[int, int],
    source: Source | None = None,
    page: int = 0,
) -> list[str]:
    """Return the lines of the screen without colours."""
    lines = screen(monitor, source or source_of(monitor), size, page)
    return [line.plain.rstrip() for line in lines]


@given(
    size=st.tuples(st.integers(1, 150), st.integers(1, 60)),
    count=st.sampled_from([1, 2, 8]),
    kind=st.sampled_from(KINDS),
    keys=st.text("npa0129 x", max_size=5),
)
@settings(max_examples=30, deadline=None)
def test_any_size_and_any_keys_are_accepted(
    size: tuple[int, int],
    count: int,
    kind: str,
    keys: str,
) -> None:
    monitor = seen(count, kind)
    page = 0
    for key in keys:
        page = obey(key, source_of(monitor), monitor, page)
    lines = texts(monitor, size, page=page)
    assert len(lines) <= max(4, size[1])
    assert max(map(len, lines)) <= max(20, size[0])


@pytest.mark.parametrize(
    ("count", "size"),
    [
        (1, (60, 20)),
        (2, (120, 40)),
        (8, (80, 24)),
    ],
)
def test_important_lines_are_never_cut_off(size: tuple[int, int], count: int) -> None:
    monitor = seen(count, "errors")
    lines = texts(monitor, size)
    whole = "\n".join(lines)
    for esc in monitor.escs:
        assert esc.name in whole
        for quantity in QUANTITIES[:4]:
            value = number(esc.number(quantity.source), quantity.digits)
            alone = rf"(?<![\d.]){re.escape(value)}(?![\d.])"
            assert re.search(alone, whole), quantity.source
    assert whole.count("spool up") + whole.count("RPM control") == count
    assert "ERROR: battery voltage too low" in whole
    assert "ERROR: BEC current too high" in whole


def test_errors_are_shown_with_their_remedies_if_there_is_room() -> None:
    monitor = seen(8, "errors")
    first = "-> Stop soon. Charge or check"
    assert first in "\n".join(texts(monitor, (80, 40)))
    assert first in "\n".join(texts(monitor, (80, 24), page=1))
    assert first not in "\n".join(texts(monitor, (80, 24), page=2))
    assert first not in "\n".join(texts(monitor, (80, 14)))


def test_remedies_use_all_lines_that_are_free() -> None:
    """The first alarms have a remedy if there is no room for all of them."""
    shown = texts(seen(4, "errors"), (80, 23))
    first = shown.index("esc1 ERROR: battery voltage too low")
    assert shown[first + 1].startswith("  -> Stop soon.")
    assert "esc1 ERROR: BEC current too high" in shown
    assert "enlarge the terminal" not in "\n".join(shown)


def test_four_escs_have_whole_states_and_use_the_screen() -> None:
    shown = texts(seen(4), (80, 24))
    assert "\n".join(shown).count("spool up from still") == 3
    charts = [text for text in shown if re.match(r"esc\d (motor speed|battery|power)", text)]
    assert len(charts) == 12
    assert all(re.search("[▁-█]$", text) for text in charts)
    assert shown.count("") <= 3
    lost = "\n".join(texts(seen(4, "lost"), (80, 24)))
    assert lost.count("no telemetry for") == 4


def test_no_value_of_an_esc_is_shown_after_its_telemetry_is_lost() -> None:
    """The gateway goes on sending totals, for example the energy."""
    monitor = seen(4, "lost")
    assert monitor.escs[0].number("energy_used") is not None
    head, row = texts(monitor, (200, 24))[1:3]
    assert " Wh" in head
    assert not re.search(r"\d", row.removeprefix("esc1"))


def test_quiet_gateway_is_remembered_until_it_sends_again() -> None:
    bus = bus_of(1)
    monitor = Monitor(bus)
    monitor.advance(0)
    (message,) = [each for each in bus.database.messages if "GatewayState" in each.signal_tree]
    zeros = {signal.name: 0 for signal in message.signals}
    for state, is_quiet in (("Quiet", True), ("Running", False), ("Quiet", True)):
        data = message.encode({**zeros, "GatewayState": state}, strict=False)
        monitor.take(CanFrame(message.frame_id, data), SECOND_NS)
        assert monitor.is_quiet is is_quiet
    monitor.advance(60 * SECOND_NS)
    shown = "\n".join(texts(monitor, (80, 24)))
    assert "gateway quiet" in shown
    assert "the gateway is quiet: it sends again when an ESC is heard." in shown
    assert "Is the gateway running?" not in shown
    assert monitor.document()["gateway"]["state"] == "Quiet"


def test_sparkline_shows_seconds_between_the_extremes_and_gaps() -> None:
    (esc,) = Monitor(bus_of(1)).escs
    track = esc.tracks["battery_voltage"]
    track.history.extend([0.0, 20.0, None, 24.0, 22.0])
    track.add(20.0, 0)
    track.add(24.0, 0)
    quantity = quantity_of("battery_voltage")
    assert plain(sparkline(esc, quantity, 4)) in (["▁ █▄"], ["▁ █▅"])
    assert plain(sparkline(esc, quantity, 0)) == [""]
    track.history.extend([-1e308, 1e308])
    assert plain(sparkline(esc, quantity, 2)) == ["▁▁"]


def quantity_of(source: str) -> Quantity:
    (found,) = [quantity for quantity in QUANTITIES if quantity.source == source]
    return found


def plain(lines: list[Text]) -> list[str]:
    return [line.plain for line in lines]


def test_sparkline_of_several_lines_has_eight_steps_in_each() -> None:
    (esc,) = Monitor(bus_of(1)).escs
    track = esc.tracks["battery_current"]
    track.history.extend([0.0, 7.0, 8.0, None, 15.0, 16.0, 23.0])
    quantity = quantity_of("battery_current")
    assert plain(sparkline(esc, quantity, 7, 3)) == [
        "     ▁█",
        "  ▁ ███",
        "▁██ ███",
    ]


@pytest.mark.parametrize(
    "size",
    [
        (80, 24),
        (80, 50),
        (120, 60),
    ],
)
def test_charts_of_one_esc_use_the_available_height(size: tuple[int, int]) -> None:
    monitor = seen(1)
    lines = texts(monitor, size)
    places = places_of_labels(lines)
    heights = [after - before for before, after in pairwise(places)]
    assert len(places) == len(LABELS)
    spare = max(0, size[1] - 24 - 6)
    least = min(len(LABELS) + spare, 8 * len(LABELS))
    assert sum(heights) + 1 >= least
    assert sorted(heights, reverse=True) == heights, "the most important ones are taller"


def test_charts_keep_their_height_when_errors_appear() -> None:
    before = texts(seen(1, "good"), (80, 60))
    after = texts(seen(1, "errors"), (80, 60))
    assert places_of_labels(before) == places_of_labels(after)


def places_of_labels(lines: list[str]) -> list[int]:
    """Return the numbers of the lines that begin with the label of a quantity."""
    return [at for at, text in enumerate(lines) if text.startswith(tuple(LABELS))]


@pytest.mark.parametrize(
    ("size", "lines"),
    [
        ((80, 24), 1),
        ((80, 50), 4),
        ((120, 60), 5),
    ],
)
def test_histories_of_all_escs_are_shown_below_their_table(
    size: tuple[int, int], lines: int
) -> None:
    shown = texts(seen(2), size)
    head = re.compile(r"esc[12] +(motor speed|power stage)")
    places = [at for at, text in enumerate(shown) if head.match(text)]
    assert [re.split(r"  +", shown[place])[0] for place in places] == [
        "esc1 motor speed",
        "esc2 motor speed",
        "esc1 power stage",
        "esc2 power stage",
    ]
    assert places[1] - places[0] == lines


@pytest.mark.parametrize("kind", ["good", "errors"])
def test_long_names_do_not_hide_the_charge(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monitor = seen(2, kind)
    names = ("left_front_m", "left_front_n")
    for esc, name in zip(monitor.escs, names, strict=True):
        monkeypatch.setattr(esc, "name", name)
    head, *rows = texts(monitor, (62, 24))[1:4]
    assert head.endswith(" mAh")
    for esc, row in zip(monitor.escs, rows, strict=True):
        assert row.endswith(f" {number(esc.number('consumed_charge'))}")
        shortened = row.partition(" ")[0]
        assert "…" in shortened, "the end is what differs"
        assert shortened[-1] == esc.name[-1], "the end is what differs"
    wide = "\n".join(texts(monitor, (120, 24)))
    assert all(name in wide for name in names)


def test_name_is_shortened_in_its_middle() -> None:
    assert shorten("left_front_1", 12) == "left_front_1"
    assert shorten("left_front_1", 9) == "left…nt_1"
    assert shorten("left_front_1", 6) == "lef…_1"
    assert shorten("left_front_1", 2) == "l…"
    assert shorten("left_front_1", 1) == "…"


def test_demo_is_shown_as_a_simulation() -> None:
    source = DemoBus(1)
    monitor = Monitor(source.bus)
    assert "simulated ESC and faults" in texts(monitor, (80, 24), source)[0]
    assert "simulated" not in texts(seen(1), (80, 24))[0]


def test_value_that_is_not_available_is_a_dash() -> None:
    lines = texts(seen(1, "lost"), (80, 24))
    (voltage,) = [line for line in lines if line.startswith("battery voltage")]
    value, low = voltage.split()[3:5]
    assert value == "-" != low, "the extremes stay"
    assert any("lost" in line for line in lines)
    assert "no errors" not in "\n".join(lines)


def test_name_with_control_characters_does_not_reach_the_terminal() -> None:
    source = source_of(seen(1), "can0\x1b[2J", "bad\x1b]0;x\x07 thing")
    assert "".join(texts(seen(1), (80, 24), source)).isprintable()


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("lost", "ERROR: no telemetry"),
        ("silent", "no frames of kontronik_esc.dbc on can0"),
        ("none", "waiting for frames of kontronik_esc.dbc on can0"),
        ("replay", "REPLAY: "),
    ],
)
def test_screen_without_live_data_is_marked(kind: str, said: str) -> None:
    assert said in "\n".join(texts(seen(1, kind), (80, 24)))
    assert said not in "\n".join(texts(seen(1), (80, 24)))
