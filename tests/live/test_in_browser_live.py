"""The page in a real browser (headless Chromium), on a bus that the test feeds."""

import json
import math
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from live_bench import FedBus, Line, ServedPage, wait_until
from recordings import capture_bytes
from report_browser import MISSING, PROGRAM, Browser
from simulated_bus import FLYING, Timed, flight, with_errors

from kontronik_can_gw.desk.live.content import Content
from kontronik_can_gw.desk.live.flights import Flights
from kontronik_can_gw.desk.monitor.model import Esc
from kontronik_can_gw.desk.quantities import Quantity
from kontronik_can_gw.esc.kontronik.simulator import Dropout, EscOptions, Faults
from kontronik_can_gw.esc.kontronik.states import OperatingError
from kontronik_can_gw.times import SECOND as S

pytestmark = [
    pytest.mark.promise("live-page"),
    pytest.mark.extended,
    pytest.mark.skipif(PROGRAM is None, reason=MISSING),
]

READY = "!!(globalThis.live && live.layout() && live.updates > 1)"
# Return the text and class of each figure of an ESC's card, by source.
FIGURES = """((esc) => Object.fromEntries(
  [...document.querySelectorAll('.esc')[esc].querySelectorAll('.figure')].map((node) => [
    node.dataset.source,
    [...node.querySelectorAll('.value span, .range'), { textContent: node.className }]
      .map((part) => part.textContent),
  ])))"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("browser") / "profile") as found:
        yield found


@pytest.fixture
def bus() -> FedBus:
    return FedBus(["left", "right"])


@pytest.fixture
def page(bus: FedBus) -> Iterator[ServedPage]:
    with ServedPage(bus) as served:
        yield served


def fly(bus: FedBus, seconds: float, *options: EscOptions, **more: Any) -> Timed:
    """Feed a flight to the bus. Return its frames."""
    frames = flight(bus.bus, seconds, list(options), **more)
    bus.feed(frames, round(seconds * S))
    return frames


def figures(browser: Browser, esc: int = 0) -> dict[str, tuple[str, str, str]]:
    found: dict[str, tuple[str, str, str]] = browser.run(f"{FIGURES}({esc})")
    return found


def number(text: str) -> float:
    return float(text.replace("\u202f", "").replace("−", "-"))


def wait_for_updates(browser: Browser) -> None:
    """Wait until the page has shown all data that the bus had before this call."""
    count = browser.run("live.updates")
    wait_until(lambda: browser.run("live.updates") > count + 2, "updates")


def test_every_figure_equals_the_decoded_frame(
    browser: Browser, bus: FedBus, page: ServedPage
) -> None:
    fly(bus, 20)
    browser.open(page.url, ready=READY)
    wait_for_updates(browser)
    quantities = {each["source"]: each for each in json.loads(page.content.layout())["quantities"]}
    for index, esc in enumerate(page.content.monitor.escs):
        shown = figures(browser, index)
        assert set(shown) == set(quantities)
        for source, (text, limits, style) in shown.items():
            real = esc.number(source)
            track = esc.tracks[source]
            assert real is not None
            assert number(text) == round(real, quantities[source]["digits"]), source
            assert "old" not in style.split()
            low, _, high = limits.partition(" … ")
            assert number(low) == round(track.low or 0, quantities[source]["digits"])
            assert number(high) == round(track.high or 0, quantities[source]["digits"])
    assert browser.errors == []
    assert all(address.startswith((page.url, "data:")) for address in browser.requests)


def test_page_without_messages_never_looks_alive(
    browser: Browser, bus: FedBus, page: ServedPage
) -> None:
    """The connection loses all packets and is not closed."""
    fly(bus, 5)
    with Line(page.port) as line:
        browser.open(line.url, ready=READY)
        is_alive = "document.querySelector('#offline').hidden"
        wait_until(lambda: browser.run(is_alive), "a live page")
        line.is_cut = True
        heard = browser.run("live.heard()")
        is_stale = "document.body.classList.contains('stale')"
        wait_until(lambda: browser.run(is_stale), "a stale page")
        late = browser.run("performance.now()") - heard
        assert late >= 1000
        shown = "document.querySelector('#offline').textContent"
        seconds = f"(/^no connection for ([0-9]+) s/.exec({shown}) ?? [0, 0])[1]"
        wait_until(lambda: int(browser.run(seconds)) >= 2, "the time without a connection")
        spans = "[...document.querySelectorAll('.figure .value span')]"
        colours = browser.run(f"{spans}.map((node) => getComputedStyle(node).color)")
        assert len(set(colours)) == 1
        assert "no connection" in browser.run("document.title")
        assert "offline" in browser.run("document.querySelector('#icon').href")
        line.is_cut = False
        wait_until(lambda: not browser.run(is_stale), "a live page")


def test_page_continues_after_a_restart_of_the_server(
    browser: Browser, bus: FedBus, page: ServedPage
) -> None:
    fly(bus, 5)
    browser.open(page.url, ready=READY)
    page.stop()
    is_stale = "document.body.classList.contains('stale')"
    wait_until(lambda: browser.run(is_stale), "a stale page")
    page.start()
    wait_until(lambda: not browser.run(is_stale), "a live page")
    bus.feed(
        [(now + 5 * S, frame) for now, frame in flight(bus.bus, 3)],
        8 * S,
    )
    wait_for_updates(browser)
    esc = page.content.monitor.escs[0]
    real = esc.number("battery_voltage")
    assert real is not None
    assert number(figures(browser)["battery_voltage"][0]) == round(real, 2)
    browser.errors.clear()  # the browser reports each refused connection


def test_one_esc_loses_telemetry_and_the_other_goes_on(
    browser: Browser, bus: FedBus, page: ServedPage
) -> None:
    """The telemetry of the left ESC is lost from 5 to 8 s."""
    silent = EscOptions(profile=FLYING, faults=Faults(dropout=Dropout(3 * S, 8 * S)))
    fly(bus, 7.5, silent)
    browser.open(page.url, ready=READY)
    wait_for_updates(browser)
    left, right = figures(browser, 0), figures(browser, 1)
    for source in ("battery_voltage", "motor_speed", "power_stage_temperature"):
        text, age, style = left[source]
        assert text != "–"
        assert age.endswith(" s old")
        assert "old" in style.split()
        assert "old" not in right[source][2].split()
    seen = """[...document.querySelectorAll('.esc')].map((esc) => esc.querySelector(
      '.figure[data-source=battery_voltage] .range').getClientRects().length > 0)"""
    assert browser.run(seen) == [True, False], "in the list the ages are shown, the limits not"
    alarm = browser.run("document.querySelector('#alarms li').textContent")
    assert alarm.startswith("left: no telemetry")
    assert "running" in browser.run("document.querySelector('#state').textContent")


def test_error_is_in_title_and_icon_and_a_silent_gateway_is_told(
    browser: Browser, bus: FedBus, page: ServedPage
) -> None:
    fly(bus, 12, with_errors(OperatingError.UNDERVOLTAGE))
    browser.open(page.url, ready=READY)
    wait_for_updates(browser)
    wait_until(lambda: "⚠" in browser.run("document.title"), "an error in the title")
    wait_until(lambda: "error" in browser.run("document.querySelector('#icon').href"), "the icon")
    alarm = browser.run("document.querySelector('#alarms li').textContent")
    assert "left: battery voltage too low" in alarm
    worst = "document.querySelector('#worst').textContent"
    assert browser.run(worst).startswith("left: battery voltage too low")
    bus.feed([], 14 * S)
    state = "document.querySelector('#state').textContent"
    wait_until(lambda: "no gateway heard for 2 s" in browser.run(state), "the silence")
    wait_for_updates(browser)
    assert "old" in figures(browser)["battery_voltage"][2].split()


def test_reset_pause_and_zoom(browser: Browser, bus: FedBus, page: ServedPage) -> None:
    fly(bus, 30)
    browser.open(page.url, ready=READY)
    wait_for_updates(browser)
    assert " … " in figures(browser)["motor_speed"][1]
    browser.run("document.querySelector('#reset').click()")
    wait_until(lambda: figures(browser)["motor_speed"][1] == "", "the reset")
    browser.run("document.querySelector('#pause').click()")
    newest = "live.view().plots[0].u.data[1].at(-1)"
    before = browser.run(newest)
    count = browser.run("live.steps().length")
    bus.feed([(now + 30 * S, frame) for now, frame in flight(bus.bus, 20)], 50 * S)
    wait_until(lambda: browser.run("live.steps().length") > count, "steps")
    assert browser.run(newest) == before
    browser.run("document.querySelector('#pause').click()")
    browser.settle()
    assert browser.run(f"{newest} === live.steps().at(-1)[1]")
    browser.run("document.querySelector('#in').click()")
    assert browser.run("live.view().range()") == [-150, 0]
    browser.run("document.querySelector('#whole').click()")
    assert browser.run("live.view().range()") == [-300, 0]


def test_limit_colours_the_figure_and_sounds_once(
    browser: Browser, bus: FedBus, page: ServedPage
) -> None:
    fly(bus, 10)
    browser.open(page.url, ready=READY)
    script = """((value) => {
      const labels = [...document.querySelectorAll('#limit-list label')];
      const label = labels.find((l) => /battery voltage below/.test(l.textContent));
      label.querySelector('input').value = value;
      label.querySelector('input').dispatchEvent(new Event('change'));
    })"""
    browser.run(f"{script}(100)")
    wait_until(lambda: "beyond" in figures(browser)["battery_voltage"][2].split(), "the colour")
    assert "beyond" not in figures(browser)["battery_current"][2].split()
    wait_for_updates(browser)
    assert browser.run("live.beeps") == 2  # one for each ESC
    browser.open(page.url, ready=READY)
    wait_until(lambda: "beyond" in figures(browser)["battery_voltage"][2].split(), "the limit")
    browser.run(f"{script}('')")
    wait_until(lambda: "beyond" not in figures(browser)["battery_voltage"][2].split(), "no limit")


@pytest.mark.parametrize("count", [1, 2, 8])
@pytest.mark.parametrize("width", [360, 768, 1440])
@pytest.mark.parametrize("dark", [False, True])
def test_nothing_is_cut_off_or_scrolls_sideways(
    browser: Browser, count: int, width: int, dark: bool
) -> None:
    bus = FedBus([f"motor_{number}" for number in range(count)])
    with ServedPage(bus) as page:
        fly(bus, 12, with_errors(OperatingError.UNDERVOLTAGE))
        browser.open(page.url, width, 800, dark=dark, phone=width == 360, ready=READY)
        wait_for_updates(browser)
        parts = ".esc *, #alarms *, header *, #bar *"
        cut = f"""[...document.querySelectorAll('{parts}')].filter((node) =>
          node.getClientRects().length && node.scrollWidth > node.clientWidth + 1
          && getComputedStyle(node).display !== 'inline').map((node) => node.outerHTML)"""
        views = [None] if count == 1 else [None, 0]
        for view in views:
            if view is not None:
                browser.run("document.querySelector('.esc button').click()")
                browser.settle()
            assert browser.run("document.documentElement.scrollWidth") == width
            assert browser.run(cut) == []
            plots = browser.run("live.view().plots.map((p) => p.u.width)")
            assert max(plots) <= width
        assert browser.errors == []


@pytest.mark.parametrize("count", [1, 8])
@pytest.mark.parametrize("width", [360, 768, 1440])
def test_large_values_stay_within_their_figure(
    browser: Browser, count: int, width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def large_value(_content: Content, _esc: Esc, quantity: Quantity, _now: int) -> tuple[Any, ...]:
        value = -183_502.4 if quantity.digits < 2 else -100.25
        return round(value, quantity.digits), None, value, value, ""

    monkeypatch.setattr(Content, "_value", large_value)
    bus = FedBus([f"motor_{number}" for number in range(count)])
    with ServedPage(bus) as page:
        fly(bus, 3)
        browser.open(page.url, width, 800, phone=width == 360, ready=READY)
        wait_for_updates(browser)
        browser.run("document.querySelectorAll('.more').forEach((each) => { each.open = true; })")
        outside = """[...document.querySelectorAll('.figure')].filter((figure) =>
          figure.getClientRects().length && figure.scrollWidth > figure.clientWidth)
          .map((figure) => figure.innerText)"""
        assert browser.run(outside) == []


def test_page_has_no_errors_of_the_page_before(browser: Browser) -> None:
    with ServedPage(FedBus(["esc1"])) as page:
        browser.open(page.url, ready=READY)
        browser.run("setInterval(() => fetch('/').catch(() => {}), 1)")
    for _ in range(10):
        browser.settle()
    assert browser.errors, "refused connections"
    with ServedPage(FedBus(["esc1"])) as page:
        browser.open(page.url, ready=READY)
        browser.settle()
        assert browser.errors == []


def test_one_of_eight_escs_fills_the_screen(browser: Browser) -> None:
    bus = FedBus([f"m{number}" for number in range(8)])
    with ServedPage(bus) as page:
        fly(bus, 5)
        browser.open(page.url, 360, 780, phone=True, ready=READY)
        cards = (
            "[...document.querySelectorAll('.esc')].filter((n) => n.getClientRects().length).length"
        )
        assert browser.run(cards) == 8
        browser.run("document.querySelectorAll('.esc button')[3].click()")
        assert browser.run(cards) == 1
        assert browser.run("live.view().visible.indexOf(true)") == 3
        legend = """[...document.querySelectorAll('#plots figure:first-child .u-series')]
          .filter((row) => row.getClientRects().length).map((row) => row.innerText.trim())"""
        wait_until(lambda: len(browser.run(legend)) == 1, "the legend of one ESC")
        assert browser.run(legend)[0].startswith("m3")
        browser.run("document.querySelector('#back').click()")
        assert browser.run(cards) == 8
        assert math.isclose(browser.run("live.view().plots.length"), 5)


AXE = Path(__file__).parents[1] / "foreign/.cache/axe/node_modules/axe-core/axe.min.js"


def barriers(browser: Browser) -> list[str]:
    """Return the violations that axe-core finds in the page."""
    browser.run(AXE.read_text(encoding="utf-8") + ";0")
    found: list[str] = browser.run(
        """(async () => (await axe.run()).violations.map((each) =>
          `${each.id}: ${each.nodes.map((node) => node.html).join(' | ')}`))()"""
    )
    return found


@pytest.mark.skipif(not AXE.exists(), reason="no axe-core: tests/foreign/install.sh")
@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("name", ["live", "stale", "limit", "flights"])
def test_axe_finds_no_barriers(
    browser: Browser, bus: FedBus, dark: bool, name: str, tmp_path: Path
) -> None:
    folder = tmp_path / "captures"
    folder.mkdir()
    (folder / "flight.kcap").write_bytes(capture_bytes())
    (folder / "empty.kcap").touch()
    with ServedPage(bus, None, Flights(folder, 0, tmp_path)) as page:
        fly(bus, 12, with_errors(OperatingError.UNDERVOLTAGE))
        if name == "flights":
            ready = "/Energy/.test(document.querySelector('#flights').textContent)"
            browser.open(f"{page.url}/flights", 360, 780, dark=dark, phone=True, ready=ready)
        else:
            browser.open(page.url, 360, 780, dark=dark, phone=True, ready=READY)
            browser.run("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
            if name == "limit":
                browser.run(
                    """(() => { const input = document.querySelector('#limit-list input');
                    input.value = -1; input.dispatchEvent(new Event('change')); })()"""
                )
            if name == "stale":
                bus.feed([], 40 * S)  # all values are old and grey
            wait_for_updates(browser)
        assert barriers(browser) == []
        browser.run("localStorage.clear()")


def test_all_controls_can_be_reached_by_keyboard(
    browser: Browser, bus: FedBus, page: ServedPage
) -> None:
    fly(bus, 5)
    browser.open(page.url, ready=READY)
    reached = set()
    for _ in range(60):
        for kind in ("keyDown", "keyUp"):
            key = {"key": "Tab", "code": "Tab", "windowsVirtualKeyCode": 9}
            browser.call("Input.dispatchKeyEvent", type=kind, **key)
        reached.add(browser.run("document.activeElement.outerHTML.slice(0, 60)"))
    missing = browser.run(
        """[...document.querySelectorAll('button, a, summary, .plot')]
        .filter((node) => node.getClientRects().length)
        .map((node) => node.outerHTML.slice(0, 60))"""
    )
    assert set(missing) - reached == set()


def test_figures_are_announced_at_most_once_in_ten_seconds(
    browser: Browser, bus: FedBus, page: ServedPage
) -> None:
    fly(bus, 5)
    browser.open(page.url, ready=READY)
    browser.run(
        """globalThis.spoken = [];
        new MutationObserver(() => spoken.push(performance.now()))
          .observe(document.querySelector('#spoken'), { childList: true, characterData: true })"""
    )
    regions = "[...document.querySelectorAll('[aria-live=polite], [role=alert], [role=status]')]"
    assert browser.run(f"{regions}.map((node) => node.id)") == ["offline", "spoken"]
    text = "document.querySelector('#spoken').textContent"
    frames = flight(bus.bus, 20, [EscOptions(profile=FLYING)])
    for second in range(20, 600):
        part = [item for item in frames if item[0] // S == second % 20]
        bus.feed([(now % S + second * S, frame) for now, frame in part], (second + 1) * S)
        wait_for_updates(browser)
        if len(spoken := browser.run("spoken")) == 2:
            break
    assert len(spoken) == 2
    assert all(after - before >= 9_900 for before, after in pairwise(spoken))
    assert "battery voltage" in browser.run(text)


def test_token_vanishes_from_the_address(browser: Browser, bus: FedBus) -> None:
    with ServedPage(bus, "a-token") as page:
        fly(bus, 5)
        browser.open(page.url, ready="!!document.body")
        assert "web --address" in browser.run("document.body.textContent")
        browser.errors.clear()
        browser.open(f"{page.url}/?token=a-token", ready=READY)
        assert browser.run("location.href") == f"{page.url}/"
        assert browser.run("document.cookie") == ""
        wait_for_updates(browser)
        browser.open(page.url, ready=READY)


def test_late_page_is_grey_although_messages_arrive(
    browser: Browser, bus: FedBus, page: ServedPage
) -> None:
    """A slow connection delivers old updates at the normal rate."""
    fly(bus, 5)
    with Line(page.port) as line:
        browser.open(line.url, ready=READY)
        line.delay_s = 2.0
        is_stale = "document.body.classList.contains('stale')"
        wait_until(lambda: browser.run(is_stale), "a stale page")
        count = browser.run("live.updates")
        wait_until(lambda: browser.run("live.updates") > count + 5, "late updates")
        assert browser.run(is_stale)


def test_report_opens_when_it_is_made(browser: Browser, bus: FedBus, tmp_path: Path) -> None:
    folder = tmp_path / "captures"
    folder.mkdir()
    (folder / "flight.kcap").write_bytes(capture_bytes())
    with ServedPage(bus, None, Flights(folder, 0, tmp_path)) as page:
        ready = "document.querySelectorAll('.flight button').length > 0"
        browser.open(f"{page.url}/flights", 360, 780, phone=True, ready=ready)
        browser.run("document.querySelector('.flight button').click()")
        is_report = "location.pathname.endsWith('/report') && 'flight' in window"
        wait_until(lambda: browser.run(is_report), "the report", 60)
        assert browser.run("flight.data.plots.length") > 3
        assert browser.errors == []
        for width in (360, 768, 1440):
            browser.open(f"{page.url}/flights", width, 780, phone=width == 360, ready=ready)
            assert browser.run("document.documentElement.scrollWidth") == width


def test_flights_page_says_what_is_wrong(browser: Browser, bus: FedBus, page: ServedPage) -> None:
    browser.open(f"{page.url}/flights", ready="!/reading/.test(document.body.textContent)")
    assert "record.directory" in browser.run("document.querySelector('#problem').textContent")
