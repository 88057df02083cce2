"""``status``: shows the state of a running gateway, from the statistics file that it replaces each second."""

import argparse
import json
import time
from pathlib import Path
from threading import Event

from rich.console import Console
from rich.text import Text

from kontronik_can_gw.cli.arguments import JSON, number_from, option
from kontronik_can_gw.cli.common import stopping_on_signals
from kontronik_can_gw.config.keys import Config
from kontronik_can_gw.config.parse import load
from kontronik_can_gw.desk.monitor import terminal
from kontronik_can_gw.desk.monitor.lines import BAD, FAINT, line, wrapped
from kontronik_can_gw.desk.monitor.status import Seen, look_at, screen
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.printable import printable, printable_json

PROGRAM = "kontronik-can-gw"
RUN_FOLDER = Path("/run")


class NotRunning(RunError):
    """No gateway runs."""

    exit_code = 3


# fmt: off
OPTIONS = (
    (
        option("-c --config FILE", "the gateway with this TOML configuration", type=Path),
        option("--file FILE", "the gateway with this statistics file", type=Path),
    ),
    option("--once", "show it once, as in a pipe (default on a terminal: live)"),
    JSON,
    option("--interval S", "live: interval in seconds (default 1)", type=number_from(0.1, 3600), default=1.0),
)
# fmt: on
EPILOG = (
    "Default: all gateways that run as a service. Exit code 0: running and healthy (also at the end of the live display); "
    "1: running, but an ESC is not heard or nothing gets onto the CAN bus; 2: wrong usage; 3: not running, or no answer for 3 s."
)


def main(args: argparse.Namespace) -> int:
    config = None if args.config is None else load(args.config)
    given = args.file if config is None else config.statistics_path
    seen = _look(given, config)
    if not seen:
        if args.json:
            print(json.dumps({"gateways": []}))
        raise NotRunning(_no_file(config))
    if args.json:
        print(printable_json({"gateways": [each.as_json() for each in seen]}))
        return max(each.code for each in seen)
    if all(each.document is None for each in seen):
        raise NotRunning(*(each.sentence for each in seen))
    console = Console(highlight=False)
    if not args.once and terminal.is_screen(console):
        _live(console, given, config, args.interval)
        return 0
    for text in _joined([screen(each) for each in seen]):
        if console.is_terminal:
            console.print(text, soft_wrap=True)
        else:
            print(text.plain.rstrip())
    return max(each.code for each in seen)


def _look(given: Path | None, config: Config | None) -> list[Seen]:
    """The gateway with the given file; else those that run as a service, with this configuration if there is one."""
    now = time.monotonic_ns()
    if given is not None:
        return [look_at(given, now)]
    plain = RUN_FOLDER / PROGRAM / "status.json"
    instances = sorted(RUN_FOLDER.glob(f"{PROGRAM}-*/status.json"))
    seen = [look_at(file, now) for file in (plain, *instances) if file.exists()]
    if config is None:
        return seen
    wanted = printable(str(Path(config.file).absolute()))
    return [each for each in seen if each.document and each.document["configuration"] == wanted]


def _no_file(config: Config | None) -> str:
    if config is not None:
        return (
            f"{config.file}: no gateway with this configuration runs as a service, and statistics.file is not set. "
            f"Start it: sudo systemctl start {PROGRAM}, or set statistics.file."
        )
    return (
        f"no gateway runs as a service: there is no {RUN_FOLDER}/{PROGRAM}/status.json. "
        f"Start it: sudo systemctl start {PROGRAM}; or name the file of another one: --file, or -c and its configuration."
    )


def _joined(parts: list[list[Text]]) -> list[Text]:
    """The gateways one after the other."""
    return [each for part in parts for each in ([*part, line()])][:-1]


def _live(console: Console, given: Path | None, config: Config | None, interval: float) -> None:
    """Refresh the display until a key, SIGINT or SIGTERM."""
    stop = Event()

    def draw(size: tuple[int, int], keys: bool) -> list[Text]:
        width, height = size
        seen = _look(given, config)
        share = max(3, (height - 1 - len(seen)) // max(1, len(seen)))
        lines = _joined([screen(each, (width, share)) for each in seen])
        lines = (lines or wrapped(_no_file(config), BAD, width))[: height - 1]
        for each in lines:
            each.truncate(width, overflow="ellipsis")
        blank = [line()] * (height - 1 - len(lines))
        return [*lines, *blank, line(("q quit" if keys else "Ctrl-C ends", FAINT))]

    def step(until_s: float) -> bool:
        return not stop.wait(max(0.0, until_s - time.monotonic()))

    with stopping_on_signals(stop.set):
        terminal.show(console, draw, step, interval)
