"""The page in a real browser (headless Chromium): nothing fails, everything is drawn, and it does what it is told."""

import bisect
from collections.abc import Iterator
from pathlib import Path

import pytest
from report_browser import MISSING, PROGRAM, Browser
from report_flights import shipped_bus, simulated

from kontronik_can_gw.offline.report.analysis import Analysis
from kontronik_can_gw.offline.report.flight import Flight
from kontronik_can_gw.offline.report.page import render
from kontronik_can_gw.offline.report.quantities import PLOTS
from kontronik_can_gw.protocol.states import OperatingError
from kontronik_can_gw.simulator import Dropout, ErrorWindow, EscOptions, Faults
from kontronik_can_gw.telemetry import SECOND as S

pytestmark = [pytest.mark.extended, pytest.mark.skipif(PROGRAM is None, reason=MISSING)]

EVIL = "</script><script>window.hit = 1</script><img src=x onerror='window.hit = 2'>"
FAULTS = Faults(
    dropout=Dropout(2 * S, 31 * S),
    errors=(
        ErrorWindow(OperatingError.POWER_STAGE_OVERTEMP_WARNING, 18 * S, 5 * S),
        ErrorWindow(OperatingError.UNDERVOLTAGE, 20 * S, S // 2),
    ),
)
# Pixels of a plot's data area that are (nearly) of one colour.
COUNT = """((key, colour) => {
  const plot = flight.plots.find((p) => p.key === key), { left, top, width, height } = plot.u.bbox;
  const data = plot.u.ctx.getImageData(left, top, width, height).data;
  const want = [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16));
  let count = 0;
  for (let i = 0; i < data.length; i += 4) {
    if (data[i + 3] > 200 && want.every((w, k) => Math.abs(w - data[i + k]) < 24)) count++;
  }
  return count;
})"""


def flown(names: tuple[str, ...]) -> Flight:
    bus = shipped_bus(names)
    analysis = Analysis(bus, 2000)
    for time_ns, values in simulated(bus, 60, [EscOptions(faults=FAULTS), EscOptions(max_current=80)]):
        analysis.take(time_ns, values)
    return analysis.finish()


@pytest.fixture(scope="module")
def one() -> Flight:
    return flown(("esc1",))


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory, one: Flight) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    written = {}
    for name, flight, title in (("one", one, "One"), ("two", flown(("left", "right")), EVIL)):
        written[name] = folder / f"{name}.html"
        html = render(flight, title=title, source="flight.kcap", provenance={EVIL: EVIL}, wall_ns=1_763_751_137 * S)
        written[name].write_text(html, encoding="utf-8")
    return written


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("browser") / "profile") as found:
        yield found


@pytest.fixture(autouse=True)
def nothing_fails(browser: Browser) -> Iterator[None]:
    """After each test: no script threw, and nothing but the page was asked for."""
    yield
    assert browser.errors == []
    assert len(browser.requests) == 1
    assert browser.requests[0].startswith("file://")


def centre(browser: Browser, key: str, share: float = 0.5) -> tuple[float, float]:
    """A point in a plot's data area, on the screen."""
    browser.run(f"document.getElementById('plot-{key}').scrollIntoView({{behavior: 'instant', block: 'center'}})")
    browser.settle()
    box: dict[str, float] = browser.run(
        f"(() => {{ const r = flight.plots.find((p) => p.key === '{key}').u.over.getBoundingClientRect(); "
        "return {x: r.left, y: r.top, w: r.width, h: r.height}; })()"
    )
    return box["x"] + share * box["w"], box["y"] + box["h"] / 2


def ranges(browser: Browser) -> list[list[float]]:
    browser.run("flight.followAll()")  # those off the screen wait until they are scrolled to
    browser.settle()
    found: list[list[float]] = browser.run("flight.plots.map(({u}) => [u.scales.x.min, u.scales.x.max])")
    return found


@pytest.mark.parametrize(("name", "look"), [("one", "light"), ("two", "dark"), ("two", "phone")])
def test_every_plot_is_drawn_and_the_page_fits(
    browser: Browser, pages: dict[str, Path], one: Flight, name: str, look: str
) -> None:
    width, height = (390, 844) if look == "phone" else (1280, 900)
    browser.open(pages[name], width, height, dark=look == "dark", phone=look == "phone")
    keys = browser.run("flight.plots.map((p) => p.key)")
    assert keys == ["states", *(PLOTS[p.plot].key for p in one.plots)]
    theme = "dark" if look == "dark" else "light"
    for key in keys[1:]:
        colours = browser.run(f"flight.data.styles.slice(0, {1 if name == 'one' else 2}).map((s) => s.{theme})")
        drawn = [browser.run(f"{COUNT}('{key}', '{colour}')") for colour in colours]
        assert sum(drawn) > 100, (key, drawn)
    bands = [browser.run(f"{COUNT}('states', flight.data.classes[{group}].{theme})") for group in (0, 3, 4, 5)]
    assert min(bands) > 100, bands
    assert browser.run("document.documentElement.scrollWidth") == width
    assert browser.run("window.hit") is None


def test_the_legend_tells_the_values_at_the_cursor(browser: Browser, pages: dict[str, Path], one: Flight) -> None:
    browser.open(pages["one"])
    x, y = centre(browser, "current", 0.35)
    browser.mouse("Moved", x, y)
    browser.settle()
    t = browser.run(
        "(() => { const {u} = flight.plots.find((p) => p.key === 'current'); return u.data[0][u.cursor.idx]; })()"
    )
    assert t == pytest.approx(0.35 * 60, abs=0.2)
    at = bisect.bisect_left([(time_ns - one.origin_ns) / S for time_ns in one.times], t - 1e-6)
    for plot in one.plots:  # the cursor is in all of them
        spec = PLOTS[plot.plot]
        shown = browser.run(f"[...document.querySelectorAll('#plot-{spec.key} .legend td')].map((c) => c.textContent)")
        told = [float(text.replace("\u202f", "").replace("−", "-")) for text in shown]
        assert told == [pytest.approx(line.values[at], abs=0.51 * 10**-spec.digits) for line in plot.lines], spec.key
    now = browser.run("document.getElementById('now').textContent")
    assert now.startswith("0:2")
    assert "18:52:" in now
    assert "power stage hot" in now
    assert "RPMControl" in browser.run("document.querySelector('#plot-states .band').textContent")


def test_in_a_gap_the_cursor_has_no_values(browser: Browser, pages: dict[str, Path]) -> None:
    """Telemetry is lost from 29 to 31 s: what came before and comes after is not the value of the time between."""
    browser.open(pages["one"])
    for share, is_known in ((28.5 / 60, True), (30.4 / 60, False), (30.9 / 60, False), (40 / 60, True)):
        x, y = centre(browser, "battery_voltage", share)
        browser.mouse("Moved", x, y)
        browser.settle()
        shown = browser.run("[...document.querySelectorAll('.legend td')].map((c) => c.textContent)")
        assert len(shown) >= 10
        assert all((text != "–") == is_known for text in shown), (share, shown)


MARKS = """flight.plots.filter((p) => p.key !== "states").map((p) => ({
  key: p.key, told: p.below.hidden ? "" : p.below.textContent, shown: !p.below.hidden && p.below.offsetHeight > 0,
  left: p.u.bbox.left, right: p.u.bbox.left + p.u.bbox.width,
  marks: p.marks.map(({event, x, text, number}) => ({esc: event.esc, what: event.text, from: event.from, x, text, number})),
}))"""


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """Pages of two ESCs by the number of errors in all; the first ones as a user met them, both ESCs at the same time."""
    windows = (
        ErrorWindow(OperatingError.UNDERVOLTAGE, 8 * S, 3 * S),
        ErrorWindow(OperatingError.BEC_OVERCURRENT, 13 * S, 2 * S),
        ErrorWindow(OperatingError.OVERCURRENT_INTEGRAL_ERROR, 14 * S, 2 * S),
        ErrorWindow(OperatingError.POWER_STAGE_OVERTEMP_ERROR, 38 * S, 2 * S),
        *(ErrorWindow(OperatingError.UNDERVOLTAGE, (16 + 2 * n) * S, S) for n in range(10)),
    )
    written = {}
    for number, each in ((4, windows[:2]), (6, windows[:3]), (28, windows)):
        bus = shipped_bus(("left", "right"))
        analysis = Analysis(bus, 2000)
        for time_ns, values in simulated(bus, 40, [EscOptions(faults=Faults(errors=each))] * 2):
            analysis.take(time_ns, values)
        written[number] = tmp_path_factory.mktemp("faulty") / f"{number}.html"
        written[number].write_text(render(analysis.finish(), title="x", source="x"), encoding="utf-8")
    return written


@pytest.mark.parametrize(("number", "width"), [(4, 1400), (6, 390), (28, 1400)])
def test_every_error_is_told_at_its_mark_or_by_its_number(
    browser: Browser, faulty: dict[int, Path], number: int, width: int
) -> None:
    browser.open(faulty[number], width, 900, phone=width < 500)
    found = browser.run(MARKS)
    assert len(found) >= 8
    for plot in found:
        marks = plot["marks"]
        assert len(marks) == number
        if width == 1400 and number <= 4:
            assert all(mark["text"] for mark in marks)
            assert plot["told"] == ""
        for at, mark in enumerate(marks):
            if mark["text"]:
                assert plot["left"] <= mark["text"]["left"] < mark["text"]["right"] <= plot["right"]
                assert mark["text"]["left"] - mark["x"] < 10
            else:
                assert plot["shown"]
                assert f"{('left', 'right')[mark['esc']]}: {mark['what']}" in plot["told"]
                assert str(at + 1) in plot["told"] or "…" in plot["told"]
                assert mark["number"] or number == 28
        boxes = [box for mark in marks for box in (mark["text"], mark["number"]) if box]
        for at, a in enumerate(boxes):  # nothing stands over anything else
            for b in boxes[:at]:
                assert a["row"] != b["row"] or a["right"] <= b["left"] or b["right"] <= a["left"]
        for mark in marks:  # no line runs through a text
            for box in boxes if mark["text"] else ():
                assert box["row"] >= mark["text"]["row"] or not box["left"] < mark["x"] < box["right"]
