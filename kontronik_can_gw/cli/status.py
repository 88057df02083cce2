"""``status``: shows the state of a running gateway, from the statistics file that it replaces each second."""

import argparse
import json
import os
import textwrap
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

from kontronik_can_gw.cli.arguments import number_from
from kontronik_can_gw.cli.common import stopping_on_signals
from kontronik_can_gw.config.parse import load
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.kontronik.states import OperatingError, SelfTestError
from kontronik_can_gw.esc.telemetry import MS, SECOND
from kontronik_can_gw.printable import printable, printable_json
from kontronik_can_gw.runtime.snapshot import FORMAT, PROGRAM, STALE_NS, pid_namespace, start_ticks

if TYPE_CHECKING:
    from rich.text import Text

HEALTHY, TROUBLE, NOT_RUNNING = 0, 1, 3
RUN_FOLDER = Path("/run")
_LARGEST_FILE = 1 << 22
_SUMMARY_BITS = {
    OperatingError.OPERATING_ERROR_FOUND.text,
    OperatingError.OPERATING_WARNING_FOUND.text,
}
_MEANINGS = {bit.text: bit.meaning for bits in (OperatingError, SelfTestError) for bit in bits}
_GOOD, _POOR, _BAD, _FAINT = "green", "yellow", "bold red", "dim"
_CAN_STYLES = {"error-active": _GOOD, "unknown": "", "error-warning": _POOR, "error-passive": _POOR}
_LINK_STYLES = {"ok": _GOOD, "degraded": _POOR}
_COLUMNS = ("ESC", "link", "Hz", "age ms", "V", "A", "1/min", "°C", "CRC", "line", "lost")
_WIDTHS = (3, 10, 3, 6, 5, 6, 6, 3, 5, 4, 4)
"""Minimum widths of columns, so that the live display does not jump."""
_LEFT = 2
"""Number of left-aligned columns (words)."""


class NotRunning(RunError):
    """No gateway runs."""

    exit_code = NOT_RUNNING


@dataclass(frozen=True)
class Piece:
    """Text in one style (a name of rich, '' for none), made printable."""

    text: str
    style: str = ""

    def __post_init__(self) -> None:
        if not self.text.isprintable():
            object.__setattr__(self, "text", printable(self.text))


Line = list[Piece]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "-c", "--config", type=Path, metavar="FILE", help="the gateway with this TOML configuration"
    )
    where.add_argument(
        "--file", type=Path, metavar="FILE", help="the gateway with this statistics file"
    )
    parser.add_argument(
        "--once",
        action="store_true",
        help="show it once, as in a pipe (default on a terminal: live)",
    )
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output")
    parser.add_argument(
        "--interval",
        type=number_from(0.1, 3600),
        default=1.0,
        metavar="S",
        help="live: interval in seconds (default 1)",
    )
    parser.epilog = (
        "Default: all gateways that run as a service. Exit code 0: running and healthy (also at the end of the live display); "
        "1: running, but an ESC is not heard or nothing gets onto the CAN bus; 2: wrong usage; 3: not running, or no answer for 3 s."
    )


@dataclass(frozen=True)
class Seen:
    """Result for one gateway: exit code, a sentence, faults, and its document or None."""

    file: Path
    code: int
    sentence: str
    troubles: tuple[str, ...] = ()
    age_s: float | None = None
    document: "Node | None" = None


class Node:
    """A part of an untrusted document: missing values and values of a wrong type read as empty."""

    def __init__(self, value: object) -> None:
        self._value: Mapping[str, Any] = value if isinstance(value, dict) else {}

    def part(self, key: str) -> "Node":
        return Node(self._value.get(key))

    def parts(self, key: str) -> list["Node"]:
        found = self._value.get(key)
        return [Node(value) for value in found] if isinstance(found, list) else []

    def number(self, key: str) -> float | None:
        found = self._value.get(key)
        return found if _is_number(found) else None

    def count(self, key: str) -> int:
        return int(self.number(key) or 0)

    def text(self, key: str) -> str:
        found = self._value.get(key)
        return printable(found) if isinstance(found, str) else ""

    def texts(self, key: str) -> list[str]:
        found = self._value.get(key)
        return (
            [printable(text) for text in found if isinstance(text, str)]
            if isinstance(found, list)
            else []
        )

    def numbers(self, key: str) -> list[float]:
        found = self._value.get(key)
        return [value for value in found if _is_number(value)] if isinstance(found, list) else []

    def is_true(self, key: str) -> bool:
        return self._value.get(key) is True

    def sum(self) -> int:
        return sum(self.count(key) for key in self._value)

    @property
    def raw(self) -> Mapping[str, Any]:
        return self._value


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e18


def main(args: argparse.Namespace) -> int:
    from rich.console import Console

    configuration = None if args.config is None else load(args.config)
    given = args.file if configuration is None else configuration.statistics_path

    def look() -> list[Seen]:
        now = time.monotonic_ns()
        if given is not None:
            return [look_at(given, now)]
        seen = [look_at(file, now) for file in _service_files()]
        if configuration is not None:
            wanted = printable(str(Path(configuration.file).absolute()))
            seen = [
                s
                for s in seen
                if s.document is not None and s.document.text("configuration") == wanted
            ]
        return seen

    seen = look()
    if not seen:
        if args.json:
            print(json.dumps({"gateways": []}))
        raise NotRunning(_no_file(configuration.file if configuration else None))
    console = Console(highlight=False)
    if not args.json and all(each.document is None for each in seen):
        raise NotRunning(*(each.sentence for each in seen))
    if args.json:
        print(printable_json({"gateways": [_as_json(each) for each in seen]}))
    elif args.once or not console.is_terminal or console.is_dumb_terminal:
        for line in _joined([screen(each) for each in seen]):
            if console.is_terminal:
                console.print(_rich(line), soft_wrap=True)
            else:
                print("".join(piece.text for piece in line).rstrip())
    else:
        _live(console, look, args.interval)
        return 0
    return max(each.code for each in seen)


def _service_files() -> list[Path]:
    names = sorted(RUN_FOLDER.glob(f"{PROGRAM}-*/status.json"))
    plain = RUN_FOLDER / PROGRAM / "status.json"
    return [*([plain] if plain.exists() else []), *names]


def _no_file(configuration: str | None) -> str:
    if configuration is not None:
        return (
            f"{configuration}: no gateway with this configuration runs as a service, and statistics.file is not set. "
            f"Start it: sudo systemctl start {PROGRAM}, or set statistics.file."
        )
    return (
        f"no gateway runs as a service: there is no {RUN_FOLDER}/{PROGRAM}/status.json. "
        f"Start it: sudo systemctl start {PROGRAM}; or name the file of another one: --file, or -c and its configuration."
    )


# --- from a file to an exit code


def look_at(file: Path, now: int) -> Seen:
    """The result of a statistics file at ``now`` (monotonic)."""
    try:
        if file.exists() and not file.is_file():  # reading a pipe would block
            return Seen(file, NOT_RUNNING, f"{file}: is no plain file. Look at statistics.file.")
        with file.open("rb") as opened:
            data = opened.read(_LARGEST_FILE)
        value = json.loads(data)
    except FileNotFoundError:
        return Seen(
            file,
            NOT_RUNNING,
            f"{file}: not running: there is no such file. Start the gateway whose statistics.file it is.",
        )
    except OSError as error:
        return Seen(
            file, NOT_RUNNING, f"{file}: cannot be read: {error.strerror}. Try it with sudo."
        )
    except (ValueError, RecursionError):
        return Seen(
            file,
            NOT_RUNNING,
            f"{file}: is not a statistics file of {PROGRAM}. Look at statistics.file.",
        )
    document = Node(value)
    if document.text("program") != PROGRAM:
        return Seen(
            file,
            NOT_RUNNING,
            f"{file}: is not a statistics file of {PROGRAM}. Look at statistics.file.",
        )
    if document.number("format") != FORMAT:
        return Seen(
            file,
            NOT_RUNNING,
            f"{file}: is of another version of {PROGRAM} ({document.text('version')}).",
        )
    return judge(file, document, now, _is_alive(document.part("process")))


def judge(file: Path, document: Node, now: int, alive: bool) -> Seen:
    """The exit code for a document, with the faults in words."""
    age = now - document.count("monotonic_ns")
    age_s = age / SECOND
    if not alive or age < -STALE_NS:  # written before the machine restarted
        return Seen(file, NOT_RUNNING, "not running", (), age_s, document)
    if age > STALE_NS:
        said = f"does not answer since {duration(age_s)} (stopped, or the disk of its file is full)"
        return Seen(file, NOT_RUNNING, said, (), age_s, document)
    troubles = tuple(_troubles(document))
    sentence = document.part("gateway").text("state") or "running"
    if troubles:
        sentence += f", {len(troubles)} fault{'s' if len(troubles) > 1 else ''}"
    return Seen(file, TROUBLE if troubles else HEALTHY, sentence, troubles, age_s, document)


def _troubles(document: Node) -> Iterator[str]:
    can = document.part("can")
    state, channel = can.text("state"), can.text("channel")
    complaint = can.text("complaint")
    if not can.is_true("open") or state == "down":
        yield complaint or f"CAN {channel} is down"
    elif state == "bus-off":
        yield complaint or f"CAN {channel} is bus-off"
    elif can.is_true("stalled"):
        yield complaint or f"CAN {channel}: no frame can be sent"
    for esc in document.parts("escs"):
        if esc.is_true("fresh"):
            continue
        port = esc.part("port")
        reason = esc.text("diagnosis")
        if not port.is_true("open"):
            lost = port.number("lost_for_s")
            since = f" for {duration(lost)}" if lost is not None else ""
            complaint = port.text("complaint").removeprefix(f"{esc.text('name')}: ")
            reason = f"port not open{since}: {complaint or port.text('path')}"
        yield f"{esc.text('name')}: {reason or 'no telemetry'}"
    if failed := document.part("store").text("last_error"):
        yield f"parameters cannot be stored: {failed}"
    if failed := document.part("recording").text("problem"):
        yield f"captures: {failed}"


def _is_alive(process: Node) -> bool:
    """True if the writing process still runs, or if that cannot be found out."""
    pid, ticks = process.count("pid"), process.count("start_ticks")
    if pid <= 0 or process.text("pid_namespace") != printable(pid_namespace()):
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OverflowError:
        return False
    except PermissionError:  # another user's
        pass
    now = start_ticks(pid)
    return now >= 0 and (now == 0 or ticks == 0 or now == ticks)


def _as_json(seen: Seen) -> dict[str, Any]:
    return {
        "file": printable(str(seen.file)),
        "exit_code": seen.code,
        "status": seen.sentence,
        "troubles": list(seen.troubles),
        "age_s": None if seen.age_s is None else round(seen.age_s, 3),
        "document": None if seen.document is None else seen.document.raw,
    }


# --- text


def duration(seconds: float) -> str:
    """A time span in words."""
    whole = max(0, int(seconds))
    if whole < 100:
        return f"{whole} s"
    if whole < 6000:
        return f"{whole // 60} min"
    if whole < 48 * 3600:
        return f"{whole // 3600} h {whole // 60 % 60} min"
    return f"{whole // 86_400} days {whole // 3600 % 24} h"


def compact(count: float | None) -> str:
    """A count in four or five characters."""
    if count is None:
        return "-"
    for limit, divisor, unit in ((100_000, 1, ""), (10**8, 1000, "k"), (10**11, 10**6, "M")):
        if count < limit:
            return f"{int(count) // divisor}{unit}"
    return f"{int(count) // 10**9}G"


def screen(seen: Seen, size: tuple[int, int] | None = None) -> list[Line]:
    """Everything about one gateway, most important first; cut to ``size`` (columns, lines) if given."""
    document = seen.document
    width, height = size or (None, None)
    if document is None:
        return _wrapped(seen.sentence, _BAD, width)
    if seen.code == NOT_RUNNING:
        return _cut([*_head(seen, document), *_log_lines(document)], height)
    lines = [*_head(seen, document), *_can_lines(document), [], *_esc_lines(document)]
    lines += [line for trouble in seen.troubles for line in _wrapped(trouble, _BAD, width)]
    lines += [line for words, style in _errors(document) for line in _wrapped(words, style, width)]
    lines += _node_lines(document, width)
    if (waiting := document.part("store").count("waiting")) > 0:
        lines.append([Piece(f"{waiting} parameters wait for the disk", _POOR)])
    lines += _recording_lines(document)
    log = _log_lines(document)
    if height is not None:
        room = height - len(lines)
        log = [log[0], *log[1:][-(room - 1) :]] if log and room > 1 else []
    return _cut([*lines, *log], height)


def _wrapped(text: str, style: str, width: int | None) -> list[Line]:
    parts = (
        [text] if width is None else textwrap.wrap(text, max(20, width), subsequent_indent="    ")
    )
    return [[Piece(part, style)] for part in parts]


def _cut(lines: list[Line], height: int | None) -> list[Line]:
    if height is None or len(lines) <= height:
        return lines
    rest = len(lines) - height + 1
    return [*lines[: height - 1], [Piece(f"... and {rest} lines more: --once shows them", _FAINT)]]


def _head(seen: Seen, document: Node) -> list[Line]:
    process, escs = document.part("process"), document.part("gateway")
    style = {HEALTHY: f"bold {_GOOD}", TROUBLE: f"bold {_POOR}"}.get(seen.code, _BAD)
    first = [Piece(f"{PROGRAM} {document.text('version')}  "), Piece(seen.sentence, style)]
    where = document.text("configuration")
    pid = process.count("pid")
    if seen.code == NOT_RUNNING:
        first.append(Piece(f", last heard of {document.text('time')}"))
        return [
            first,
            [Piece(where, _FAINT)],
            [Piece(f"Why? journalctl -e -u '{PROGRAM}*'", _FAINT)],
        ]
    up = duration(process.number("uptime_s") or 0)
    first.append(
        Piece(f"  {escs.count('escs_ok')} of {escs.count('esc_count')} ESCs heard, up {up}")
    )
    return [
        first,
        [Piece(f"process {pid}, {process.count('rss_bytes') // 1_000_000} MB, {where}", _FAINT)],
    ]


def _can_lines(document: Node) -> list[Line]:
    can, counters, rates = (
        document.part("can"),
        document.part("can").part("counters"),
        document.part("rates"),
    )
    state = can.text("state")
    bitrate = can.number("bitrate")
    words = f", {bitrate / 1000:g} kbit/s" if bitrate else ""
    for name, what in (("sent_frames", "sent"), ("received_frames", "received")):
        rate = rates.number(f"{name}_per_s")
        words += f", {what} {'-' if rate is None else f'{rate:.0f}'}/s"
    if len(errors := can.numbers("error_counters")) == 2:
        words += f", error counters {errors[0]:.0f}/{errors[1]:.0f}"
    line = [
        Piece(f"CAN {can.text('channel')}: "),
        Piece(state, _CAN_STYLES.get(state, _BAD)),
        Piece(words),
    ]
    shown = (
        ("dropped_frames", "dropped"),
        ("send_failures", "send failures"),
        ("bus_off_count", "bus-off"),
        ("id_conflicts", "id conflicts"),
    )
    counts = ", ".join(f"{compact(counters.count(key))} {what}" for key, what in shown)
    return [
        line,
        [Piece(f"     in all: {compact(counters.count('sent_frames'))} sent, {counts}", _FAINT)],
    ]


def _esc_lines(document: Node) -> list[Line]:
    """One line for each ESC, at most 80 columns wide."""
    rows: list[list[str]] = [list(_COLUMNS)]
    styles: list[str] = [_FAINT]
    for esc in document.parts("escs"):
        values, counters = esc.part("values"), esc.part("counters")
        fresh = esc.is_true("fresh")
        rate, age = esc.number("frame_rate_hz"), esc.number("data_age_ms")
        measured = (("battery_voltage", "2"), ("battery_current", "1"), ("motor_speed", "0"))
        link = esc.text("link")
        rows.append(
            [
                esc.text("name")[:12],
                link.replace("-", " ")[:10],
                "-" if rate is None else f"{rate:.0f}",
                _age(age),
                *(_value(values, key, digits) for key, digits in measured),
                _value(values, "power_stage_temperature", "0"),
                compact(counters.count("crc_errors")),
                compact(
                    esc.part("port").part("line_errors").sum() or counters.count("line_errors")
                ),
                compact(esc.count("losses")),
            ]
        )
        styles.append(_LINK_STYLES.get(link, "") if fresh else _BAD)
    widths = [
        max(minimum, *(len(row[column]) for row in rows)) for column, minimum in enumerate(_WIDTHS)
    ]
    lines: list[Line] = []
    for row, style in zip(rows, styles, strict=True):
        cells = [
            cell.ljust(width) if column < _LEFT else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        if row is rows[0]:
            lines.append([Piece(" ".join(cells), style)])
        else:
            lines.append(
                [Piece(f"{cells[0]} "), Piece(cells[1], style), Piece(" " + " ".join(cells[2:]))]
            )
    return lines


def _age(milliseconds: float | None) -> str:
    if milliseconds is None:
        return "-"
    return (
        f"{milliseconds:.0f}"
        if milliseconds < 100_000
        else duration(milliseconds * MS / SECOND).replace(" ", "")[:6]
    )


def _value(values: Node, key: str, digits: str) -> str:
    value = values.number(key)
    return "-" if value is None else f"{value:.{digits}f}"


def _errors(document: Node) -> Iterator[tuple[str, str]]:
    """Errors that the ESCs report, in words, with their style."""
    shown = (
        ("errors", "error", _BAD),
        ("selftest_errors", "self-test error", _BAD),
        ("warnings", "warning", _POOR),
    )
    for esc in document.parts("escs"):
        for key, what, style in shown:
            found = esc.texts(key)
            found = [name for name in found if name not in _SUMMARY_BITS] or found
            if found:
                yield (
                    f"{esc.text('name')} {what}: {'; '.join(_MEANINGS.get(name, name) for name in found)}",
                    style,
                )


def _node_lines(document: Node, width: int | None) -> list[Line]:
    """The CANopen nodes with their PDOs per second, as many in a line as fit."""
    rates = document.part("rates").numbers("pdos_per_s")
    words = []
    for number, node in enumerate(document.parts("nodes")):
        node_id = node.number("node_id")
        state = "waits for LSS" if node_id is None else f"node {int(node_id)} {node.text('state')}"
        rate = f", {rates[number]:.0f}/s" if number < len(rates) and node_id is not None else ""
        words.append(f"{node.text('esc')}: {state}{rate}")
    longest = max(map(len, words), default=0) + 2
    count = max(1, ((width or 80) + 2) // longest) if words else 1
    lines = [words[at : at + count] for at in range(0, len(words), count)]
    return [[Piece("".join(word.ljust(longest) for word in line).rstrip())] for line in lines]


def _recording_lines(document: Node) -> list[Line]:
    """The capture that is written now."""
    recording = document.part("recording")
    if not (file := recording.text("file")):
        return []
    lost = recording.count("lost")
    words = f"recording to {file}, {recording.count('bytes') / 1e6:.1f} MB"
    return [[Piece(f"{words}, {lost} entries lost", _POOR) if lost else Piece(words)]]


def _log_lines(document: Node) -> list[Line]:
    lines = document.texts("log")
    return (
        [[Piece("last events:", _FAINT)], *([Piece(f"  {line}", _FAINT)] for line in lines)]
        if lines
        else []
    )


def _joined(parts: Sequence[list[Line]]) -> list[Line]:
    """The gateways one after the other."""
    lines: list[Line] = []
    for part in parts:
        lines += [*([[]] if lines else []), *part]
    return lines


# --- the terminal


def _rich(line: Line) -> "Text":
    from rich.text import Text

    return Text.assemble(
        *((piece.text, piece.style) for piece in line), no_wrap=True, overflow="ellipsis"
    )


def _live(console: Any, look: Any, interval: float) -> None:
    """Refresh the display until SIGINT or SIGTERM."""
    from rich.console import Group
    from rich.live import Live

    def end() -> None:
        raise KeyboardInterrupt

    def shown() -> Group:
        seen: list[Seen] = look()
        width, height = console.size
        share = max(3, (height - 1 - len(seen)) // max(1, len(seen)))
        lines = _joined([screen(each, (width, share)) for each in seen]) or [
            [Piece(_no_file(None), _BAD)]
        ]
        return Group(*map(_rich, lines), _rich([Piece("Ctrl-C ends.", _FAINT)]))

    try:
        with stopping_on_signals(end), Live(console=console, auto_refresh=False) as live:
            while True:
                live.update(shown(), refresh=True)
                time.sleep(interval)
    except KeyboardInterrupt:
        return
