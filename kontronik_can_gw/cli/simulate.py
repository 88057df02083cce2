"""``simulate``: simulates ESCs on pseudo terminals, with or without faults."""

import argparse
import sys
from collections import Counter
from contextlib import nullcontext
from pathlib import Path
from threading import Event

from kontronik_can_gw.cli import discard_output
from kontronik_can_gw.cli.common import stopping_on_signals
from kontronik_can_gw.cli.simulate_options import OPTIONS as OPTIONS
from kontronik_can_gw.cli.simulate_options import esc_options, mistakes
from kontronik_can_gw.cli.terminals import terminals
from kontronik_can_gw.desk.pty import run
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.esc.kontronik.simulator import SECOND_NS, Sent, SimulatedEsc

EPILOG = """\
Prints a line "esc1 /dev/pts/5" for each ESC on standard output, then sends until SIGINT, SIGTERM or --seconds.
The same options and seed give the same bytes. Each ESC of several has a seed of its own (N, N+1, ...).
Whatever a gateway sends to the ESC, an echo included, is reported as an error (exit code 1): a real ESC could take
it for a command.

TIME is 5s, 200ms, 2min or a number of seconds. SHARE is 0.001 or 0.1%.
Error names are those that decode prints, such as undervoltage or test_short_to_ground.

examples:
  kontronik-can-gw simulate --esc 2 --link /tmp/esc{n}
  kontronik-can-gw simulate --device jivepro --error undervoltage@5s+2s --dropout 2s/10s
  kontronik-can-gw simulate --noise 3 --lose-bytes 0.1% --swap-device kolibri@20s --swap-device jivepro:legacy@40s
  kontronik-can-gw simulate --seconds 60 --out - | kontronik-can-gw decode - --csv > flight.csv

exit codes: 0 done, 1 failed while running or a gateway transmitted, 2 wrong usage
"""


def main(args: argparse.Namespace) -> int:
    """Simulate. UserError for each bad value, RunError if a gateway transmitted or a file failed."""
    problems = mistakes(args)
    has_several = isinstance(args.esc, int) and args.esc > 1
    for option, path in (("--link", args.link), ("--out", args.out)):
        if path is not None and has_several and "{n}" not in path:
            problems.append(
                f"{option} {path}: needs {{n}} in the path, for the number of each of the {args.esc} ESCs."
            )
    if args.out is not None and args.seconds is None:
        problems.append(f"--out {args.out}: has no end. Give --seconds.")
    if args.out is not None and args.link is not None:
        problems.append("--link: there is no pseudo terminal with --out. Give one of the two.")
    if problems:
        raise UserError(*problems)
    escs = []
    for index in range(args.esc):
        chosen = esc_options(args, index + 1)
        # spread over the period, since real ESCs are not synchronized
        start_ns = chosen.period_ns * index // args.esc
        escs.append(SimulatedEsc(chosen, seed=args.seed + index, start_ns=start_ns))
    if args.out is not None:
        _to_files(escs, args.out, args.seconds)
    else:
        _to_terminals(escs, args.link, args.seconds)
    return 0


def _to_files(escs: list[SimulatedEsc], path: str, time_ns: int) -> None:
    for index, esc in enumerate(escs):
        name = path.replace("{n}", str(index + 1))
        try:
            with nullcontext(sys.stdout.buffer) if path == "-" else Path(name).open("wb") as file:
                total = frames = 0
                begin, end = esc.next_ns, esc.next_ns + time_ns
                while begin < end:  # in steps of a minute, so that a year fits
                    begin = min(begin + 60 * SECOND_NS, end)
                    for sent in esc.frames_until(begin - 1):
                        file.write(sent.wire)
                        total += len(sent.wire)
                        frames += 1
                file.flush()
        except BrokenPipeError:
            raise
        except OSError as error:
            if path == "-":
                discard_output()
            raise RunError(f"--out {name}: cannot be written: {error.strerror}.") from None
        print(f"esc{index + 1}: {frames} frames, {total} bytes to {name}", file=sys.stderr)


def _to_terminals(escs: list[SimulatedEsc], link: str | None, time_ns: int | None) -> None:
    names = [f"esc{number}" for number in range(1, len(escs) + 1)]
    stop, frames, intact, guilty = Event(), Counter[int](), Counter[int](), dict[int, str]()
    with stopping_on_signals(stop.set), terminals(names, link) as opened:

        def count(index: int, sent: Sent, taken: bool) -> None:
            frames[index] += 1
            intact[index] += sent.intact and taken

        def complain(index: int) -> None:
            """Report once that the gateway transmits to the ESC."""
            if index not in guilty:
                guilty[index] = f"{names[index]} {opened[index].path}: "
                said = f"the gateway transmits to the ESC: {opened[index].first_received.hex(' ')}"
                print(f"ERROR: {guilty[index]}{said}", file=sys.stderr)

        run(
            list(zip(escs, opened, strict=True)),
            seconds=None if time_ns is None else time_ns / SECOND_NS,
            stop=stop.is_set,
            on_sent=count,
            on_received=complain,
        )
        for index, terminal in enumerate(opened):
            lost = terminal.dropped_bytes
            dropped = f", {lost} bytes dropped (nobody read)" if lost else ""
            print(
                f"{names[index]}: {frames[index]} frames, {intact[index]} of them intact{dropped}",
                file=sys.stderr,
            )
    if guilty:
        raise RunError(
            *(
                f"{where}{opened[index].received} bytes came from the gateway, beginning with "
                f"{opened[index].first_received.hex(' ')}. Nothing may ever be sent to an ESC: turn echo and writing off."
                for index, where in sorted(guilty.items())
            )
        )
