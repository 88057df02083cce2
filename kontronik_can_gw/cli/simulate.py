"""``kontronik-can-gw simulate``: simulates ESCs on pseudo terminals, with or without faults."""

import argparse
import re
from collections.abc import Callable
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from kontronik_can_gw.esc.kontronik import Device, Layout
    from kontronik_can_gw.esc.kontronik.simulator import (
        Dropout,
        ErrorWindow,
        EscOptions,
        SimulatedEsc,
        Swap,
    )

T = TypeVar("T")

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
    what = parser.add_argument_group("what ESC")
    what.add_argument("--esc", metavar="N", default="1", help="number of ESCs, 1..1000 (default 1)")
    what.add_argument(
        "--device",
        metavar="NAME",
        help="kosmik, kolibri, jivepro, kontrol-x or uhv (default: kosmik, in the legacy layout jivepro)",
    )
    what.add_argument(
        "--layout",
        metavar="LAYOUT",
        help="v4, legacy, or mixed: odd ESCs v4, even ones legacy (default: legacy for jivepro, else v4)",
    )
    what.add_argument("--variant", metavar="N", default="120", help="device variant (default 120)")
    what.add_argument(
        "--firmware", metavar="MAIN.SUB", default="4.17", help="firmware version (default 4.17)"
    )
    what.add_argument("--cells", metavar="N", default="6", help="cell count (default 6)")
    how = parser.add_argument_group("how it sends")
    how.add_argument(
        "--rate", metavar="HZ", default="100", help="live frames a second, 0.1..10000 (default 100)"
    )
    how.add_argument(
        "--info-every",
        metavar="N",
        default="100",
        help="an info frame each N frames, 0 never (default 100)",
    )
    how.add_argument(
        "--info-replaces",
        action="store_true",
        help="info frames replace live frames (default: they follow them)",
    )
    how.add_argument(
        "--idle",
        action="store_true",
        help="the motor never runs (default: a repeating flight of 50 s)",
    )
    how.add_argument("--seconds", metavar="S", help="stop after this TIME")
    how.add_argument(
        "--seed", metavar="N", default="0", help="seed of all that is random (default 0)"
    )
    where = parser.add_argument_group("where to")
    where.add_argument(
        "--link",
        metavar="PATH",
        help="symbolic link to the pseudo terminal; {n} is the ESC's number, from 1",
    )
    where.add_argument(
        "--out",
        metavar="FILE",
        help="write the bytes to FILE (- for standard output) as fast as possible, no pseudo terminal; {n} as for --link",
    )
    faults = parser.add_argument_group("misbehaviour")
    faults.add_argument(
        "--noise", metavar="MEAN", default="0", help="mean number of random bytes before a frame"
    )
    faults.add_argument(
        "--lose-bytes", metavar="SHARE", default="0", help="share of bytes that get lost"
    )
    faults.add_argument(
        "--flip-bits", metavar="SHARE", default="0", help="share of bits that are flipped"
    )
    faults.add_argument(
        "--dropout", metavar="TIME/TIME", help="length and interval of silences: 2s/10s"
    )
    faults.add_argument(
        "--error",
        metavar="NAME@TIME[+TIME]",
        action="append",
        default=[],
        help="set an error bit at a time, for a time or for ever; may be repeated",
    )
    faults.add_argument(
        "--swap-device",
        metavar="NAME[:LAYOUT]@TIME",
        action="append",
        default=[],
        help="plug in another device at a time; may be repeated",
    )


def main(args: argparse.Namespace) -> int:
    """Simulate. UserError for each bad value, RunError if a gateway transmitted or a file failed."""
    from kontronik_can_gw.errors import UserError
    from kontronik_can_gw.esc.kontronik.simulator import SimulatedEsc

    read = _Options(args)
    count = read("--esc", args.esc, lambda text: _integer(text, 1, 1000)) or 1
    seed = read("--seed", args.seed, _integer) or 0
    seconds = (
        None
        if args.seconds is None
        else read("--seconds", args.seconds, lambda text: _time(text) / 1e9)
    )
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
                _discard_output()
            raise RunError(f"--out {name}: cannot be written: {error.strerror}.") from None
        print(f"esc{index + 1}: {frames} frames, {total} bytes to {name}", file=sys.stderr)
    return 0


def _to_terminals(escs: "list[SimulatedEsc]", link: str | None, seconds: float | None) -> int:
    import signal
    import sys
    from contextlib import ExitStack

    from kontronik_can_gw.desk.pty import PtyEsc, run
    from kontronik_can_gw.errors import RunError
    from kontronik_can_gw.esc.kontronik.simulator import Sent

    stopped = False

    def stop(*_: object) -> None:
        nonlocal stopped
        stopped = True

    sent_frames = [0] * len(escs)
    intact_frames = [0] * len(escs)

    def count(index: int, sent: Sent, taken: bool) -> None:
        sent_frames[index] += 1
        intact_frames[index] += sent.intact and taken

    def complain(index: int) -> None:
        terminal = terminals[index]
        if index not in complained:
            complained.add(index)
            first = terminal.first_received.hex(" ")
            print(
                f"ERROR: esc{index + 1} {terminal.path}: the gateway transmits to the ESC: {first}",
                file=sys.stderr,
            )

    complained: set[int] = set()
    with ExitStack() as stack:
        for number in (signal.SIGINT, signal.SIGTERM):
            stack.callback(signal.signal, number, signal.signal(number, stop))
        terminals = [
            stack.enter_context(PtyEsc(link and link.replace("{n}", str(index + 1))))
            for index in range(len(escs))
        ]
        for index, terminal in enumerate(terminals):
            print(f"esc{index + 1} {terminal.path}")
        sys.stdout.flush()
        run(
            list(zip(escs, terminals, strict=True)),
            seconds=seconds,
            stop=lambda: stopped,
            on_sent=count,
            on_received=complain,
        )
        for index, terminal in enumerate(terminals):
            dropped = (
                f", {terminal.dropped_bytes} bytes dropped (nobody read)"
                if terminal.dropped_bytes
                else ""
            )
            print(
                f"esc{index + 1}: {sent_frames[index]} frames, {intact_frames[index]} of them intact{dropped}",
                file=sys.stderr,
            )
        guilty = [
            f"esc{index + 1} {terminal.path}: {terminal.received} bytes came from the gateway, beginning with "
            f"{terminal.first_received.hex(' ')}. Nothing may ever be sent to an ESC: turn echo and writing off."
            for index, terminal in enumerate(terminals)
            if terminal.received
        ]
    if guilty:
        raise RunError(*guilty)
    return 0


def _discard_output() -> None:
    """Discard the buffered standard output."""
    import os
    import sys

    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class _Options:
    """Parses option texts and collects their mistakes."""

    def __init__(self, args: argparse.Namespace) -> None:
        self._args = args
        self.problems: list[str] = []

    def __call__(self, option: str, text: str, parse: Callable[[str], T]) -> T | None:
        """The parsed value, or None and a problem."""
        try:
            return parse(text)
        except ValueError as error:
            self.problems.append(
                f"{option} {text}: {error}" + ("" if str(error).endswith("?") else ".")
            )
            return None

    def esc_options(self, number: int) -> "EscOptions | None":
        """Options of the ESC with this number, from 1."""
        from kontronik_can_gw.esc.kontronik import Device, Layout
        from kontronik_can_gw.esc.kontronik.simulator import FLIGHT, IDLE, EscOptions, Faults

        args = self._args
        device = None if args.device is None else self("--device", args.device, _device)
        layout = None
        if args.layout is not None and args.layout.lower() == "mixed":
            layout = Layout.V4 if number % 2 else Layout.LEGACY
        elif args.layout is not None:
            layout = self("--layout", args.layout, lambda text: _layout(text, "mixed"))
        if device is None:
            device = Device.JIVEPRO if layout is Layout.LEGACY else Device.KOSMIK
        values: dict[str, Any] = {
            "variant": self("--variant", args.variant, lambda text: _integer(text, 0, 1023)),
            "firmware": self("--firmware", args.firmware, _firmware),
            "cell_count": self("--cells", args.cells, lambda text: _integer(text, 1, 100)),
            "period_ns": self(
                "--rate", args.rate, lambda text: round(1e9 / _number(text, 0.1, 10_000))
            ),
            "info_every": self(
                "--info-every", args.info_every, lambda text: _integer(text, 0, 1_000_000)
            ),
        }
        faults: dict[str, Any] = {
            "noise": self("--noise", args.noise, lambda text: _number(text, 0, 1000)),
            "lost_bytes": self("--lose-bytes", args.lose_bytes, _share),
            "flipped_bits": self("--flip-bits", args.flip_bits, _share),
            "dropout": None if args.dropout is None else self("--dropout", args.dropout, _dropout),
            "errors": tuple(self("--error", text, _error) for text in args.error),
        }
        swaps = [
            swap
            for text in args.swap_device
            if (swap := self("--swap-device", text, _swap)) is not None
        ]
        swaps.sort(key=lambda swap: swap.time_ns)
        if self.problems:
            return None
        return EscOptions(
            device=device,
            layout=layout,
            info_replaces=args.info_replaces,
            profile=IDLE if args.idle else FLIGHT,
            faults=Faults(**faults, swaps=tuple(swaps)),
            **values,
        )


def _integer(text: str, low: int | None = None, high: int | None = None) -> int:
    if not re.fullmatch(r"[+-]?[0-9]{1,18}", text):
        raise ValueError("not a whole number")
    value = int(text)
    if (low is not None and value < low) or (high is not None and value > high):
        raise ValueError(f"outside {low}..{high}")
    return value


def _number(text: str, low: float, high: float) -> float:
    try:
        value = float(text)
    except ValueError:
        raise ValueError("not a number") from None
    if not low <= value <= high:
        raise ValueError(f"outside {low}..{high}")
    return value


def _share(text: str) -> float:
    try:
        return (
            _number(text.removesuffix("%"), 0, 100) / 100
            if text.endswith("%")
            else _number(text, 0, 1)
        )
    except ValueError as error:
        raise ValueError(f"{error}. Give a share such as 0.001 or 0.1%") from None


def _time(text: str) -> int:
    """A TIME in nanoseconds."""
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]*)?|\.[0-9]+)\s*(ms|s|min|h|)", text.strip())
    if not match:
        raise ValueError(f"{text!r} is not a time. Give for example 5s, 200ms or 2min")
    value = float(match[1]) * {"ms": 1e6, "s": 1e9, "": 1e9, "min": 60e9, "h": 3600e9}[match[2]]
    if value > 1e18:
        raise ValueError(f"{text!r} is more than 30 years")
    return round(value)


def _choice(text: str, choices: dict[str, T]) -> T:
    """The choice with this name; case, ``-``, ``_`` and blanks are ignored."""
    plain = {re.sub(r"[-_ ]", "", name).lower(): name for name in choices}
    key = re.sub(r"[-_ ]", "", text).lower()
    if key in plain:
        return choices[plain[key]]
    near = get_close_matches(key, plain, 1)
    if near:
        raise ValueError(f"no such name as {text!r}. Did you mean {plain[near[0]]}?")
    raise ValueError(f"no such name as {text!r}. There are: {', '.join(choices)}")


def _device(text: str) -> "Device":
    from kontronik_can_gw.esc.kontronik import Device

    return _choice(text, {device.text.lower(): device for device in Device})


def _layout(text: str, *more: str) -> "Layout":
    from kontronik_can_gw.esc.kontronik import Layout

    names = {layout.value: layout for layout in Layout}
    if text.lower() not in names:
        raise ValueError(f"no such layout. There are: {', '.join((*names, *more))}")
    return names[text.lower()]


def _firmware(text: str) -> tuple[int, int]:
    main_version, dot, sub = text.partition(".")
    if not dot:
        raise ValueError("not a version. Give for example 1.14")
    return _integer(main_version, 0, 255), _integer(sub, 0, 255)


def _dropout(text: str) -> "Dropout":
    from kontronik_can_gw.esc.kontronik.simulator import Dropout

    duration, slash, interval = text.partition("/")
    if not slash:
        raise ValueError(
            "the interval is missing. Give for example 2s/10s: 2 s of silence in every 10 s"
        )
    dropout = Dropout(_time(duration), _time(interval))
    if dropout.duration_ns >= dropout.interval_ns:
        raise ValueError("the silence must be shorter than the interval. Give for example 2s/10s")
    return dropout


def _error(text: str) -> "ErrorWindow":
    from kontronik_can_gw.esc.kontronik import OperatingError, SelfTestError
    from kontronik_can_gw.esc.kontronik.simulator import ErrorWindow

    name, at, when = text.partition("@")
    bits: dict[str, OperatingError | SelfTestError] = {bit.text: bit for bit in OperatingError}
    bits |= {bit.text: bit for bit in SelfTestError}
    bit = _choice(name, bits)
    if not at:
        raise ValueError("the time is missing. Give for example undervoltage@5s+2s")
    start, plus, duration = when.partition("+")
    return ErrorWindow(bit, _time(start), _time(duration) if plus else None)


def _swap(text: str) -> "Swap":
    from kontronik_can_gw.esc.kontronik.simulator import Swap

    what, at, when = text.partition("@")
    name, colon, layout = what.partition(":")
    device = _device(name)
    if not at:
        raise ValueError("the time is missing. Give for example kolibri@20s or jivepro:legacy@20s")
    return Swap(_time(when), device, _layout(layout) if colon else None)
