"""Draws pictures of the live screen and of a report: python tests/readme/pictures.py [FOLDER]

Without FOLDER it writes the pictures of the pages into docs/pictures. With FOLDER it writes all
kinds of pictures there. `make pictures` runs it with the right path of modules.
"""

import io
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

from command_line import run
from live_bench import FedBus, ServedPage
from recordings import capture_bytes
from report_browser import MISSING, PROGRAM, Browser
from rich.console import Console
from simulated_bus import FLYING, flight, layout_of, write_log

from kontronik_can_gw.desk.live.flights import Flights
from kontronik_can_gw.desk.monitor.model import Monitor
from kontronik_can_gw.desk.monitor.screen import screen
from kontronik_can_gw.desk.sources import Source
from kontronik_can_gw.esc.kontronik.simulator import SECOND_NS, ErrorWindow, EscOptions, Faults
from kontronik_can_gw.esc.kontronik.states import OperatingError

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "pictures"
SIZES = ((80, 24), (120, 40))
VIEWS: dict[str, tuple[int, int, Any]] = {
    "desktop": (1280, 900, {}),
    "dark": (1280, 900, {"dark": True}),
    "phone": (390, 844, {"phone": True}),
}
LIVE = (
    ("live", "/", "!!(globalThis.live && live.steps().length > 200 && live.updates > 3)"),
    ("flights", "/flights", "/(Wh.*){3}/.test(document.querySelector('#flights').textContent)"),
)
"""Name, path and condition of each page of `web`."""
SHOWN = (
    "monitor_1_80.svg",
    "monitor_4_80.svg",
    "report_desktop.png",
    "live_phone.png",
    "live_desktop.png",
    "flights_phone.png",
    "flights_desktop.png",
)


def option(first_error_s: float) -> EscOptions:
    """Return the options of an ESC in flight whose battery is empty for 4 s."""
    begin = int(first_error_s * SECOND_NS)
    length = 4 * SECOND_NS
    window = ErrorWindow(OperatingError.UNDERVOLTAGE, begin, length)
    return EscOptions(profile=FLYING, faults=Faults(errors=(window,)))


def monitors(folder: Path) -> None:
    """Draw the screen of one and of four ESCs after half a minute."""
    for count in (1, 4):
        bus = layout_of([f"esc{number + 1}" for number in range(count)])
        monitor = Monitor(bus)
        source = Source("can0", bus)
        monitor.advance(0)
        for now, frame in flight(bus, 31, [option(28)]):
            monitor.take(frame, now)
            monitor.advance(now)
        for size in SIZES:
            how: Any = {"force_terminal": True, "color_system": "truecolor", "record": True}
            console = Console(file=io.StringIO(), width=size[0], **how)
            for line in screen(monitor, source, size, 0):
                console.print(line, no_wrap=True)
            picture = console.export_svg(title="kontronik-can-gw monitor", unique_id="m")
            # letters of the reader's machine, not from a server
            picture = re.sub(r"@font-face \{.*?\}\s*", "", picture, flags=re.DOTALL)
            font = "font-family: Fira Code"
            picture = picture.replace(font, f"{font}, DejaVu Sans Mono")
            (folder / f"monitor_{count}_{size[0]}.svg").write_text(picture, encoding="utf-8")


def reports(folder: Path) -> None:
    """Draw the report of two ESCs, on a desktop, in the dark and on a phone."""
    with tempfile.TemporaryDirectory() as scratch:
        log = Path(scratch, "flight.log")
        page = Path(scratch, "flight.html")
        toml = Path(scratch, "gateway.toml")
        names = ("left", "right")
        text = ""
        for name in names:
            text += f'[[esc]]\nname = "{name}"\nport = "/dev/tty{name}"\n'
            text += "pole_pairs = 7\ngear = 9.8\n"
        toml.write_text(text)
        write_log(log, flight(layout_of(names), 120, [option(70)]))
        done = run("report", log, "-c", toml, "-o", page)
        assert done.code == 0, done.err
        with Browser(Path(scratch, "profile")) as browser:
            for name, (width, height, how) in VIEWS.items():
                browser.open(page, width, height, **how)
                browser.picture(folder / f"report_{name}.png")


def live_pages(folder: Path) -> None:
    """Draw both pages of `web` for two ESCs, on a phone and on a desktop."""
    bus = FedBus(("left", "right"))
    with tempfile.TemporaryDirectory() as scratch:
        captures = Path(scratch, "captures")
        captures.mkdir()
        for day, seed in ((1, 3), (2, 4), (3, 5)):
            path = captures / f"2026010{day}T100000Z-{seed:06x}-00000.kcap"
            path.write_bytes(capture_bytes(2, seed, 20))
        flights = Flights(captures, 0, Path(scratch))
        with (
            ServedPage(bus, None, flights) as page,
            Browser(Path(scratch, "profile")) as browser,
        ):
            frames = flight(bus.bus, 290, [option(270)])
            bus.feed([(now, frame) for now, frame in frames if now < 285 * SECOND_NS])
            for name, (width, height) in {"phone": (390, 800), "desktop": (1120, 660)}.items():
                for title, place, ready in LIVE:
                    browser.open(page.url + place, width, height, ready=ready)
                    browser.settle()
                    browser.picture(folder / f"{title}_{name}.png")


def main(folder: Path) -> None:
    if PROGRAM is None:
        sys.exit(MISSING)
    with tempfile.TemporaryDirectory() as scratch:
        made = Path(scratch)
        monitors(made)
        reports(made)
        live_pages(made)
        folder.mkdir(parents=True, exist_ok=True)
        for path in sorted(made.iterdir()):
            if folder != FOLDER or path.name in SHOWN:
                (folder / path.name).write_bytes(path.read_bytes())


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER)
