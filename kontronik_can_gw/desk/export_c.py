"""Exports the core and its tables as C for a firmware.

The folder has the sources of the core, wire.h, the tables as constants, an example and a page. The
defaults of the macros in core.h leave out parts that the DBC does not need. The tables are the same
as for the shared object (``Tables.arrays``).
"""

import ctypes
import re
from collections.abc import Iterator, Sequence
from string import Template
from typing import Any

from kontronik_can_gw import __version__
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.native.header import KCG
from kontronik_can_gw.native.objects import FOLDER, wire_header
from kontronik_can_gw.native.rows import Settings
from kontronik_can_gw.native.tables import Tables
from kontronik_can_gw.signals.plan import MessageLayout

MARK = "made by kontronik-can-gw export c"
"""Text in the first line of every file. A later export may replace a file that has it."""
EXAMPLE = "example_main.c"
"""An existing file with this name belongs to the user and is never replaced."""
_CLASSIC = 8
_LARGE = 1 << 15
_WIDTH = 118


def exported(
    settings: CoreSettings,
    licence: str,
) -> dict[str, str]:
    """Return the text of each file by its name.

    Raises NotInCore if the core in C cannot express the layout or an ESC's settings.
    """
    layout = settings.layout
    escs = settings.escs
    tables = Tables(settings)
    core_c = (FOLDER / "core.c").read_text(encoding="utf-8")
    core_h = (FOLDER / "core.h").read_text(encoding="utf-8")
    for name, value in _options(layout, tables).items():
        core_h, count = re.subn(rf"(#define {name} +)\d+", rf"\g<1>{value}", core_h)
        assert count == 1, name
    names = _names("KCG_MESSAGE_", tables.names["message"])
    messages = [
        f"| {name.removeprefix('KCG_MESSAGE_')} | {_id(row)} | {row.length} |"
        for name, row in zip(names, tables.messages, strict=True)
    ]
    dbc = _plain(layout.file.rpartition("/")[2])
    size = sum(ctypes.sizeof(kind) * len(rows) for kind, rows in tables.arrays.values())
    words = {
        "dbc": dbc,
        "messages": "\n".join(messages),
        "escs": ", ".join(_plain(esc.name) for esc in escs),
        "tables": size,
        "licence": licence.strip(),
        "mark": MARK,
        "version": __version__,
    }
    folder = FOLDER / "firmware"
    template = Template((folder / "README.md").read_text(encoding="utf-8"))
    page = template.substitute(words)
    texts = {
        "core.c": core_c,
        "core.h": core_h,
        "wire.h": wire_header(),
        "tables.h": _header(dbc, tables, names, escs),
        "tables.c": "\n".join(_tables(tables)),
        EXAMPLE: (folder / EXAMPLE).read_text(encoding="utf-8"),
    }
    line = f"/* {MARK}, version {__version__}; SPDX-License-Identifier: MIT */\n"
    files = {name: line + text for name, text in texts.items()}
    files["README.md"] = page
    return files


def _options(layout: MessageLayout, tables: Tables) -> dict[str, int]:
    """Return the values of core.h's macros that this layout needs."""
    longest = max((plan.length for plan in layout.messages), default=0)
    has_floats = any(row.flags & KCG.REAL for row in tables.signals)
    has_pages = any(row.pages > 1 for row in tables.messages)
    has_crcs = any(row.flags & KCG.HAS_CRC for row in tables.messages)
    return {
        "KCG_DATA": _CLASSIC if longest <= _CLASSIC else 64,
        "KCG_FLOATS": int(has_floats),
        "KCG_PAGED": int(has_pages),
        "KCG_E2E": int(has_crcs),
    }


def _header(
    dbc: str,
    tables: Tables,
    names: Sequence[str],
    escs: Sequence[EscSettings],
) -> str:
    """Return tables.h: names of messages and ESCs, with their numbers, ids and lengths."""
    places = _names("KCG_ESC_", [esc.name for esc in escs])
    rows = []
    for name, row in zip(names, tables.messages, strict=True):
        _, can_id, length = _forms(name)
        rows.append(f"#define {can_id} {_id(row)}u\n#define {length} {row.length}")
    memory = f"KCG_MESSAGES, 0, KCG_ESCS, {tables.pages}, {len(tables.constants)}"
    parts = (
        "#ifndef KCG_TABLES_H",
        "#define KCG_TABLES_H",
        '#include "core.h"\n',
        f"/* Messages of {dbc}: place in kcg_tables.message, id (bit 31: 29 bits), data bytes. */",
        f"enum {{\n    {', '.join([*names, 'KCG_MESSAGES'])}\n}};".replace(", ", ",\n    "),
        *rows,
        "",
        "/* ESCs: the number of each in calls of the core. */",
        f"enum {{ {', '.join([*places, 'KCG_ESCS'])} }};\n",
        "/* Bytes for kcg_init. */",
        f"#define KCG_MEMORY KCG_SIZE({memory})\n",
        "#ifdef __cplusplus",
        'extern "C" {',
        "#endif",
        "extern const kcg_plan kcg_tables;",
        "extern const kcg_settings kcg_esc_settings[KCG_ESCS];",
        "#ifdef __cplusplus",
        "}",
        "#endif",
        "#endif\n",
    )
    return "\n".join(parts)


def _tables(tables: Tables) -> Iterator[str]:
    """Yield the lines of tables.c."""
    yield '#include "tables.h"'
    for name, (kind, rows) in tables.arrays.items():
        label = tables.names.get(name)
        c_type = f"uint{8 * ctypes.sizeof(kind)}_t"
        if issubclass(kind, ctypes.Structure):
            c_type = f"kcg_{name}"
        yield f"\nstatic const {c_type} {name}[] = {{"
        yield from _rows(kind, rows or [kind()], label)
        yield "};"
    yield "\nconst kcg_settings kcg_esc_settings[KCG_ESCS] = {"
    yield from _rows(Settings, tables.settings, None)
    yield "};\n\nconst kcg_plan kcg_tables = {"
    addresses = [f".{name} = {name}" for name in tables.arrays]
    numbers = [f".{name} = {number}" for name, number in tables.counts.items()]
    yield f"    {', '.join(addresses)},"
    yield f"    {', '.join(numbers)}"
    yield "};\n"


def _rows(
    kind: Any,
    rows: Sequence[Any],
    labels: Sequence[str] | None,
) -> Iterator[str]:
    """Yield the lines of a table's rows. Fields that are 0 are left out."""
    if not issubclass(kind, ctypes.Structure):
        values = [getattr(row, "value", row) for row in rows]
        numbers = [_number(kind, value) for value in values]
        each = 4 if ctypes.sizeof(kind) > 4 else 16
        for at in range(0, len(numbers), each):
            yield f"    {', '.join(numbers[at : at + each])},"
        return
    for place, row in enumerate(rows):
        fields = []
        for name, typed in kind._fields_:
            value = getattr(row, name)
            if isinstance(value, ctypes.Array) and any(value):
                texts = [_number(typed._type_, number) for number in value]
                fields.append(f".{name} = {{{', '.join(texts)}}}")
            elif isinstance(value, int) and value:
                fields.append(f".{name} = {_number(typed, value)}")
        if labels:
            yield f"    /* {_plain(labels[place])} */"
        yield f"    {{{', '.join(fields) or '0'}}},"


def _number(kind: Any, value: int) -> str:
    """Return a constant whose type can hold it, whatever the width of int is."""
    if abs(value) < _LARGE:
        return str(value)
    if kind is ctypes.c_int64:
        return f"INT64_C({value})" if value > -1 << 63 else "-INT64_C(9223372036854775807) - 1"
    return f"UINT{8 * ctypes.sizeof(kind)}_C({value:#x})"


def _id(row: Any) -> str:
    return f"0x{row.id:X}"


def _names(prefix: str, texts: Sequence[str]) -> list[str]:
    """Return a different C identifier for each text.

    Neither it nor the names of its id and length are names of the headers.
    """
    headers = wire_header() + (FOLDER / "core.h").read_text(encoding="utf-8")
    taken = set(re.findall(r"KCG_\w+", headers))
    found: list[str] = []
    for text in texts:
        base = prefix + re.sub(r"\W", "_", text, flags=re.ASCII)
        name = base
        number = 2
        while name in found or not taken.isdisjoint(_forms(name)):
            name = f"{base}_{number}"
            number += 1
        found.append(name)
    return found


def _forms(name: str) -> list[str]:
    can_id = name.replace("MESSAGE", "ID", 1)
    length = name.replace("MESSAGE", "LENGTH", 1)
    return [name, can_id, length]


def _plain(text: str) -> str:
    """Return ASCII text that can be in a comment or on a page without ending it."""
    return re.sub(
        r"[^\w .,+()-]",
        "_",
        text,
        flags=re.ASCII,
    )
