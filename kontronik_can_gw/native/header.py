"""Structures, constants and functions of the core's headers, read from the text of the headers.

So each of them is defined in one place.
"""

import ctypes as c
import re
from collections.abc import Container, Iterator
from functools import cache
from types import SimpleNamespace
from typing import Any

from kontronik_can_gw.native.objects import FOLDER, OPTIONS, generated_headers


class NotInCore(ValueError):
    """The core in C cannot do this. The message explains what."""


class _PollFd(c.Structure):
    _fields_ = (
        ("fd", c.c_int),
        ("events", c.c_short),
        ("revents", c.c_short),
    )


class _Row(c.Structure):
    """A row of a table. A number that its field cannot hold raises NotInCore.

    ctypes would silently cut it off.
    """

    def __init__(self, *values: Any, **named: Any) -> None:
        super().__init__()
        names = [field[0] for field in self._fields_]
        for name, value in zip(names, values, strict=False):
            setattr(self, name, value)
        for name, value in named.items():
            setattr(self, name, value)

    def __setattr__(self, name: str, value: Any) -> None:
        super().__setattr__(name, value)
        if isinstance(value, int) and getattr(self, name) != value:
            raise NotInCore(f"{name} {value} is too large")


_ROWS = {
    "kcg_piece",
    "kcg_pair",
    "kcg_signal",
    "kcg_message",
    "kcg_e2e",
    "kcg_settings",
    "kcg_slot_row",
}
_TYPES: dict[str, Any] = {
    "int": c.c_int,
    "int16_t": c.c_int16,
    "int32_t": c.c_int32,
    "int64_t": c.c_int64,
    "uint8_t": c.c_uint8,
    "uint16_t": c.c_uint16,
    "uint32_t": c.c_uint32,
    "uint64_t": c.c_uint64,
    "double": c.c_double,
    "size_t": c.c_size_t,
    "pollfd": _PollFd,
}
_FIELD = re.compile(r"(\*?)(\w+)(?:\[(.+)\])?")
_FILES = ("core.h", "offline.h", "linux.h")


def _text_without_comments() -> str:
    texts = [*generated_headers().values()]
    for name in _FILES:
        texts.append((FOLDER / name).read_text(encoding="utf-8"))
    return re.sub(r"/\*.*?\*/", "", "".join(texts), flags=re.DOTALL)


_TEXT = _text_without_comments()
_STRUCTURES = {
    name: (kind, body)
    for kind, body, name in re.findall(r"typedef (struct|union) \{(.*?)\} (\w+);", _TEXT, re.DOTALL)
}
CONSTANTS: dict[str, int] = {}
"""Every enumerator and option by name, with its value in the shared objects."""
for _name, _value in re.findall(r"#define (KCG_\w+) +(\d+)\s*?\n", _TEXT):
    CONSTANTS[_name] = int(_value)
for _option in OPTIONS:
    _name, _, _value = _option.removeprefix("-D").partition("=")
    CONSTANTS[_name] = int(_value)


def _number(text: str) -> int:
    """Return the value of a sum of numbers, names and shifted numbers."""
    total = 0
    for part in text.split("+"):
        word, _, shift = part.partition("<<")
        word = word.strip()
        number = CONSTANTS[word] if word in CONSTANTS else int(word)
        total += number << int(shift or 0)
    return total


def _enumerations() -> list[list[str]]:
    """Return the names of each enumeration, and enter their values in CONSTANTS."""
    found = []
    for body in re.findall(r"enum \{(.*?)\}", _TEXT, re.DOTALL):
        names = []
        number = 0
        for part in body.split(","):
            word, _, value = part.partition("=")
            name = word.strip()
            if value:
                number = _number(value)
            CONSTANTS[name] = number
            number += 1
            names.append(name)
        found.append(names)
    return found


_ENUMERATIONS = _enumerations()
KCG: Any = SimpleNamespace(**{name.removeprefix("KCG_"): CONSTANTS[name] for name in CONSTANTS})
"""The constants as attributes, without the prefix."""


def enumeration(first: str, prefix: str = "KCG_") -> list[str]:
    """Return the names in the enumeration that begins with ``first``.

    Names without the prefix are left out. The others are in lower case, without it.
    """
    (names,) = (names for names in _ENUMERATIONS if names[0] == first)
    found = []
    for name in names:
        if name.startswith(prefix):
            found.append(name.removeprefix(prefix).lower())
    return found


def _ctype(of: str, pointer: str, texts: Container[str]) -> Any:
    """Return the ctypes type. Pointers are addresses, except those to a type in ``texts``."""
    if pointer:
        return c.c_char_p if of in texts else c.c_void_p
    return None if of == "void" else structure(of)


@cache
def structure(name: str) -> Any:
    """Return the ctypes class of a structure or a number. Pointers to char are texts."""
    if name in _TYPES:
        return _TYPES[name]
    kind, body = _STRUCTURES[name]
    fields: list[tuple[str, Any]] = []
    for of, names in re.findall(r"(?:const )?(?:struct )?(\w+) ([^;]+);", body):
        for each in names.split(","):
            match = _FIELD.fullmatch(each.strip())
            assert match is not None, each
            pointer, field, length = match.groups()
            ctype = _ctype(of, pointer, ("char",))
            if length:
                ctype = ctype * _number(length)
            fields.append((field, ctype))
    base: Any = c.Structure
    if kind == "union":
        base = c.Union
    elif name in _ROWS:
        base = _Row
    return type(name, (base,), {"_fields_": fields})


def functions() -> Iterator[tuple[str, list[Any]]]:
    """Yield each function's name, and the types of its result and then of its arguments."""
    texts = ("char", "uint8_t")
    found = re.findall(r"^(?:const )?(\w+) (\*?)(kcg_\w+)\(([^)]*)\);", _TEXT, re.MULTILINE)
    for result, is_pointer, name, arguments in found:
        types = [_ctype(result, is_pointer, texts)]
        for of, pointer in re.findall(r"(?:const )?(\w+) (\*?)\w+", arguments):
            types.append(_ctype(of, pointer, texts))
        yield name, types
