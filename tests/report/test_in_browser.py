"""The page in a real browser (headless Chromium).

No script fails, everything is drawn, and the page reacts to input.
"""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from report_browser import MISSING, PROGRAM, Browser
from report_flights import flight_of, simulated
from simulated_bus import layout_of

from kontronik_can_gw.desk.report.flight import Flight
from kontronik_can_gw.desk.report.page import render
from kontronik_can_gw.esc.kontronik.simulator import Dropout, ErrorWindow, EscOptions, Faults
from kontronik_can_gw.esc.kontronik.states import OperatingError
from kontronik_can_gw.times import SECOND as S

pytestmark = [
    pytest.mark.promise("report"),
    pytest.mark.extended,
    pytest.mark.skipif(PROGRAM is None, reason=MISSING),
]

EVIL = "</script><script>window.hit = 1</script><img src=x onerror='window.hit = 2'>"
FAULTS = Faults(
    dropout=Dropout(2 * S, 31 * S),
    errors=(
        ErrorWindow(OperatingError.POWER_STAGE_OVERTEMP_WARNING, 18 * S, 5 * S),
        ErrorWindow(OperatingError.UNDERVOLTAGE, 20 * S, S // 2),
    ),
)
# Count the pixels of a plot's data area that have (nearly) one colour.
COUNT = """((key, name) => {
  const colour = getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const plot = flight.plots.find((p) => p.key === key), { left, top, width, height } = plot.u.bbox;
  const data = plot.u.ctx.getImageData(left, top, width, height).data;
  const want = [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16));
  let count = 0;
  for (let i = 0; i < data.length; i += 4) {
    if (data[i + 3] > 200 && want.every((w, k) => Math.abs(w - data[i + k]) < 24)) count++;
  }
  return count;
})"""


def flown(names: list[str]) -> Flight:
    bus = layout_of(names)
    options = [EscOptions(faults=FAULTS), EscOptions()]
    return flight_of(bus, simulated(bus, 60, options))


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    written = {}
    for name, escs, title in (
        ("one", ["esc1"], "One"),
        ("two", ["left", "right"], EVIL),
    ):
        written[name] = folder / f"{name}.html"
        html = render(flown(escs), source=title, provenance={EVIL: EVIL}, wall_ns=S)
        written[name].write_text(html, encoding="utf-8")
    return written


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("browser") / "profile") as found:
        yield found


@pytest.fixture(autouse=True)
def nothing_fails(browser: Browser) -> Iterator[None]:
    """Assert after each test that no script failed and that only the page was loaded."""
    yield
    assert browser.errors == []
    assert len(browser.requests) == 1
    assert browser.requests[0].startswith("file://")


def centre(browser: Browser, key: str, share: float = 0.5) -> tuple[float, float]:
    """Return a point in a plot's data area, in coordinates of the screen."""
    over = f"flight.plots.find((p) => p.key === '{key}').u.over"
    browser.run(f"{over}.scrollIntoView({{behavior: 'instant', block: 'center'}})")
    browser.settle()
    box: dict[str, float] = browser.run(f"{over}.getBoundingClientRect().toJSON()")
    return box["left"] + share * box["width"], box["top"] + box["height"] / 2


def count(browser: Browser, key: str, colour: str) -> int:
    """Return the number of pixels of a plot that have a colour of page.css."""
    found: int = browser.run(f"{COUNT}('{key}', '{colour}')")
    return found


@pytest.mark.parametrize(
    ("name", "look"),
    [
        ("one", "light"),
        ("two", "dark"),
        ("two", "phone"),
    ],
)
def test_every_plot_is_drawn_and_the_page_fits(
    browser: Browser,
    pages: dict[str, Path],
    name: str,
    look: str,
) -> None:
    width, height = (390, 844) if look == "phone" else (1280, 900)
    browser.open(pages[name], width, height, dark=look == "dark", phone=look == "phone")
    keys = browser.run("flight.plots.map((p) => p.key)")
    assert keys[:2] == ["states", "battery_voltage"]
    assert [key for key in keys if key.startswith("speed")] == ["speed"]
    assert keys == ["states", *browser.run("flight.data.plots.map((p) => p.key)")]
    for key in keys[1:]:
        colours = ["--c0"] if name == "one" else ["--c0", "--c1"]
        drawn = [count(browser, key, colour) for colour in colours]
        assert sum(drawn) > 100, (key, drawn)
    bands = [count(browser, "states", f"--s{group}") for group in (0, 3, 4, 5)]
    assert min(bands) > 100, bands
    assert browser.run("document.documentElement.scrollWidth") == width
    assert browser.run("window.hit") is None


# Return each time label of a plot with its left and right edge, in pixels of the plot's canvas.
LABELS = """((key) => {
  const { u } = flight.plots.find((p) => p.key === key), axis = u.axes[0];
  u.ctx.font = axis.font[0];
  return axis._values.map((text, i) => {
    const at = u.valToPos(axis._splits[i], "x", true);
    const half = u.ctx.measureText(text ?? "").width / 2;
    return [text, at - half, at + half, u.ctx.canvas.width];
  }).filter(([text]) => text);
})"""


@pytest.mark.parametrize("phone", [False, True])
@pytest.mark.parametrize(
    "span",
    [
        (0, 60),
        (0, 0.2),
        (12, 12.06),
        (10, 50),
    ],
)
def test_time_labels_are_whole_and_apart(
    browser: Browser,
    pages: dict[str, Path],
    phone: bool,
    span: tuple[float, float],
) -> None:
    browser.open(pages["one"], 390 if phone else 1280, 844, phone=phone)
    browser.run(f"flight.setRange{span}")
    browser.settle()
    for key in ("states", "battery_voltage"):
        labels = browser.run(f"{LABELS}('{key}')")
        assert len(labels) >= 3
        assert labels[-1][2] <= labels[-1][3], "the last one is cut off"
        for (_, _, right, _), (_, left, _, _) in pairwise(labels):
            assert left - right > 5, labels


def test_one_speed_is_drawn_and_the_cursor_shows_all_speeds(
    browser: Browser, pages: dict[str, Path]
) -> None:
    browser.open(pages["one"])
    assert count(browser, "speed", "--c0") > 100
    assert count(browser, "speed", "--c1") == count(browser, "speed", "--c2") == 0
    browser.mouse("Moved", *centre(browser, "speed", 0.3))
    browser.settle()
    cells = "[...document.querySelectorAll('#plot-speed .u-series:not(:first-child) .u-value')]"
    shown = browser.run(f"{cells}.map((c) => +c.textContent.replaceAll('\u202f', ''))")
    assert len(shown) == 3
    assert 0 < shown[0] < shown[1] < shown[2]


def test_on_a_phone_the_first_numbers_are_above_the_details(
    browser: Browser, pages: dict[str, Path]
) -> None:
    browser.open(pages["two"], 390, 844, phone=True)
    top = "document.querySelector('{}').getBoundingClientRect().top"
    tiles, details = (browser.run(top.format(name)) for name in (".tiles", "dl"))
    assert tiles < details
    boxes = browser.run(
        "[...document.querySelectorAll('.tiles > div')].map((d) => d.getBoundingClientRect().right)"
    )
    assert max(boxes) <= 390
    assert browser.run("getComputedStyle(document.querySelector('.touch')).display") != "none"
    assert browser.run("getComputedStyle(document.querySelector('.mouse')).display") == "none"


def test_in_a_gap_the_cursor_has_no_values(browser: Browser, pages: dict[str, Path]) -> None:
    """Telemetry is lost from 29 to 31 s.

    Values from before and after this time must not be shown for it.
    """
    browser.open(pages["one"])
    cells = "[...document.querySelectorAll('.u-series:not(:first-child) .u-value')]"
    for seconds, is_known in (
        (28.5, True),
        (30.4, False),
        (30.9, False),
        (40, True),
    ):
        browser.mouse("Moved", *centre(browser, "battery_voltage", seconds / 60))
        browser.settle()
        shown = browser.run(f"{cells}.map((c) => c.textContent)")
        assert len(shown) >= 10
        assert all((text != "–") == is_known for text in shown), (seconds, shown)


def test_drag_zooms_all_plots_and_a_click_on_an_event_jumps_to_it(
    browser: Browser, pages: dict[str, Path]
) -> None:
    browser.open(pages["one"])
    x, y = centre(browser, "speed", 0.25)
    to_x, _ = centre(browser, "speed", 0.5)
    browser.mouse("Moved", x, y)
    browser.mouse("Pressed", x, y, buttons=1)
    for share in (0.3, 0.7, 1):
        browser.mouse("Moved", x + share * (to_x - x), y, buttons=1)
    browser.mouse("Released", to_x, y)
    browser.settle()
    assert browser.run("flight.range()") == pytest.approx([15, 30], abs=0.2)
    scales = browser.run("flight.plots.map((p) => [p.u.scales.x.min, p.u.scales.x.max])")
    assert all(scale == browser.run("flight.range()") for scale in scales)
    rows = "[...document.querySelectorAll('#events tr')]"
    event = f"{rows}.find((r) => /voltage too low/.test(r.textContent))"
    browser.run(f"{event}.click()")
    browser.settle()
    assert browser.run("flight.range()") == pytest.approx([17.5, 23], abs=0.2)
