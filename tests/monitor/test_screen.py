"""The screen: fits any terminal, shows what matters at 60x20, 80x24 and 120x40 for one to eight ESCs, with and without colour and UTF-8."""

import re
from functools import cache

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from monitor_tools import as_texts, drawn, flight, layout_of, plain, with_errors

from kontronik_can_gw.cli.monitor_screen import (
    ASCII,
    UNICODE,
    Choice,
    Glyphs,
    Where,
    bar,
    number,
    plain_lines,
    screen,
)
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.offline.monitor import CELL, TEMPERATURE, Monitor, Scale
from kontronik_can_gw.protocol.states import Device, OperatingError, SelfTestError
from kontronik_can_gw.simulator import SECOND_NS, EscOptions, Faults

SIZES = [(80, 24), (60, 20), (120, 40)]
LIVE = Where("can0", hints=("Is the gateway running?",))
RED = re.compile(r"\x1b\[(?:\d+;)*31m")
COLOUR = re.compile(r"\x1b\[(?:\d+;)*(?:3[0-8]|4[0-8]|9[0-7]|10[0-7])(?:;\d+)*m")


@cache
def seen(count: int, kind: str = "good") -> Monitor:
    """A monitor of so many ESCs in flight; the first with errors, silent, or all as they should be."""
    names = [f"esc{index + 1}" for index in range(count)]
    first = {
        "errors": with_errors(OperatingError.UNDERVOLTAGE, OperatingError.BEC_OVERCURRENT),
        "all": with_errors(*OperatingError, *SelfTestError),
        "warning": with_errors(OperatingError.POWER_STAGE_OVERTEMP_WARNING),
    }.get(kind, EscOptions(device=Device.JIVEPRO))
    bus = layout_of(names)
    monitor = Monitor(bus)
    monitor.advance(0)
    frames = (
        flight(bus, 3.2, [first], replay=kind == "replay", until=1.5 if kind == "lost" else 9) if kind != "none" else []
    )
    for now, frame in frames:
        monitor.take(frame, now)
        monitor.advance(now)
    monitor.advance(round((10.4 if kind in ("silent", "none") else 3.2) * SECOND_NS))
    return monitor


def texts(
    monitor: Monitor, size: tuple[int, int], where: Where = LIVE, choice: Choice | None = None, glyphs: Glyphs = UNICODE
) -> list[str]:
    lines = screen(monitor, where, size, choice or Choice(), glyphs)
    return [text.rstrip() for text in as_texts(lines)]


KINDS = ["good", "errors", "all", "warning", "lost", "silent", "replay", "none"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [1, 2, 8])
@pytest.mark.parametrize("size", [*SIZES, (20, 5), (33, 9), (200, 60), (80, 10)], ids=str)
@pytest.mark.parametrize("glyphs", [UNICODE, ASCII], ids=["utf8", "ascii"])
def test_no_line_is_longer_than_the_width_and_no_line_too_many(
    size: tuple[int, int], count: int, kind: str, glyphs: Glyphs
) -> None:
    lines = as_texts(screen(seen(count, kind), LIVE, size, Choice(), glyphs))
    assert len(lines) == size[1]
    assert max(map(len, lines)) <= size[0]
    if glyphs is ASCII:
        assert "".join(lines).isascii()


@given(
    st.tuples(st.integers(1, 150), st.integers(1, 60)), st.sampled_from([1, 2, 8]), st.sampled_from(KINDS),
    st.integers(-3, 9), st.none() | st.integers(0, 9),
)  # fmt: skip
@settings(max_examples=200, deadline=None)
def test_any_size_page_and_choice_is_borne(
    size: tuple[int, int], count: int, kind: str, page: int, esc: int | None
) -> None:
    lines = as_texts(screen(seen(count, kind), LIVE, size, Choice(page, esc)))
    assert len(lines) <= max(4, size[1])
    assert max(map(len, lines)) <= max(20, size[0])


@pytest.mark.parametrize("colour", [True, False])
@pytest.mark.parametrize("count", [1, 2, 8])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_rich_draws_the_lines_as_they_are_and_no_colour_without_colour(
    size: tuple[int, int], count: int, colour: bool
) -> None:
    monitor = seen(count, "errors")
    lines = screen(monitor, LIVE, size, Choice(), UNICODE)
    sent = drawn(lines, size, colour=colour)
    shown = plain(sent).split("\n")
    assert [line.rstrip() for line in shown[:-1]] == [text.rstrip() for text in as_texts(lines)]
    assert bool(COLOUR.search(sent)) == colour
    assert bool(RED.search(sent)) == colour, "errors are red"


@pytest.mark.parametrize("count", [1, 2, 8])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_what_matters_is_never_cut(size: tuple[int, int], count: int) -> None:
    monitor = seen(count, "errors")
    lines = texts(monitor, size)
    whole = "\n".join(lines)
    for esc in monitor.escs:
        assert esc.name in whole
        assert esc.state is not None
        for source, digits in (
            ("motor_speed", 0),
            ("battery_voltage", 2),
            ("battery_current", 1),
            ("power_stage_temperature", 0),
        ):
            assert re.search(rf"(?<![\d.]){re.escape(number(esc.number(source), digits))}(?![\d.])", whole), source
    assert whole.count("spool up") + whole.count("RPM control") == count
    assert "…" not in whole
    assert "ERROR: battery voltage too low" in whole
    assert "ERROR: BEC current too high" in whole
    assert lines[0].endswith("frames/s")
    assert "gateway running" in lines[0]
    assert "q quit" in lines[-1]
    assert "r reset" in lines[-1]


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_one_esc_has_everything_at_once(size: tuple[int, int]) -> None:
    monitor = seen(1)
    whole = "\n".join(texts(monitor, size))
    for label in ("motor speed", "battery voltage", "cell voltage", "battery current", "power", "power stage",
                  "BEC", "throttle", "charge, energy", "link", "CRC"):  # fmt: skip
        assert label in whole
    if size != (60, 20):
        assert all(
            label in whole for label in ("electrical speed", "output speed", "motor current", "peak current", "opening")
        )
        assert "JIVEPro 120, firmware 4.17, 6 cells" in whole
    assert "no errors, no warnings" in whole


def test_eight_escs_at_80x24_have_two_lines_each_with_extremes() -> None:
    monitor = seen(8)
    lines = texts(monitor, (80, 24))
    assert lines[1].split() == ["ESC", "state", "motor/min", "V", "V", "cell", "A", "W", "°C", "mAh"]
    assert lines[2].split() == ["link", "throttle", "max", "min", "min", "max", "max", "max", "Wh"]
    for index, esc in enumerate(monitor.escs):
        first, second = lines[3 + 2 * index], lines[4 + 2 * index]
        assert first.startswith(esc.name)
        assert second.startswith("ok 100 Hz")
        low = esc.spreads["battery_voltage"].low
        assert low is not None
        assert f"{low:.2f}" in second


def test_columns_stand_below_their_heads() -> None:
    lines = texts(seen(8), (80, 24))
    ends = [match.end() for match in re.finditer(r"motor/min|V cell|V(?= )|A|W|°C|mAh", lines[1])]
    for line in lines[3:19]:
        for end in ends:
            assert line[end - 1] != " ", line
            assert line[end : end + 1] in ("", " "), line


def test_a_few_lines_hold_eight_escs_in_pages() -> None:
    monitor = seen(8)
    choice = Choice()
    shown = set()
    for page in range(8):
        choice.page = page
        lines = texts(monitor, (80, 8), choice=choice)
        assert re.search(r"page \d of \d, 8 ESCs", lines[-1])
        shown |= {name for line in lines for name in re.findall(r"esc\d", line)}
    assert shown == {esc.name for esc in monitor.escs}


def test_of_twelve_escs_eight_are_shown_and_it_is_said() -> None:
    monitor = seen(12)
    lines = texts(monitor, (80, 24))
    assert sum(line.startswith("esc") for line in lines) == 8
    assert "page 1 of 2, 12 ESCs" in lines[-1]
    rest = texts(monitor, (80, 24), choice=Choice(page=1))
    assert [line.split()[0] for line in rest if line.startswith("esc")] == ["esc9", "esc10", "esc11", "esc12"]
    assert "-c or --dbc" in texts(monitor, (80, 24), LIVE._replace(keys=False))[-1]


def test_one_of_many_can_be_chosen() -> None:
    lines = texts(seen(8), (80, 24), choice=Choice(esc=4))
    assert "esc5" in lines[1]
    assert not any("esc4" in line or "esc6" in line for line in lines)
    assert any(line.startswith("electrical speed") for line in lines)
    assert "a all" in lines[-1]


def test_a_value_that_is_not_available_is_a_dash() -> None:
    lines = texts(seen(1, "lost"), (80, 24))
    (voltage,) = [line for line in lines if line.startswith("battery voltage")]
    assert voltage.split()[3] == "-"
    assert voltage.split()[4] != "-", "the extremes stay"
    assert any("lost" in line for line in lines)
    assert "no errors" not in "\n".join(lines)


@pytest.mark.parametrize("count", [1, 2, 8])
def test_no_telemetry_is_said_with_the_remedy(count: int) -> None:
    lines = texts(seen(count, "lost"), (80, 24))
    name = "esc1 " if count > 1 else ""
    assert any(re.match(rf"{name}LINK: no telemetry for [01] s: is the ESC powered, its cable", line) for line in lines)
    assert sum("lost" in line for line in lines) >= 1
    assert "".join(lines).count("no telemetry") >= 2


def test_a_degraded_link_is_told() -> None:
    bus = layout_of(["esc1"])
    monitor = Monitor(bus)
    monitor.advance(0)
    for now, frame in flight(bus, 3, [EscOptions(faults=Faults(flipped_bits=0.0005))]):
        monitor.take(frame, now)
    monitor.advance(3 * SECOND_NS)
    assert monitor.escs[0].link == "Degraded"
    lines = texts(monitor, (80, 24))
    assert "LINK: degraded, frames are damaged: look at cable and ground" in lines
    assert any(re.match(r"link +degraded, \d+ Hz", line) for line in lines)
    assert any(re.match(r"on the line +CRC errors [1-9]", line) for line in lines)


def test_a_port_that_cannot_be_opened_is_told_too() -> None:
    bus = layout_of(["esc1"])
    monitor = Monitor(bus)
    monitor.advance(0)
    gateway = Gateway(bus.escs, bus.layout, 0)
    gateway.start(0)
    gateway.port_lost(0, 0)
    for step in range(200):
        gateway.advance(step * 10_000_000)
        for frame in gateway.take_frames():
            monitor.take(frame, step * 10_000_000)
    assert any("LINK: the gateway cannot open the port" in line for line in texts(monitor, (80, 24)))


def test_silence_is_said_with_the_remedy() -> None:
    whole = " ".join(texts(seen(1, "silent"), (80, 24)))
    assert "no frames of kontronik_esc.dbc on can0 for 7 s Is the gateway running?" in whole
    assert "running  " not in whole, "an old state of the gateway"


def test_before_the_first_frame_it_waits() -> None:
    monitor = Monitor(layout_of(["esc1"]))
    monitor.advance(0)
    monitor.advance(SECOND_NS)
    assert "waiting for frames on can0 ..." in texts(monitor, (80, 24))


def test_a_bus_that_is_down_is_said_instead() -> None:
    where = LIVE._replace(
        problem="CAN interface can0: is down. Start it: sudo ip link set can0 up type can bitrate 500000"
    )
    lines = texts(seen(1, "silent"), (80, 24), where)
    assert lines[1].startswith("CAN interface can0: is down.")
    assert not any("no frames" in line for line in lines)


def test_replay_is_shown_clearly() -> None:
    lines = texts(seen(2, "replay"), (80, 24))
    assert lines[1].startswith("REPLAY: ")
    assert "gateway replay" in lines[0]
    assert all(line.startswith("REPLAY") for line in plain_lines(seen(2, "replay")))
    assert not any("REPLAY" in line for line in texts(seen(2), (80, 24)))


def test_more_escs_than_the_dbc_describes_are_said() -> None:
    two, monitor = layout_of(["esc1", "esc2"]), Monitor(layout_of(["esc1"]))
    monitor.advance(0)
    for now, frame in flight(two, 2):
        monitor.take(frame, now)
        monitor.advance(now)
    assert "the gateway has 2 ESCs, the DBC in use describes 1" in " ".join(texts(monitor, (80, 24)))


def test_too_many_errors_are_counted() -> None:
    lines = texts(seen(1, "all"), (80, 24))
    assert any(re.match(r"\.\.\. and \d+ lines more of errors and warnings", line) for line in lines)
    assert any(line.startswith("ERROR: ") for line in lines)


def test_errors_are_drawn_together_where_there_is_little_room() -> None:
    lines = texts(seen(8, "all"), (80, 24))
    assert any(line.startswith("esc1 ERROR: battery voltage too low; battery voltage too high") for line in lines)


def test_errors_are_marked_without_colours_too() -> None:
    assert any(line.startswith("esc1 !! ") for line in texts(seen(8, "errors"), (80, 24)))
    assert any(line.startswith("esc1 ! ") for line in texts(seen(8, "warning"), (80, 24)))
    assert "WARNING: power stage hot" in texts(seen(1, "warning"), (80, 24))


def test_a_name_with_control_characters_does_not_reach_the_terminal() -> None:
    where = LIVE._replace(name="can0\x1b[2J", problem="bad\x1b]0;x\x07 thing")
    lines = "".join(as_texts(screen(seen(1), where, (80, 24), Choice())))
    assert lines.isprintable()


@given(st.floats(-500, 500) | st.none(), st.integers(1, 60), st.sampled_from([UNICODE, ASCII]))
def test_a_bar_is_as_wide_as_it_should_be_and_grows_with_the_value(
    value: float | None, width: int, glyphs: Glyphs
) -> None:
    for scale in (TEMPERATURE, CELL, Scale(0, 100)):
        text = "".join(piece.text for piece in bar(value, scale, width, glyphs))
        assert len(text) == width
        assert set(text) <= {glyphs.full, glyphs.empty}
        assert text == glyphs.full * text.count(glyphs.full) + glyphs.empty * text.count(glyphs.empty)
        if value is None or value <= scale.low:
            assert glyphs.full not in text
        elif value >= scale.high:
            assert glyphs.empty not in text
        else:
            more = "".join(piece.text for piece in bar(value + 1, scale, width, glyphs))
            assert more.count(glyphs.full) >= text.count(glyphs.full)


def test_bars_are_yellow_and_red_beyond_the_limits() -> None:
    assert [bar(value, TEMPERATURE, 11, UNICODE)[0].style for value in (50, 85, 105)] == ["green", "yellow", "red"]
    assert [bar(value, CELL, 11, UNICODE)[0].style for value in (3.9, 3.45, 3.2)] == ["green", "yellow", "red"]
    empty = {piece.style for piece in bar(20, TEMPERATURE, 22, UNICODE)[1:]}
    assert empty == {"dim", "dim yellow", "dim red"}


def test_plain_lines_have_a_line_for_each_esc() -> None:
    lines = list(plain_lines(seen(2, "errors")))
    assert len(lines) == 2
    assert re.match(r" +\d+\.\d s  esc1  link ok  state (spool up|RPM control)", lines[0])
    assert "ERROR battery voltage too low  ERROR BEC current too high" in lines[0]
    assert "ERROR" not in lines[1]
    assert re.search(r"battery_voltage \d+\.\d\d V", lines[1])
