"""``status``: shows the state of a running gateway, from the statistics file that it replaces each second."""

import argparse
import json
import time
from pathlib import Path

from rich.console import Console

from kontronik_can_gw.cli.arguments import JSON, default_config, option
from kontronik_can_gw.config.keys import Config
from kontronik_can_gw.config.parse import load
from kontronik_can_gw.desk.monitor.status import Seen, lines_of, look_at
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
    JSON,
)
# fmt: on
EPILOG = (
    "Default: all gateways that run as a service; without any, that of gateway.toml in this folder. "
    "Live: watch kontronik-can-gw status. Exit code 0: running and healthy; "
    "1: running, but an ESC is not heard or nothing gets onto the CAN bus; 2: wrong usage; 3: not running, or no answer for 3 s."
)


def main(args: argparse.Namespace) -> int:
    config = None if args.config is None else load(args.config)
    given = args.file if config is None else config.statistics_path
    seen = _look(given, config)
    if not seen and config is None and (path := default_config()) is not None:
        config = load(path)
        seen = _look(config.statistics_path, config)
    if not seen and args.json:
        print(json.dumps({"gateways": []}))
    if not seen:
        which = "" if config is None else " with this configuration"
        raise NotRunning(
            f"no gateway{which} runs as a service. Start it: sudo systemctl start {PROGRAM}; "
            "or name the file of another one: --file, or statistics.file in its configuration."
        )
    if args.json:
        print(printable_json({"gateways": [each.as_json() for each in seen]}))
        return max(each.code for each in seen)
    if all(each.document is None for each in seen):
        raise NotRunning(*(each.sentence for each in seen))
    console = Console(highlight=False, soft_wrap=True)
    for number, each in enumerate(seen):
        for text in ([""] if number else []) + list(lines_of(each)):
            console.print(text)
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
