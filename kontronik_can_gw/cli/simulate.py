"""``kontronik-can-gw simulate``: simulates ESCs on pseudo terminals, with or without faults."""

import argparse
from typing import TYPE_CHECKING

from kontronik_can_gw.cli.simulate_options import Texts, add_options, time_ns, whole_number

if TYPE_CHECKING:
    from kontronik_can_gw.desk.pty import PtyEsc
    from kontronik_can_gw.esc.kontronik.simulator import Sent, SimulatedEsc

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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options, all as text: ``main`` reads them and reports every mistake at once."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    add_options(parser)


def main(args: argparse.Namespace) -> int:
    """Simulate. UserError for each bad value, RunError if a gateway transmitted or a file failed."""
    from kontronik_can_gw.errors import UserError
    from kontronik_can_gw.esc.kontronik.simulator import SimulatedEsc

    read = Texts(args)
    count = read("--esc", lambda text: whole_number(text, 1, 1000)) or 1
    seed = read("--seed", whole_number) or 0
    seconds = read("--seconds", lambda text: time_ns(text) / 1e9)
    options = [read.esc_options(number) for number in range(1, min(count, 2) + 1)]
    for option, path in (("--link", args.link), ("--out", args.out)):
        if path is not None and count > 1 and "{n}" not in path:
            read.problems.append(
                f"{option} {path}: needs {{n}} in the path, for the number of each of the {count} ESCs."
            )
    if args.out is not None and args.seconds is None:
        read.problems.append(f"--out {args.out}: has no end. Give --seconds.")
    if args.out is not None and args.link is not None:
        read.problems.append("--link: there is no pseudo terminal with --out. Give one of the two.")
    if read.problems:
        raise UserError(*dict.fromkeys(read.problems))

    escs = []
    for index in range(count):
        chosen = options[index % len(options)]
        assert chosen is not None
        # Spread over the period, since real ESCs are not synchronized.
        escs.append(
            SimulatedEsc(chosen, seed=seed + index, start_ns=chosen.period_ns * index // count)
        )
    if args.out is not None:
        assert seconds is not None
        return _to_files(escs, args.out, seconds)
    return _to_terminals(escs, args.link, seconds)


def _to_files(escs: "list[SimulatedEsc]", path: str, seconds: float) -> int:
    import sys
    from contextlib import nullcontext
    from pathlib import Path

    from kontronik_can_gw.cli import discard_output
    from kontronik_can_gw.errors import RunError
    from kontronik_can_gw.esc.kontronik.simulator import SECOND_NS

    for index, esc in enumerate(escs):
        name = path.replace("{n}", str(index + 1))
        try:
            with nullcontext(sys.stdout.buffer) if path == "-" else Path(name).open("wb") as file:
                total = frames = 0
                begin = esc.next_ns
                end = begin + round(seconds * SECOND_NS)
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
    return 0


def _to_terminals(escs: "list[SimulatedEsc]", link: str | None, seconds: float | None) -> int:
    import signal
    import sys
    from contextlib import ExitStack

    from kontronik_can_gw.cli.terminals import terminals
    from kontronik_can_gw.desk.pty import run
    from kontronik_can_gw.errors import RunError

    stopped = False

    def stop(*_: object) -> None:
        nonlocal stopped
        stopped = True

    names = [f"esc{number}" for number in range(1, len(escs) + 1)]
    with ExitStack() as stack:
        for number in (signal.SIGINT, signal.SIGTERM):
            stack.callback(signal.signal, number, signal.signal(number, stop))
        opened = stack.enter_context(terminals(names, link))
        played = [_Played(name, terminal) for name, terminal in zip(names, opened, strict=True)]
        run(
            list(zip(escs, opened, strict=True)),
            seconds=seconds,
            stop=lambda: stopped,
            on_sent=lambda index, sent, taken: played[index].count(sent, taken),
            on_received=lambda index: played[index].complain(),
        )
        for each in played:
            print(each.summary, file=sys.stderr)
    if guilty := [each.problem for each in played if each.terminal.received]:
        raise RunError(*guilty)
    return 0


class _Played:
    """An ESC on its pseudo terminal: what it sent, and what it was sent."""

    def __init__(self, name: str, terminal: "PtyEsc") -> None:
        self.name = name
        self.terminal = terminal
        self._frames = 0
        self._intact = 0
        self._complained = False

    def count(self, sent: "Sent", taken: bool) -> None:
        self._frames += 1
        self._intact += sent.intact and taken

    def complain(self) -> None:
        """Report once that the gateway transmits to the ESC."""
        import sys

        if not self._complained:
            self._complained = True
            print(
                f"ERROR: {self.name} {self.terminal.path}: the gateway transmits to the ESC: "
                f"{self.terminal.first_received.hex(' ')}",
                file=sys.stderr,
            )

    @property
    def summary(self) -> str:
        lost = self.terminal.dropped_bytes
        dropped = f", {lost} bytes dropped (nobody read)" if lost else ""
        return f"{self.name}: {self._frames} frames, {self._intact} of them intact{dropped}"

    @property
    def problem(self) -> str:
        return (
            f"{self.name} {self.terminal.path}: {self.terminal.received} bytes came from the gateway, beginning with "
            f"{self.terminal.first_received.hex(' ')}. Nothing may ever be sent to an ESC: turn echo and writing off."
        )
