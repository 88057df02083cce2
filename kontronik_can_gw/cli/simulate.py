"""``simulate``: simulates ESCs on pseudo terminals, with or without faults."""

import argparse
import re
import sys
from argparse import ArgumentTypeError
from threading import Event
from typing import IO

from kontronik_can_gw.cli.arguments import FORCE, number_from, option
from kontronik_can_gw.cli.common import stopping_on_signals
from kontronik_can_gw.cli.desk import terminals
from kontronik_can_gw.cli.output import check_output, writing
from kontronik_can_gw.desk.pty import run
from kontronik_can_gw.errors import RunError, UserError, did_you_mean
from kontronik_can_gw.esc.kontronik.simulator import (
    Device,
    Dropout,
    ErrorWindow,
    EscOptions,
    Faults,
    OperatingError,
    SelfTestError,
    SimulatedEsc,
    WireLayout,
)
from kontronik_can_gw.times import SECOND

_DEVICES = {device.text.lower(): device for device in Device}
_BITS: dict[str, OperatingError | SelfTestError] = {}
_BITS.update({bit.text: bit for bit in OperatingError})
_BITS.update({bit.text: bit for bit in SelfTestError})
_UNITS = {"ms": 1e6, "s": 1e9, "": 1e9, "min": 60e9, "h": 3600e9}
_LONGEST_H = 999_999
"""Longer times do not fit into the 64 bits of a time in ns."""


def _time_ns(text: str) -> int:
    """Return a TIME in nanoseconds. A type for argparse."""
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]*)?)\s*(ms|s|min|h|)", text.strip())
    if not match:
        raise ArgumentTypeError(f"{text!r} is not a time. Give for example 5s, 200ms or 2min")
    time_ns = float(match[1]) * _UNITS[match[2]]
    if time_ns > _LONGEST_H * _UNITS["h"]:
        raise ArgumentTypeError(f"{text!r} is too long. Give at most {_LONGEST_H}h")
    return round(time_ns)


def _dropout(text: str) -> Dropout:
    duration, _, interval = text.partition("/")
    dropout = Dropout(_time_ns(duration), _time_ns(interval or "0"))
    if dropout.duration_ns >= dropout.interval_ns:
        raise ArgumentTypeError(
            f"{text!r} is not a length and a longer interval. Give for example 2s/10s"
        )
    return dropout


def _error(text: str) -> ErrorWindow:
    name, _, when = text.partition("@")
    start, plus, duration = when.partition("+")
    key = name.lower().replace("-", "_")
    if key not in _BITS:
        near = did_you_mean(key, _BITS, or_known=True)
        raise ArgumentTypeError(f"{name!r} is not an error bit.{near}")
    if not start:
        raise ArgumentTypeError(f"{text!r}: has no time. Give for example undervoltage@5s+2s")
    return ErrorWindow(_BITS[key], _time_ns(start), _time_ns(duration) if plus else None)


OPTIONS = (
    "the ESC",
    option(
        "--esc N",
        "number of ESCs, 1..1000 (default 1)",
        type=number_from(1, 1000, "number of ESCs", kind=int),
        default=1,
    ),
    option(
        "--device NAME",
        f"{', '.join(_DEVICES)} (default: kosmik, in the legacy layout jivepro)",
        choices=tuple(_DEVICES),
    ),
    option("--layout", "default: legacy for jivepro, else v4", choices=("v4", "legacy")),
    option("--seed N", "seed of all random data (default 0)", type=int, default=0),
    "output and duration",
    option(
        "--link PATH", "symbolic link to the pseudo terminal; {n} is the number of the ESC, from 1"
    ),
    option(
        "-o --output --out FILE",
        "write the bytes to FILE (- for standard output) as fast as possible instead of to a "
        "pseudo "
        "terminal; {n} as in --link",
    ),
    FORCE,
    option("--seconds TIME", "stop after this time", type=_time_ns),
    "faults",
    option(
        "--flip-bits SHARE",
        "share of bits to flip, for example 0.0001",
        type=number_from(0, 1, "share"),
        default=0.0,
    ),
    option(
        "--dropout TIME/TIME",
        "length and interval of silent periods, for example 2s/10s",
        type=_dropout,
    ),
    option(
        "--error NAME@TIME[+TIME]",
        "set an error bit at this time, for a time or until the end; may be repeated",
        type=_error,
        action="append",
        default=[],
    ),
)
EPILOG = """\
Prints a line such as "esc1 /dev/pts/5" for each ESC, then sends until SIGINT,
SIGTERM or --seconds. The same options and seed give the same bytes. Several
ESCs have the seeds N, N+1 and so on. If a gateway sends anything to the ESC,
even an echo, this is an error (exit code 1), because a real ESC could take it
for a command.

TIME is 5s, 200ms, 2min or a number of seconds.
Names of errors are as printed by decode, for example undervoltage or
test_short_to_ground.

examples:
  kontronik-can-gw simulate --esc 2 --link /tmp/esc{n}
  kontronik-can-gw simulate --error undervoltage@5s+2s --dropout 2s/10s
  kontronik-can-gw simulate --seconds 60 -o flight.bytes

exit codes: 0 done; 1 failed while running, or a gateway transmitted; 2 wrong
usage
"""


def main(args: argparse.Namespace) -> int:
    """Simulate ESCs.

    Raises UserError for wrong usage, and RunError if a gateway transmitted or a file failed.
    """
    for name, path in (("--link", args.link), ("-o", args.output)):
        if path is not None and args.esc > 1 and "{n}" not in path:
            raise UserError(
                f"{name} {path}: needs {{n}} in the path, for the number of each of the "
                f"{args.esc} ESCs."
            )
    if args.output is not None:
        if args.seconds is None:
            raise UserError(f"-o {args.output}: would never end. Give --seconds.")
        if args.link is not None:
            raise UserError(
                "--link: cannot be combined with -o, which opens no pseudo terminal. "
                "Give one of them."
            )
    device = args.device or ("jivepro" if args.layout == "legacy" else "kosmik")
    options = EscOptions(
        device=_DEVICES[device],
        layout=None if args.layout is None else WireLayout(args.layout),
        faults=Faults(flipped_bits=args.flip_bits, dropout=args.dropout, errors=tuple(args.error)),
    )
    # their starts are spread over the period, because real ESCs are not synchronized
    escs = [
        SimulatedEsc(options, args.seed + index, options.period_ns * index // args.esc)
        for index in range(args.esc)
    ]
    if args.output is not None:
        _to_files(
            escs,
            args.output,
            args.seconds,
            force=args.force,
        )
    else:
        _to_terminals(escs, args.link, args.seconds)
    return 0


def _to_files(escs: list[SimulatedEsc], output: str, time_ns: int, *, force: bool) -> None:
    numbers = range(1, len(escs) + 1)
    names = [output.replace("{n}", str(number)) for number in numbers]
    for name in names:
        check_output(name, (), force=force)
    for number, (esc, name) in enumerate(zip(escs, names, strict=True), 1):
        with writing(name, force=force) as out:
            frames, total = _write_frames(esc, out.open(), time_ns)
            out.is_whole = True
        print(f"esc{number}: {frames} frames, {total} bytes to {name}", file=sys.stderr)


def _write_frames(esc: SimulatedEsc, file: IO[bytes], time_ns: int) -> tuple[int, int]:
    """Write the bytes that an ESC sends within a time. Return the numbers of frames and bytes.

    The loop is not in a ``with`` block: Python 3.13 leaves such a block without its ``__exit__`` if
    a signal arrives as a ``while`` loop repeats.
    """
    frames = 0
    total = 0
    now = esc.next_ns
    end = now + time_ns
    while now < end:  # steps of a minute limit the memory, even for a year
        now = min(now + 60 * SECOND, end)
        for sent in esc.frames_until(now - 1):
            file.write(sent.wire)
            total += len(sent.wire)
            frames += 1
    return frames, total


def _to_terminals(escs: list[SimulatedEsc], link: str | None, time_ns: int | None) -> None:
    names = [f"esc{number}" for number in range(1, len(escs) + 1)]
    stop = Event()
    guilty: dict[int, str] = {}
    """Message about each ESC to which a gateway transmitted."""
    with stopping_on_signals(stop.set), terminals(names, link) as opened:

        def complain(index: int) -> None:
            """Report once that the gateway transmits to the ESC."""
            if index not in guilty:
                first = opened[index].first_received.hex(" ")
                guilty[index] = (
                    f"{names[index]} {opened[index].path}: the gateway transmits to the ESC: "
                    f"{first}"
                )
                print(f"ERROR: {guilty[index]}", file=sys.stderr)

        run(
            list(zip(escs, opened, strict=True)),
            seconds=None if time_ns is None else time_ns / SECOND,
            stop=stop.is_set,
            on_received=complain,
        )
        for name, terminal in zip(names, opened, strict=True):
            lost = terminal.dropped_bytes
            dropped = f", {lost} bytes dropped (not read)" if lost else ""
            counts = f"{terminal.frames} frames, {terminal.intact} of them intact{dropped}"
            print(f"{name}: {counts}", file=sys.stderr)
    if guilty:
        remedy = "Nothing may ever be sent to an ESC. Turn echo and writing off."
        raise RunError(*(f"{guilty[index]}. {remedy}" for index in sorted(guilty)))
