"""The page as a file: it is self-contained, all text is escaped, and its data equal the lines."""

import base64
import hashlib
from html.parser import HTMLParser
from pathlib import Path

import pytest
from report_flights import data_of, flight_of, rows_of, simulated
from simulated_bus import layout_of

from kontronik_can_gw.desk.receiver.unpacker import SignalReader
from kontronik_can_gw.desk.recordings.layouts import layout_of_dbc
from kontronik_can_gw.desk.recordings.recording import RowBlock
from kontronik_can_gw.desk.recordings.samples import fields_of_log
from kontronik_can_gw.desk.report.flight import Flight
from kontronik_can_gw.desk.report.page import of_like_size, render
from kontronik_can_gw.desk.words import clock, duration, number, wall_clock
from kontronik_can_gw.times import SECOND as S

pytestmark = pytest.mark.promise("report")

EVIL = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\"'&<!--\u2028{{data}}"


def flown(seconds: float = 12) -> Flight:
    bus = layout_of(["esc1"])
    return flight_of(bus, simulated(bus, seconds), 500)


@pytest.fixture(scope="module")
def flight() -> Flight:
    return flown()


class Tags(HTMLParser):
    """All tags with their attributes, the texts of scripts and styles, and all other text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.raw: list[tuple[dict[str, str | None], str]] = []
        self.text = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if self.cdata_elem:
            self.raw.append((self.found[-1][1], data))
        else:
            self.text += data


def test_page_loads_nothing_and_its_policy_lists_its_scripts(flight: Flight) -> None:
    html = render(flight, source="y")
    tags = Tags(html)
    for tag, attributes in tags.found:
        assert tag not in ("link", "img", "iframe", "object", "embed", "base", "form"), tag
        assert not {"src", "href", "style"} & attributes.keys(), (tag, attributes)
        assert not any(name.startswith("on") for name in attributes), (tag, attributes)
    metas = {}
    for tag, attributes in tags.found:
        if tag == "meta":
            metas[attributes.get("http-equiv")] = attributes.get("content") or ""
    policy = metas["Content-Security-Policy"]
    assert policy.startswith("default-src 'none';")
    assert "unsafe" not in policy
    assert len(tags.raw) == 4
    for attributes, text in tags.raw:
        checksum = hashlib.sha256(text.encode()).digest()
        digest = base64.b64encode(checksum).decode()
        assert (f"'sha256-{digest}'" in policy) == (attributes.get("id") != "data"), text[:80]
    assert "@import" not in html
    assert "url(" not in html


def test_all_text_of_the_input_is_escaped(flight: Flight) -> None:
    flight = flown(3)
    flight.escs[0].name = EVIL
    flight.escs[0].devices = [EVIL]
    flight.events[0].text = flight.events[0].remedy = EVIL
    known = {EVIL: EVIL, "program": EVIL}
    html = render(flight, source=EVIL, provenance=known, wall_ns=1, damage=[EVIL])
    tags = Tags(html)
    names = [name for name, _ in tags.found]
    assert names.count("script") == 3
    assert "img" not in names
    assert "alert(1)" in tags.text
    found = data_of(html)
    assert found["escs"] == [EVIL]
    assert found["events"][0]["text"] == EVIL
    assert names[names.index("title") + 1] == "style"


def test_data_of_the_page_equal_the_lines(flight: Flight) -> None:
    found = data_of(render(flight, source="y"))
    times = [time_ns - flight.origin_ns for time_ns in flight.points.times]
    assert found["times"] == [round(time_ns / S, 6) for time_ns in times]
    written = []
    for plot in found["plots"]:
        for series in plot["series"]:
            line = plot["lines"][series["line"]]
            written.append((plot["title"], line, series["values"]))
    assert len(written) == len(flight.lines)
    assert ("Current", "Motor", flight.lines[0, "motor_current"]) in written
    assert ("Speed", "Output", flight.lines[0, "output_speed"]) in written


def test_lines_of_different_magnitudes_have_separate_plots() -> None:
    speeds = {
        "output_speed": 850.0,
        "motor_speed": 8327.0,
        "electrical_speed": 58344.0,
    }
    assert of_like_size(speeds) == [[source] for source in speeds]
    alike = {"a": 96.0, "b": 101.0, "c": 0.0, "d": 30.0}
    assert of_like_size(alike) == [["a", "b", "c", "d"]]


def test_speeds_share_a_plot_after_the_battery_and_one_line_is_drawn(flight: Flight) -> None:
    plots = data_of(render(flight, source="y"))["plots"]
    keys = [plot["key"] for plot in plots]
    assert keys[:5] == ["battery_voltage", "cell_voltage", "current", "power", "speed"]
    (speed,) = (plot for plot in plots if plot["key"].startswith("speed"))
    assert speed["lines"] == ["Output", "Motor", "Electrical"]
    assert [line["drawn"] for line in speed["series"]] == [True, False, False]
    assert speed["note"] == "output drawn, the others differ only by pole pairs and gear"
    for plot in plots:
        if plot is not speed:
            assert all(line["drawn"] for line in plot["series"])


def test_numbers_come_before_details_and_help_before_plots(flight: Flight) -> None:
    html = render(flight, source="y", damage=["3 damaged lines"])
    order = (
        "<h1>",
        "3 damaged lines",
        'class="tiles"',
        "<dl>",
        'id="help"',
        'id="plots"',
    )
    places = [html.index(text) for text in order]
    assert places == sorted(places)


def test_noisy_curves_of_two_escs_do_not_cover_each_other() -> None:
    bus = layout_of(["left", "right"])
    plots = data_of(render(flight_of(bus, simulated(bus, 6)), source="y"))["plots"]
    escs = {plot["key"]: [series["esc"] for series in plot["series"]] for plot in plots}
    assert escs["battery_voltage"] == [0, 1]
    for key in ("bec_voltage", "bec_current"):
        assert escs[key] == [0]
        assert escs[f"{key}-1"] == [1]


def test_gap_of_years_is_cut_out_and_noted() -> None:
    """A board without a battery for its clock records, and its time is set meanwhile."""
    bus = layout_of(["esc1"])
    jump = 53 * 365 * 86_400 * S
    times = times_with_a_jump(jump)
    rows = rows_of(bus, times, battery_voltage=[24.0] * 199 + [20.0])
    flight = flight_of(bus, rows)
    assert (flight.end_ns - flight.start_ns) / S == pytest.approx(22, abs=1)
    assert [cut.begin_ns for cut in flight.cuts] == [99 * S // 10]
    assert flight.cuts[0].length_ns == pytest.approx(jump, abs=3 * S)
    assert [event.text for event in flight.events].count("No telemetry") == 1
    assert flight.escs[0].telemetry_ns < 21 * S
    html = render(flight, source="y", wall_ns=5 * S)
    assert "Gaps of more than a day are cut out" in html
    assert "<li>after 0:09.9: 19345 days 0 h</li>" in html
    assert "<dd>1970-01-01 00:00:05 UTC</dd>" in html
    (cut,) = data_of(html)["cuts"]
    assert cut == [9.9, flight.cuts[0].length_ns / S]


def times_with_a_jump(jump_ns: int) -> list[int]:
    """Return 20 s of times at intervals of 0.1 s, with a jump in the middle."""
    even = [at * S // 10 for at in range(200)]
    return even[:100] + [time_ns + jump_ns for time_ns in even[100:]]


def test_part_after_a_gap_of_years_starts_at_its_own_time_of_day() -> None:
    bus = layout_of(["esc1"])
    times = times_with_a_jump(400 * 86_400 * S)
    fields = fields_of_log(SignalReader(bus.layout), bus.escs)
    made = Flight(bus.escs, fields, window=(15.0, None))
    for time_ns, values in rows_of(bus, times, battery_voltage=[24.0] * 200):
        made.evaluate(RowBlock([time_ns], [[value] for value in values], None))
    html = render(made.finish(), source="y", wall_ns=0)
    assert "<dd>1971-02-05 00:00:12 UTC</dd>" in html


def test_values_missing_in_the_dbc_are_left_out(tmp_path: Path) -> None:
    """Without errors in the DBC the page does not show a number of errors."""
    file = tmp_path / "lean.dbc"
    signal = ' SG_ BatteryVoltage : 0|16@1+ (0.01,0) [0|655.33] "V" Gw\n'
    file.write_text(f'VERSION ""\nNS_ :\nBS_:\nBU_: Gw\nBO_ 257 Main: 8 Gw\n{signal}')
    bus = layout_of_dbc(file)
    html = render(flight_of(bus, simulated(bus, 3)), source="y")
    keys = [plot["key"] for plot in data_of(html)["plots"]]
    assert keys == ["battery_voltage"]
    assert "<span>Errors" not in html


def test_times_and_numbers_are_written_for_readers() -> None:
    assert clock(0) == "0:00.0"
    assert clock(62_540_000_000) == "1:02.5"
    assert clock(3_661 * S) == "1:01:01.0"
    assert clock(-1_250 * 10**6) == "−0:01.2"
    assert duration(12_540_000_000) == "12.5 s"
    assert duration(245 * S) == "4 min 05 s"
    assert duration(3_725 * S) == "1 h 02 min 05 s"
    assert duration(472_221 * 3600 * S) == "19675 days 21 h"
    assert number(-12345.678, 1) == "−12\u202f345.7"
    assert wall_clock(1_763_751_137 * S) == "2025-11-21 18:52:17 UTC"
    assert wall_clock(1 << 90) == f"{(1 << 90) // S} s of Unix time"
