"""``status``: shows the state of a running gateway, from the statistics file that it replaces each second."""

import argparse
import time
from pathlib import Path

from rich.console import Console

from kontronik_can_gw.cli.arguments import JSON, default_config, option
from kontronik_can_gw.desk.monitor.status import RUN_FOLDER, lines_of, look_at, status_file
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.printable import printable_json
from kontronik_can_gw.runtime.snapshot import PROGRAM


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
    "Default: all gateways that run as a service; without any, that of gateway.toml. "
    "Live: watch kontronik-can-gw status. Exit code 0: running and healthy; "
    "1: running, but an ESC is not heard or nothing gets onto the CAN bus; 2: wrong usage; 3: not running, or no answer for 3 s."
)


def main(args: argparse.Namespace) -> int:
    now = time.monotonic_ns()
    files = sorted(RUN_FOLDER.glob(f"{PROGRAM}*/status.json"))
    config = args.config or (None if args.file or files else default_config())
    if args.file or config:
        files = [args.file or status_file(config)]
    seen = [look_at(file, now, None if args.file else config) for file in files]
    if args.json:
        print(printable_json({"gateways": [each.as_json() for each in seen]}))
    if not seen:
        raise NotRunning(
            f"no gateway runs as a service. Start it: sudo systemctl start {PROGRAM}; "
            "or name the file of another one: --file, or statistics.file in its configuration."
        )
    if args.json:
        return max(each.code for each in seen)
    if all(each.document is None for each in seen):
        raise NotRunning(*(each.sentence for each in seen))
    console = Console(highlight=False, soft_wrap=True)
    for number, each in enumerate(seen):
        for text in ([""] if number else []) + list(lines_of(each)):
            console.print(text)
    return max(each.code for each in seen)
