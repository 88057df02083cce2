"""``monitor``: a live screen of one to eight ESCs, from the CAN bus by the DBC or from a recording. It never sends anything."""

import argparse
import codecs
import contextlib
import io
import os
import select
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self

from kontronik_can_gw.cli.arguments import number_from
from kontronik_can_gw.cli.bus_layout import add_layout_arguments, bus_layout
from kontronik_can_gw.cli.common import say, stopping_on_signals
from kontronik_can_gw.config.assemble import check_devices
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.printable import printable_json

if TYPE_CHECKING:
    from rich.console import Console

    from kontronik_can_gw.cli.monitor_screen import Choice, Glyphs, Where
    from kontronik_can_gw.config.keys import CanConfig
    from kontronik_can_gw.desk.monitor.model import Monitor
    from kontronik_can_gw.desk.recordings.inputs import Input
    from kontronik_can_gw.desk.recordings.layouts import BusLayout
    from kontronik_can_gw.frames import CanFrame

_REFRESH_S = 0.15
_PLAIN_LINE_S = 1.0
_ONCE_S = 3.0
_MAX_LAG_S = 0.5
_SUFFIX_OF_UTF8 = "utf-8"
_LOOK_BACK = 1 << 20
"""Bytes to read at a capture's end; a block is far shorter."""

EPILOG = """\
Without FILE it listens on the CAN bus, at any place: it only needs the DBC (-c, --dbc) and never sends a frame.
With -c the interface and the channel are those of the configuration unless they are given.
FILE is a capture (.kcap), a file of UART bytes or a CAN log (candump .log, .asc, .blf, .trc, .mf4); it is played in real time.
A pipe, or - for standard input, is first read to its end into a temporary file (in TMPDIR, else /tmp).

keys: q quit, r reset minimum and maximum, 1 to 9 one ESC with everything in it, a all, n and p pages, space pause (FILE)
bars: power stage and BEC 0..110 degC, yellow from 80, red from 100; cell voltage 3.0..4.2 V, yellow from 3.5, red from 3.3 down;
throttle and opening 0..100 %. A value beyond a limit is marked with ! and !!. These limits are the monitor's, not the ESC's.

Where standard output is no terminal, or a dumb one, it writes one line for each ESC every second.
--once waits until each cyclic message of the DBC has come, or for --timeout, and prints one line of JSON; of a FILE the values at its end.
Values there are in the units of "units", null where not available.

exit codes: 0 ended by a key or signal, end of FILE, or --once with values; 1 no frame came (--once), or something cannot be opened;
2 wrong usage
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    parser.add_argument(
        "file", nargs="?", type=Path, metavar="FILE", help="a recording instead of the bus"
    )
    add_layout_arguments(parser)
    parser.add_argument(
        "--interface", metavar="NAME", help="python-can interface (default socketcan)"
    )
    parser.add_argument("--channel", metavar="NAME", help="channel of the interface (default can0)")
    parser.add_argument(
        "--speed",
        type=number_from(0.01, 1000, "factor"),
        metavar="FACTOR",
        help="play FILE faster by this factor (0.01 to 1000, default 1)",
    )
    parser.add_argument(
        "--once", action="store_true", help="one line of JSON with everything, then end"
    )
    parser.add_argument(
        "--timeout",
        type=number_from(0.1, 3600),
        metavar="S",
        help=f"--once: maximum time to wait (default {_ONCE_S:g})",
    )
    parser.add_argument(
        "--interval",
        type=number_from(0.1, 3600),
        metavar="S",
        help=f"time between screens (default {_REFRESH_S:g}; lines: {_PLAIN_LINE_S:g})",
    )


def main(args: argparse.Namespace) -> int:
    _check_usage(args)
    with _source_of(args) as source:
        from kontronik_can_gw.desk.monitor.model import Monitor

        monitor = Monitor(source.bus)
        if args.once:
            return _once(source, monitor, args.timeout or _ONCE_S)
        return _watch(source, monitor, args.interval)


def _check_usage(args: argparse.Namespace) -> None:
    if args.file is None and args.speed is not None:
        raise UserError("--speed: is for a FILE, not for the bus. Leave it out.")
    if args.file is not None and (args.interface is not None or args.channel is not None):
        raise UserError(
            f"{args.file}: is played, so --interface and --channel mean nothing. Leave them out."
        )
    if args.timeout is not None and not args.once:
        raise UserError("--timeout: is for --once. Leave it out.")


# --- sources of frames


class Source(Protocol):
    """Frames with their time, from the bus or from a file."""

    bus: "BusLayout"
    is_file: bool
    ended: bool
    paused: bool

    def pump(self, take: "Callable[[CanFrame, int], None]", until_s: float) -> None:
        """Pass on the frames that come until this time of ``time.monotonic``; may return sooner."""

    def now(self) -> int:
        """The present time on the clock of the frames, in ns."""

    def where(self) -> "Where":
        """State of the source, for the screen."""

    def wall_time(self) -> str | None:
        """Date and time of ``now``; None where not known."""

    @property
    def problem(self) -> str:
        """One line while no frames can come; empty otherwise."""

    @property
    def name(self) -> str:
        """Name of the channel or the file."""


@contextmanager
def _source_of(args: argparse.Namespace) -> Iterator[Source]:
    if args.file is None:
        bus = bus_layout(args.config, args.dbc)
        live = Bus(bus, can_config(bus, args.interface, args.channel))
        try:
            yield live
        finally:
            live.close()
        return
    from kontronik_can_gw.desk.recordings.inputs import CaptureInput, open_input

    given = (
        bus_layout(args.config, args.dbc)
        if args.config is not None or args.dbc is not None
        else None
    )
    with open_input(args.file, given) as opened:
        if given is not None and isinstance(opened, CaptureInput):
            raise UserError(
                f"{args.file}: is a capture, which holds its own DBC. Leave -c and --dbc out."
            )
        yield Recording(opened, args.speed or 1.0, at_once=args.once)
        for line in dict.fromkeys([*opened.damage, *opened.notes]):
            say(f"warning: {line}")


def last_ns(opened: "Input") -> int | None:
    """Time of a capture's last entry; None where its end does not show it."""
    from kontronik_can_gw.capture.format import Block, Scanner, read_entries
    from kontronik_can_gw.desk.recordings.inputs import CaptureInput

    if not isinstance(opened, CaptureInput) or opened.last_path is None:
        return None
    last = None
    with contextlib.suppress(OSError, ValueError):
        with opened.last_path.open("rb") as file:
            file.seek(max(0, file.seek(0, 2) - _LOOK_BACK))
            data = file.read(_LOOK_BACK)
        scanner = Scanner()
        for found in (*scanner.feed(data), *scanner.flush()):
            if isinstance(found, Block) and found.kind == b"D":
                last = max(
                    (
                        entry.time_ns
                        for entry in read_entries(found.payload, opened.header["version"])
                    ),
                    default=last,
                )
    return last


def can_config(bus: "BusLayout", interface: str | None, channel: str | None) -> "CanConfig":
    """The interface to listen on. UserError where it is the port of an ESC, to which nothing may be sent."""
    from kontronik_can_gw.config.keys import CanConfig

    if bus.config is None:
        is_fd = any(message.fd for message in bus.layout.messages)
        return CanConfig(interface=interface or "socketcan", channel=channel or "can0", fd=is_fd)
    can = bus.config.can
    if interface not in (
        None,
        can.interface,
    ):
        # options and channel belong to another kind of interface
        can = replace(can, interface=interface, options={})
    can = replace(can, channel=channel or can.channel)
    check_devices(replace(bus.config, can=can))
    return can


class Bus:
    """Frames from the CAN bus."""

    is_file = False
    ended = False
    paused = False

    def __init__(self, bus: "BusLayout", config: "CanConfig") -> None:
        from kontronik_can_gw.runtime.bus_listener import BusListener
        from kontronik_can_gw.signals.unpacker import SignalReader

        self.bus = bus
        self.name = config.channel
        self._config = config
        self._listener = BusListener(config, SignalReader(bus.layout).keys)

    @property
    def problem(self) -> str:
        return self._listener.problem

    def pump(self, take: "Callable[[CanFrame, int], None]", until_s: float) -> None:
        frames = self._listener.receive(max(0.0, until_s - time.monotonic()))
        now = time.monotonic_ns()
        for frame in frames:
            take(frame, now)

    def now(self) -> int:
        return time.monotonic_ns()

    def where(self) -> "Where":
        from kontronik_can_gw.cli.monitor_screen import Where

        config = self._config
        hints = ["Is the gateway running (kontronik-can-gw status)?"]
        if config.interface == "socketcan":
            hints.append(f"Is the bit rate right (ip -details link show {config.channel})?")
        else:
            hints.append(f"Is the bit rate right ({config.bitrate // 1000} kbit/s)?")
        hints.append("Does the gateway send by another DBC (give -c or --dbc)?")
        return Where(self.name, problem=self.problem, hints=tuple(hints))

    def wall_time(self) -> str:
        from datetime import datetime

        return datetime.now().astimezone().isoformat(timespec="milliseconds")

    def close(self) -> None:
        self._listener.close()


class Recording:
    """Frames from a file, played in real time times ``speed``; ``at_once``: as fast as it can be read."""

    is_file = True
    problem = ""

    def __init__(self, opened: "Input", speed: float, at_once: bool = False) -> None:
        self.bus = opened.bus
        self.name = Path(opened.name).name
        self.ended = False
        self.paused = False
        self._input = opened
        self._speed = speed
        self._at_once = at_once
        self._frames = opened.frames()
        self._next = next(self._frames, None)
        self._ended_at = 0 if self._next is None else self._next.time_ns
        self._first_ns = self._ended_at
        self._last_ns = None if at_once else last_ns(opened)
        self._last_pump = time.monotonic()
        self._clock = self._ended_at
        self.ended = self._next is None

    def pump(self, take: "Callable[[CanFrame, int], None]", until_s: float) -> None:
        begin = time.monotonic()
        # a delay is not made up for: a slow reader plays slower than asked for
        passed = min(begin - self._last_pump, _MAX_LAG_S)
        self._last_pump = begin
        if not self.paused and not self.ended:
            self._clock += round(passed * self._speed * SECOND)
        while (
            not self.paused
            and self._next is not None
            and (self._at_once or self._next.time_ns <= self._clock)
        ):
            timed = self._next
            take(timed.frame, timed.time_ns)
            self._ended_at = timed.time_ns
            self._next = next(self._frames, None)
            if time.monotonic() >= until_s:
                self._clock = self._ended_at
                break
        if self._next is None:
            self.ended = True
            self._clock = self._ended_at
        pause = until_s - time.monotonic()
        if self._next is not None and not self.paused:
            pause = min(pause, (self._next.time_ns - self._clock) / SECOND / self._speed)
        if pause > 0 and not self._at_once:
            time.sleep(min(pause, 0.05))

    def now(self) -> int:
        return self._clock

    def where(self) -> "Where":
        from kontronik_can_gw.cli.monitor_screen import Where

        seconds = (self._clock - self._first_ns) / SECOND
        parts = [f"{int(seconds) // 60}:{int(seconds) % 60:02}"]
        if self._speed != 1:
            parts.append(f"x{self._speed:g}")
        if self.ended:
            parts.append("END OF FILE")
        elif self._last_ns is not None and self._last_ns > self._first_ns:
            parts.append(
                f"{min(99, 100 * (self._clock - self._first_ns) // (self._last_ns - self._first_ns))} %"
            )
        if self.paused:
            parts.append("PAUSED")
        return Where(self.name, is_file=True, progress="  ".join(parts), ended=self.ended)

    def wall_time(self) -> str | None:
        from datetime import UTC, datetime

        wall = self._input.wall_ns(self._clock)
        if wall is None:
            return None
        return (
            datetime.fromtimestamp(wall / SECOND, UTC)
            .astimezone()
            .isoformat(timespec="milliseconds")
        )


# --- one line


def _once(source: Source, monitor: "Monitor", timeout: float) -> int:

    stop = False

    def end() -> None:
        nonlocal stop
        stop = True

    deadline = time.monotonic() + timeout
    with stopping_on_signals(end):
        while not stop and not source.ended and (source.is_file or not monitor.is_complete):
            now = time.monotonic()
            if not source.is_file and now >= deadline:
                break
            source.pump(monitor.take, min(deadline, now + _REFRESH_S))
            monitor.advance(source.now())
    monitor.advance(source.now())
    if stop:
        return 130
    if not monitor.frames:
        where = source.where()
        if source.is_file:
            raise RunError(
                f"{source.name}: holds no frame of {_file_of(monitor)}. Give its DBC (--dbc)."
            )
        said = (
            source.problem or f"no frame of {_file_of(monitor)} on {source.name} for {timeout:g} s."
        )
        raise RunError(said if source.problem else " ".join([said, *where.hints]))
    head: dict[str, Any] = {
        "time": source.wall_time(),
        "file" if source.is_file else "interface": source.name,
        "dbc": _file_of(monitor),
    }
    print(printable_json(head | monitor.document(), ascii_only=not _is_utf8(sys.stdout.encoding)))
    return 0


def _file_of(monitor: "Monitor") -> str:
    return Path(monitor.bus.layout.file).name


def _is_utf8(encoding: str | None) -> bool:
    try:
        return codecs.lookup(encoding or "ascii").name == _SUFFIX_OF_UTF8
    except LookupError:
        return False


# --- the screen


def _watch(source: Source, monitor: "Monitor", interval: float | None) -> int:
    from rich.console import Console

    stop = False

    def end() -> None:
        nonlocal stop
        stop = True

    console = Console(highlight=False)
    with stopping_on_signals(end):
        if console.is_terminal and not console.is_dumb_terminal:
            _live(console, source, monitor, interval or _REFRESH_S, lambda: stop)
        else:
            _lines(source, monitor, interval or _PLAIN_LINE_S, lambda: stop)
    say(f"{monitor.frames} frames of {_file_of(monitor)} seen on {source.name}, none sent")
    return 0


def _lines(
    source: Source, monitor: "Monitor", interval: float, stopped: Callable[[], bool]
) -> None:
    """Print plain lines, without terminal control, until the end of a file or a signal."""
    from kontronik_can_gw.cli.monitor_screen import notices, plain_lines

    monitor.advance(source.now())
    due = time.monotonic() + interval
    printed: list[str] = []
    while not stopped():
        source.pump(monitor.take, due)
        monitor.advance(source.now())
        if time.monotonic() < due and not source.ended:
            continue
        due = max(due + interval, time.monotonic())  # missed lines are not made up for
        said = [text for text, _ in notices(monitor, source.where())]
        for text in said:
            if _news_of(text) not in printed:
                say(text)
        if printed and not said:
            say(f"{source.name}: frames come")
        printed = [_news_of(text) for text in said]
        for line in plain_lines(monitor):
            print(line, flush=True)
        if source.ended:
            return


def _news_of(text: str) -> str:
    """A notice without its duration, which changes all the time."""
    return text.rpartition(" for ")[0] if text.startswith("no frames") else text


def _live(
    console: "Console",
    source: Source,
    monitor: "Monitor",
    interval: float,
    stopped: Callable[[], bool],
) -> None:
    from rich.live import Live
    from rich.text import Text

    from kontronik_can_gw.cli.monitor_screen import ASCII, UNICODE, Choice, screen

    glyphs: Glyphs = (
        UNICODE if _is_utf8(console.encoding) and not is_c_locale(_environment()) else ASCII
    )
    choice = Choice()
    with Keys() as keys:

        def drawn() -> Text:
            where = source.where()._replace(keys=keys.work)
            lines = screen(
                monitor, where, (console.size.width, console.size.height), choice, glyphs
            )
            text = Text(no_wrap=True, overflow="crop", end="")
            for index, line in enumerate(lines):
                if index:
                    text.append("\n")
                for piece in line:
                    text.append(piece.text, piece.style)
            return text

        monitor.advance(source.now())
        with Live(drawn(), console=console, screen=True, auto_refresh=False) as live:
            keys.on_continued = lambda: _retake(console)
            due = time.monotonic()
            while not stopped():
                now = time.monotonic()
                if now >= due:
                    monitor.advance(source.now())
                    live.update(drawn(), refresh=True)
                    due = max(due + interval, now + interval / 2)
                source.pump(monitor.take, due)
                pressed = keys.pressed()
                for key in pressed:
                    if not _obey(key, source, monitor, choice):
                        return
                if pressed:
                    due = time.monotonic()


def is_c_locale(environment: Mapping[str, str]) -> bool:
    """True for an ASCII-only locale, with which Python itself still uses UTF-8."""
    name = next(
        (environment[key] for key in ("LC_ALL", "LC_CTYPE", "LANG") if environment.get(key)), "C"
    )
    return name in ("C", "POSIX")


def _environment() -> dict[str, str]:
    """The original environment of the process: in a C locale Python changes LC_CTYPE."""
    try:
        lines = Path("/proc/self/environ").read_bytes().split(b"\0")
    except OSError:
        return dict(os.environ)
    return {key: value for key, _, value in (os.fsdecode(line).partition("=") for line in lines)}


def _retake(console: "Console") -> None:
    """Set up the screen again after Ctrl-Z and fg."""
    console.set_alt_screen(True)


def _obey(key: str, source: Source, monitor: "Monitor", choice: "Choice") -> bool:
    """Handle a key; False: end."""
    match key.lower():
        case "q" | "\x03" | "\x04":
            return False
        case "r":
            monitor.reset()
        case "n":
            choice.page += 1
        case "p":
            choice.page -= 1
        case "a" | "0" | "\x1b":
            choice.esc = None
        case " " if source.is_file:
            source.paused = not source.paused
        case digit if digit.isdecimal() and int(digit) <= len(monitor.escs):
            choice.esc = int(digit) - 1
    return True


class Keys:
    """Reads single keys without echo, as context manager. No keys where standard input is no terminal."""

    def __init__(self) -> None:
        self.work = False
        self.on_continued: Callable[[], None] = lambda: None
        self._fd = -1
        self._before: list[Any] | None = None

    def __enter__(self) -> Self:
        import signal
        import termios

        with contextlib.suppress(
            OSError, ValueError, AttributeError, io.UnsupportedOperation, termios.error
        ):
            fd = sys.stdin.fileno()
            if os.isatty(fd) and os.tcgetpgrp(fd) == os.getpgrp():
                self._fd = fd
                self._before = termios.tcgetattr(fd)
                self._listen()
                self.work = True
        self._old = signal.signal(signal.SIGCONT, lambda *_: self._continued())
        return self

    def __exit__(self, *_: object) -> None:
        import signal
        import termios

        signal.signal(signal.SIGCONT, self._old)
        if self._before is not None:
            with contextlib.suppress(OSError, termios.error):  # the terminal is closed
                termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)

    def pressed(self) -> str:
        """Keys pressed since the last call, without keys of several characters (arrows)."""
        if not self.work:
            return ""
        try:
            if not select.select([self._fd], [], [], 0)[0]:
                return ""
            data = os.read(self._fd, 64)
        except OSError:
            data = b""
        if not data:  # the terminal is closed
            self.work = False
        text = data.decode("ascii", "ignore")
        return text if len(text) == 1 or not text.startswith("\x1b") else ""

    def _listen(self) -> None:
        import termios

        mode = termios.tcgetattr(self._fd)
        mode[3] &= ~(termios.ICANON | termios.ECHO)
        mode[6][termios.VMIN], mode[6][termios.VTIME] = 1, 0
        termios.tcsetattr(self._fd, termios.TCSADRAIN, mode)

    def _continued(self) -> None:
        if self.work:
            self._listen()
        self.on_continued()
