"""``status``: shows the state of running gateways.

It is read from their status files, which they replace every second.
"""

import argparse
import time
from pathlib import Path

from rich.console import Console

from kontronik_can_gw.cli import say
from kontronik_can_gw.cli.arguments import CONFIG, JSON, default_config, option
from kontronik_can_gw.desk.monitor.status import (
    NOT_RUNNING,
    TROUBLE,
    Seen,
    lines_of,
    look_at,
    look_at_first,
    possible_files,
    published_files,
)
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.printable import printable_json
from kontronik_can_gw.runtime.status.snapshot import PROGRAM


class NotRunning(RunError):
    """No gateway runs."""

    exit_code = 3


OPTIONS = (
    (
        *CONFIG,
        option("--file FILE", "show the gateway with this statistics file", type=Path),
    ),
    JSON,
)
EPILOG = (
    "Without options it shows all gateways of this user and of the system. "
    "For a live view run: watch kontronik-can-gw status. Exit codes: 0 running and healthy; "
    "1 running, but there is no telemetry of an ESC, nothing gets onto the CAN bus or the bus is "
    "slow, CANopen parameters or captures cannot be stored, or one of several gateways does not "
    "answer; 2 wrong usage; 3 no gateway runs, or it has not answered for 3 s."
)


def main(args: argparse.Namespace) -> int:
    seen = _seen(args, time.monotonic_ns())
    if args.json:
        print(printable_json({"gateways": [each.as_json() for each in seen]}))
    if not seen:
        raise NotRunning(
            "no gateway of this user or of the system runs. Start one: "
            "kontronik-can-gw run -c FILE, "
            f"or as a service: sudo systemctl start {PROGRAM}"
        )
    codes = {each.code for each in seen}
    # a gateway that has stopped is a fault while another one runs
    code = NOT_RUNNING if codes == {NOT_RUNNING} else min(max(codes), TROUBLE)
    if args.json:
        return code
    if all(each.document is None for each in seen):
        raise NotRunning(*(each.sentence for each in seen))
    console = Console(highlight=False, soft_wrap=True)
    for number, each in enumerate(seen):
        if number:
            console.print()
        for text in lines_of(each):
            console.print(text)
    return code


def _seen(args: argparse.Namespace, now: int) -> list[Seen]:
    """Return the gateway that the options name, or all, or the one of the configuration here."""
    if args.file:
        return [look_at(args.file, now)]
    if args.config:
        return [look_at_first(possible_files(args.config), now, args.config)]
    seen = [look_at(file, now) for file in published_files()]
    config = default_config()
    if not seen and config is not None:
        try:
            return [look_at_first(possible_files(config), now, config)]
        except UserError as error:  # a running gateway was not started with this file
            for problem in error.problems:
                say(f"warning: {problem}", "status")
    return seen
