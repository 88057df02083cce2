"""The content of a DBC, an EDS, a table or a CAN log as lines of text, however it is laid out.

This module does not use the product.
"""

import configparser
import csv
import io
import json
import re
import tempfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import can
import cantools.database
from cantools.database.can import Database, Message, Signal

ALL_ROWS = 40
"""A table of at most this many rows is written whole, a longer one as some rows and digests."""
BLOCKS = 8
"""Parts of a long table, each of which has a digest."""


def _digest(items: Iterable[object]) -> str:
    return f"{zlib.crc32(repr(list(items)).encode()):08X}"


def spelled(text: str) -> str:
    """Return a number in its one spelling, and any other text unchanged."""
    try:
        return str(int(text, 0))
    except ValueError:
        pass
    try:
        return f"{float(text):.12g}"
    except ValueError:
        return text


def database(data: bytes) -> Database:
    found = cantools.database.load_string(data.decode("latin-1"), "dbc", strict=True)
    assert isinstance(found, Database)
    return found


def _attributes(holder: Any) -> str:
    found = getattr(holder.dbc, "attributes", None) or {}
    return "".join(f" {name}={attribute.value}" for name, attribute in sorted(found.items()))


def _message(message: Message) -> list[str]:
    digits = 8 if message.is_extended_frame else 3
    can_fd = " FD" if message.is_fd else ""
    senders = ",".join(message.senders)
    head = f"{message.frame_id:0{digits}X} {message.name}: {message.length} bytes{can_fd}"
    lines = [f"{head} from {senders}{_attributes(message)} ; {message.comment}"]
    for signal in sorted(message.signals, key=lambda signal: signal.name):
        lines.append(_signal(signal))
        if signal.choices:
            choices = sorted(signal.choices.items())
            lines.append("    " + " ".join(f"{number}={text}" for number, text in choices))
    return lines


def _signal(signal: Signal) -> str:
    order = "big" if signal.byte_order == "big_endian" else "little"
    sign = "-" if signal.is_signed else "+"
    form = f"{signal.start}|{signal.length}@{order}{sign}"
    if signal.is_float:
        form += " float"
    if signal.is_multiplexer:
        form += " M"
    if signal.multiplexer_ids:
        form += f" m{signal.multiplexer_ids}"
    scale = f"({signal.scale:g},{signal.offset:g})"
    limits = f"[{signal.minimum}|{signal.maximum}]"
    numbers = f"{scale} {limits} {signal.unit or '-'} raw start {signal.raw_initial}"
    receivers = ",".join(signal.receivers)
    texts = f"{receivers}{_attributes(signal)} ; {signal.comment}"
    return f"  {signal.name} {form} {numbers} to {texts}"


def _by_id(database: Database) -> list[Message]:
    return sorted(database.messages, key=lambda each: (each.is_extended_frame, each.frame_id))


def dbc(data: bytes) -> list[str]:
    """Return all of a DBC: a line for each message, signal and value table, by id and name."""
    found = database(data)
    lines = [f"database{_attributes(found)}"]
    for node in found.nodes:
        lines.append(f"node {node.name} ; {node.comment}")
    for message in _by_id(found):
        lines += _message(message)
    return lines


def dbc_short(data: bytes) -> list[str]:
    """Return a line for each message: its name, cycle and size, and a digest of its content."""
    lines = []
    for message in _by_id(database(data)):
        head = f"{message.frame_id:03X} {message.name} {message.cycle_time} ms"
        digest = _digest(_message(message))
        lines.append(f"{head} {len(message.signals)} signals {digest}")
    return lines


def _sections(data: bytes) -> configparser.ConfigParser:
    found = configparser.ConfigParser(
        strict=True,
        interpolation=None,
        comment_prefixes=(";",),
        delimiters=("=",),
    )
    found.optionxform = str  # type: ignore[assignment, method-assign]
    found.read_string(data.decode("latin-1"))
    return found


_OF_THE_DAY = {"CreationDate", "CreationTime", "CreatedBy"}
_OF_THE_DAY |= {"ModificationDate", "ModificationTime", "ModifiedBy"}


def eds(data: bytes) -> list[str]:
    """Return a line for each section: its sorted keys, with numbers in one spelling."""
    found = _sections(data)
    lines = []
    for name in sorted(found.sections(), key=str.upper):
        section = found[name]
        kept = [key for key in sorted(section) if section[key] and key not in _OF_THE_DAY]
        keys = {key: section[key] for key in kept}
        lines.append(f"[{name.upper()}] {_keys(keys)}")
    return lines


def _keys(values: Mapping[str, str]) -> str:
    return " ".join(f"{key}={spelled(value)}" for key, value in values.items())


def dcf(data: bytes) -> list[str]:
    """Return the lines that a DCF adds to its EDS: the sections of the node, and ParameterValue."""
    found = _sections(data)
    lines = [line for line in eds(data) if line.startswith(("[DEVICECOM", "[FILEINFO"))]
    for name in sorted(found.sections(), key=str.upper):
        section = found[name]
        added = [key for key in ("ParameterValue", "Denotation") if key in section]
        values = {key: section[key] for key in added}
        if values and "Com" not in name:
            lines.append(f"[{name.upper()}] {_keys(values)}")
    return lines


def columns(data: bytes) -> dict[str, list[str]]:
    """Return the columns of a CSV table or of JSON lines.

    Numbers have one spelling, and missing values are "".
    """
    text = data.decode("utf-8")
    found: dict[str, list[str]] = {}
    if text.startswith("{"):
        rows = [json.loads(line) for line in text.splitlines()]
        names: dict[str, None] = {}
        for row in rows:
            names |= dict.fromkeys(row)
        for name in names:
            found[name] = [_cell(row.get(name)) for row in rows]
        return found
    head, *lines = list(csv.reader(io.StringIO(text)))
    for at, name in enumerate(head):
        found[name] = [spelled(line[at]) for line in lines]
    return found


def _cell(value: object) -> str:
    if isinstance(value, (dict, list)):
        return json.dumps(value, separators=(",", ":"), ensure_ascii=False)
    return "" if value is None else spelled(str(value))


def _runs(values: Sequence[str]) -> str:
    """Return values in one line, with `x*3` for three equal values and `-` for an empty one."""
    parts = []
    for value, same in groupby(each.replace(" ", "_") or "-" for each in values):
        count = len(list(same))
        parts.append(value if count == 1 else f"{value}*{count}")
    return " ".join(parts)


def table(data: bytes) -> list[str]:
    """Return the lines of a CSV table or of JSON lines, as ``column_lines`` does."""
    return column_lines(columns(data))


def column_lines(found: Mapping[str, list[str]]) -> list[str]:
    """Return a line for each column, with its values.

    For a long table the line has some of the values, and a digest of each eighth of them. Columns
    that have the same value in all rows share a line.
    """
    count = len(next(iter(found.values())))
    lines = [f"{count} rows, {len(found)} columns"]
    always: dict[str, list[str]] = {}
    for name, values in found.items():
        if len(set(values)) == 1:
            always.setdefault(values[0] or "nothing", []).append(name)
            continue
        if count <= ALL_ROWS:
            lines.append(f"{name}: {_runs(values)}")
            continue
        edges = [count * n // BLOCKS for n in range(BLOCKS + 1)]
        blocks = [values[begin:end] for begin, end in pairwise(edges)]
        some = _runs([block[0] for block in blocks] + values[-1:])
        digests = " ".join(_digest(block)[4:] for block in blocks)
        lines.append(f"{name}: {some} / {digests}")
    for value, names in always.items():
        lines.append(f"always {value}: {', '.join(names)}")
    return lines


def _log(suffix: str) -> Callable[[bytes], list[str]]:
    def form(data: bytes) -> list[str]:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / f"log{suffix}"
            file.write_bytes(data)
            with can.LogReader(file) as reader:
                found = list(reader)
        first = found[0].timestamp
        length = found[-1].timestamp - first
        ids = Counter(f"{each.arbitration_id:03X}" for each in found)
        frames = []
        for each in found:
            kind = (each.is_extended_id, each.is_fd, each.is_rx)
            frames.append((each.arbitration_id, *kind, bytes(each.data)))
        times = [round((each.timestamp - first) * 1e4) for each in found]
        counts = " ".join(f"{can_id}*{count}" for can_id, count in sorted(ids.items()))
        return [
            f"{len(found)} frames in {length:.4f} s, content {_digest(frames)}",
            f"times in 0.1 ms {_digest(times)}",
            f"ids {counts}",
        ]

    return form


def configuration(data: bytes) -> list[str]:
    """Return a line for each key in effect."""
    tables = json.loads(data)["configuration"]
    escs = tables.pop("esc")
    for number, esc in enumerate(escs, 1):
        tables[f"esc {number}"] = esc
    lines = []
    for name, keys in tables.items():
        for key, value in keys.items():
            lines.append(f"{name}.{key} = {json.dumps(value, ensure_ascii=False)}")
    return lines


def signals(data: bytes) -> list[str]:
    """Return a line for each message, and for each signal with its value and its meaning."""
    found = json.loads(data)
    lines = []
    for message in found.get("messages", ()):
        lines.append(" ".join(f"{key}={message[key]}" for key in message if key != "meaning"))
        for signal in found["signals"]:
            if signal["message"] != message["name"]:
                continue
            keys = ("signal", "esc", "shows", "unit", "page", "meaning")
            cells = [str(signal[key]) for key in keys if signal[key]]
            lines.append("  ".join(["", *cells]))
    return lines


def signals_short(data: bytes) -> list[str]:
    """Return a line for each message: its name, id, number of signals, and a digest of them."""
    lines = []
    message: list[str] = []
    for line in [*signals(data), "end"]:
        if line.startswith("  "):
            message.append(line)
            continue
        if message:
            lines.append(f"{message[0]} {len(message) - 1} signals {_digest(message)}")
        message = [line]
    return lines


FORMS: dict[str, Callable[[bytes], list[str]]] = {
    "dbc": dbc,
    "dbc short": dbc_short,
    "eds": eds,
    "dcf": dcf,
    "table": table,
    "last line": lambda data: data.decode("utf-8").splitlines()[-1:],
    "nothing": lambda data: [],
    "columns": lambda data: [
        re.sub(" {2,}", "  ", line) for line in data.decode("utf-8").splitlines()
    ],
    "configuration": configuration,
    "signals": signals,
    "signals short": signals_short,
    "size": lambda data: [f"{len(data)} bytes, {zlib.crc32(data):08X}"],
    "log": _log(".log"),
    "asc": _log(".asc"),
    "blf": _log(".blf"),
    "trc": _log(".trc"),
}
