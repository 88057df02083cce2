"""Files by meaning: what stands in a DBC, an EDS, a table or a CAN log, however it is laid out. Nothing of the product is used."""

import configparser
import csv
import io
import json
import re
import tempfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import can
import cantools.database
from cantools.database.can import Database, Message

ALL_ROWS = 40
"""Tables of at most so many rows stand there whole; of longer ones some rows and digests."""
BLOCKS = 8


def _digest(items: Iterable[object]) -> str:
    return f"{zlib.crc32(repr(list(items)).encode()):08X}"


def spelled(text: str) -> str:
    """One spelling of a number; any other text as it is."""
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
    head = f"{message.frame_id:0{8 if message.is_extended_frame else 3}X} {message.name}: {message.length} bytes"
    lines = [
        f"{head}{' FD' if message.is_fd else ''} from {','.join(message.senders)}{_attributes(message)} ; {message.comment}"
    ]
    for s in sorted(message.signals, key=lambda signal: signal.name):
        form = f"{s.start}|{s.length}@{'big' if s.byte_order == 'big_endian' else 'little'}{'-' if s.is_signed else '+'}"
        form += f"{' float' if s.is_float else ''}{' M' if s.is_multiplexer else ''}{f' m{s.multiplexer_ids}' if s.multiplexer_ids else ''}"
        scale = f"({s.scale:g},{s.offset:g}) [{s.minimum}|{s.maximum}] {s.unit or '-'} raw start {s.raw_initial}"
        lines.append(
            f"  {s.name} {form} {scale} to {','.join(s.receivers)}{_attributes(s)} ; {s.comment}"
        )
        if s.choices:
            lines.append(
                "    " + " ".join(f"{number}={text}" for number, text in sorted(s.choices.items()))
            )
    return lines


def dbc(data: bytes) -> list[str]:
    """Everything: a line for each message, signal and value table, sorted by id and name."""
    found = database(data)
    lines = [f"database{_attributes(found)}"] + [
        f"node {node.name} ; {node.comment}" for node in found.nodes
    ]
    for message in sorted(found.messages, key=lambda m: (m.is_extended_frame, m.frame_id)):
        lines += _message(message)
    return lines


def dbc_short(data: bytes) -> list[str]:
    """A line for each message: what there is, and a digest of all of it."""
    lines = []
    for message in sorted(database(data).messages, key=lambda m: (m.is_extended_frame, m.frame_id)):
        lines.append(
            f"{message.frame_id:03X} {message.name} {message.cycle_time} ms {len(message.signals)} signals {_digest(_message(message))}"
        )
    return lines


def _sections(data: bytes) -> configparser.ConfigParser:
    found = configparser.ConfigParser(
        strict=True, interpolation=None, comment_prefixes=(";",), delimiters=("=",)
    )
    found.optionxform = str  # type: ignore[assignment, method-assign]
    found.read_string(data.decode("latin-1"))
    return found


_OF_THE_DAY = {"CreationDate", "CreationTime", "CreatedBy"}
_OF_THE_DAY |= {"ModificationDate", "ModificationTime", "ModifiedBy"}


def eds(data: bytes) -> list[str]:
    """A line for each section: its keys sorted, numbers in one spelling."""
    found = _sections(data)
    lines = []
    for name in sorted(found.sections(), key=str.upper):
        keys = {
            key: value for key, value in found[name].items() if key not in _OF_THE_DAY and value
        }
        lines.append(f"[{name.upper()}] {_keys(dict(sorted(keys.items())))}")
    return lines


def _keys(values: Mapping[str, str]) -> str:
    return " ".join(f"{key}={spelled(value)}" for key, value in values.items())


def dcf(data: bytes) -> list[str]:
    """What a DCF adds to its EDS: the sections that are about the node, and ParameterValue."""
    found = _sections(data)
    lines = [line for line in eds(data) if line.startswith(("[DEVICECOM", "[FILEINFO"))]
    for name in sorted(found.sections(), key=str.upper):
        values = {k: found[name][k] for k in ("ParameterValue", "Denotation") if k in found[name]}
        if values and "Com" not in name:
            lines.append(f"[{name.upper()}] {_keys(values)}")
    return lines


def columns(data: bytes) -> dict[str, list[str]]:
    """A CSV table, or JSON lines, by columns; values in one spelling, nothing for what is not there."""
    text = data.decode("utf-8")
    found: dict[str, list[str]] = {}
    if text.startswith("{"):
        rows = [json.loads(line) for line in text.splitlines()]
        for name in dict.fromkeys(name for row in rows for name in row):
            found[name] = [_cell(row.get(name)) for row in rows]
        return found
    head, *lines = list(csv.reader(io.StringIO(text)))
    return {name: [spelled(line[at]) for line in lines] for at, name in enumerate(head)}


def _cell(value: object) -> str:
    if isinstance(value, (dict, list)):
        return json.dumps(value, separators=(",", ":"), ensure_ascii=False)
    return "" if value is None else spelled(str(value))


def _runs(values: Sequence[str]) -> str:
    """Values in a row; `x*3` for the same three times, `-` for nothing."""
    parts = []
    for value, same in groupby(each.replace(" ", "_") or "-" for each in values):
        count = len(list(same))
        parts.append(value if count == 1 else f"{value}*{count}")
    return " ".join(parts)


def table(data: bytes) -> list[str]:
    """As ``column_lines``."""
    return column_lines(columns(data))


def column_lines(found: Mapping[str, list[str]]) -> list[str]:
    """A line for each column: its values; of a long table some of them and a digest of each eighth. Those that never change share one."""
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
        blocks = [values[count * n // BLOCKS : count * (n + 1) // BLOCKS] for n in range(BLOCKS)]
        some = _runs([block[0] for block in blocks] + values[-1:])
        lines.append(f"{name}: {some} / {' '.join(_digest(block)[4:] for block in blocks)}")
    return lines + [f"always {value}: {', '.join(names)}" for value, names in always.items()]


def _log(suffix: str) -> Callable[[bytes], list[str]]:
    def form(data: bytes) -> list[str]:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / f"log{suffix}"
            file.write_bytes(data)
            with can.LogReader(file) as reader:
                found = list(reader)
        first = found[0].timestamp
        ids = Counter(f"{m.arbitration_id:03X}" for m in found)
        frames = [
            (m.arbitration_id, m.is_extended_id, m.is_fd, m.is_rx, bytes(m.data)) for m in found
        ]
        return [
            f"{len(found)} frames in {found[-1].timestamp - first:.4f} s, content {_digest(frames)}",
            f"times in 0.1 ms {_digest(round((m.timestamp - first) * 1e4) for m in found)}",
            "ids " + " ".join(f"{can_id}*{count}" for can_id, count in sorted(ids.items())),
        ]

    return form


def configuration(data: bytes) -> list[str]:
    """A line for each key in effect."""
    tables = json.loads(data)["configuration"]
    escs = {f"esc {number}": esc for number, esc in enumerate(tables.pop("esc"), 1)}
    return [
        f"{name}.{key} = {json.dumps(value, ensure_ascii=False)}"
        for name, table in {**tables, **escs}.items()
        for key, value in table.items()
    ]


def signals(data: bytes) -> list[str]:
    """A line for each message, and for each signal: what it shows, and its meaning."""
    found = json.loads(data)
    lines = []
    for message in found.get("messages", ()):
        lines.append(" ".join(f"{key}={message[key]}" for key in message if key != "meaning"))
        for each in (s for s in found["signals"] if s["message"] == message["name"]):
            keys = ("signal", "esc", "shows", "unit", "page", "meaning")
            lines.append("  ".join(["", *(str(each[key]) for key in keys if each[key])]))
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
    "size": lambda data: [f"{len(data)} bytes, {zlib.crc32(data):08X}"],
    "log": _log(".log"),
    "asc": _log(".asc"),
    "blf": _log(".blf"),
    "trc": _log(".trc"),
}
