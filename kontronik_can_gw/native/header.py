"""Structures and enumerations of the core's headers, read from their text: they are written down nowhere else."""

import ctypes as c
import re
from collections.abc import Container, Iterator
from functools import cache
from types import SimpleNamespace
from typing import Any

from kontronik_can_gw.native.objects import FOLDER, OPTIONS, wire_header


class NotInCore(ValueError):
    """The core in C does not have this: the message in words."""


class _PollFd(c.Structure):
    _fields_ = (("fd", c.c_int), ("events", c.c_short), ("revents", c.c_short))


class _Row(c.Structure):
    """A row of a table. A number that its field cannot hold is NotInCore: ctypes would cut it off."""

    def __init__(self, *values: Any, **named: Any) -> None:
        super().__init__()
        names = [field[0] for field in self._fields_]
        for name, value in (*zip(names, values, strict=False), *named.items()):
            setattr(self, name, value)

    def __setattr__(self, name: str, value: Any) -> None:
        super().__setattr__(name, value)
        if isinstance(value, int) and getattr(self, name) != value:
            raise NotInCore(f"{name} {value} does not fit")


_ROWS = {"kcg_piece", "kcg_pair", "kcg_signal", "kcg_message", "kcg_settings", "kcg_slot_row"}
_TYPES = {f"{name}_t": getattr(c, f"c_{name}") for name in ("int16", "int32", "int64")}
_TYPES |= {f"{name}_t": getattr(c, f"c_{name}") for name in ("uint8", "uint16", "uint32", "uint64")}
_TYPES |= {"int": c.c_int, "double": c.c_double, "size_t": c.c_size_t, "pollfd": _PollFd}
_FIELD = re.compile(r"(\*?)(\w+)(?:\[(.+)\])?")
_TEXT = re.sub(
    r"/\*.*?\*/",
    "",
    wire_header()
    + "".join((FOLDER / name).read_text(encoding="utf-8") for name in ("core.h", "offline.h", "linux.h")),
    flags=re.DOTALL,
)  # fmt: skip
_STRUCTURES = {
    name: (kind, body)
    for kind, body, name in re.findall(r"typedef (struct|union) \{(.*?)\} (\w+);", _TEXT, re.DOTALL)
}
CONSTANTS = {name: int(value) for name, value in re.findall(r"#define (KCG_\w+) +(\d+)\n", _TEXT)}
"""Every enumerator and option by name, as the shared objects have them."""
CONSTANTS |= {name[2:]: int(value) for name, _, value in (part.partition("=") for part in OPTIONS)}


def _number(text: str) -> int:
    """Of an expression: a sum of numbers, names and shifted numbers."""
    found = 0
    for part in text.split("+"):
        number, _, shift = (word.strip() for word in part.partition("<<"))
        found += (CONSTANTS[number] if number in CONSTANTS else int(number)) << int(shift or 0)
    return found


def _enumerations() -> list[list[str]]:
    found = []
    for body in re.findall(r"enum \{(.*?)\}", _TEXT, re.DOTALL):
        parts = [part.partition("=") for part in body.split(",")]
        found.append([name.strip() for name, _, _ in parts])
        number = 0
        for name, _, value in parts:
            number = _number(value) if value else number
            CONSTANTS[name.strip()] = number
            number += 1
    return found


_ENUMERATIONS = _enumerations()
KCG: Any = SimpleNamespace(**{n.removeprefix("KCG_"): value for n, value in CONSTANTS.items()})
"""The same as attributes, without the prefix."""


def enumeration(first: str, prefix: str = "KCG_") -> list[str]:
    """The names that begin with the prefix, without it and in small letters, of the enumeration that begins with ``first``."""
    (names,) = (names for names in _ENUMERATIONS if names[0] == first)
    return [name.removeprefix(prefix).lower() for name in names if name.startswith(prefix)]


def _typed(of: str, pointer: str, texts: Container[str]) -> Any:
    if pointer:
        return c.c_char_p if of in texts else c.c_void_p
    return None if of == "void" else structure(of)


@cache
def structure(name: str) -> Any:
    """The ctypes class of a structure: pointers are addresses, but for texts."""
    if name in _TYPES:
        return _TYPES[name]
    kind, body = _STRUCTURES[name]
    fields: list[tuple[str, Any]] = []
    for of, names in re.findall(r"(?:const )?(?:struct )?(\w+) ([^;]+);", body):
        for each in names.split(","):
            pointer, field, length = _FIELD.fullmatch(each.strip()).groups()  # type: ignore[union-attr]
            typed = _typed(of, pointer, ("char",))
            fields.append((field, typed * _number(length) if length else typed))
    base = c.Union if kind == "union" else _Row if name in _ROWS else c.Structure
    return type(name, (base,), {"_fields_": fields})


def functions() -> Iterator[tuple[str, list[Any]]]:
    """Of each function its name, and the types of its result and arguments; bytes are texts, too."""
    found = re.findall(r"^(?:const )?(\w+) (\*?)(kcg_\w+)\(([^)]*)\);", _TEXT, re.MULTILINE)
    for of, pointer, name, arguments in found:
        given: list[tuple[str, str]] = re.findall(r"(?:const )?(\w+) (\*?)\w+", arguments)
        types = [(of, pointer), *given]
        yield name, [_typed(*each, ("char", "uint8_t")) for each in types]
