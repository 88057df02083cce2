"""Types, limits and defaults of the entries of an EDS: whether each value fits its type (CiA 306, 4.6.3)."""

import re
import struct

from kontronik_can_gw.canopen.data_types import (
    DOMAIN,
    DOMAIN_TYPE,
    FLOATS,
    OCTET_STRING,
    REAL32,
    SIGNED,
    TYPE_BITS,
    TYPE_NAMES,
    UNICODE_STRING,
    VISIBLE_STRING,
)
from kontronik_can_gw.canopen.eds_sections import Problems, Section, choices, integer

_NODE_ID = re.compile(
    r"\$NODEID(?:\+(?P<after>[^+]+))?$|(?P<before>[^+]+)\+\$NODEID$", re.IGNORECASE
)
Number = int | float | bytes | None


def data_type_of(problems: Problems, section: Section, kind: int, index: int) -> int:
    """The type; 0, after a complaint, where it is refused."""
    data_type = problems.number(section, "DataType", DOMAIN_TYPE if kind == DOMAIN else None)
    if data_type is None:
        if not section.get("DataType"):
            problems.add(section.name, "DataType: missing. Write 0x0005 for UNSIGNED8 and so on.")
        return 0
    if kind == DOMAIN and data_type != DOMAIN_TYPE:
        problems.add(section.name, f"DataType=0x{data_type:04X}: the type of a DOMAIN is 0x000F.")
        return 0
    if data_type not in TYPE_NAMES:
        problems.add(
            section.name,
            f"DataType=0x{data_type:04X}: not supported. Take one of {choices(TYPE_NAMES)}.",
        )
        return 0
    if TYPE_BITS.get(data_type, 0) > 32 and index < 0x2000:
        problems.add(
            section.name, f"DataType=0x{data_type:04X}: 64 bits are for objects from 2000h on."
        )
        return 0
    return data_type


def limits(problems: Problems, section: Section, data_type: int) -> tuple[int | None, int | None]:
    low = _limit(problems, section, "LowLimit", data_type)
    high = _limit(problems, section, "HighLimit", data_type)
    if low is not None and high is not None and low > high:
        problems.add(
            section.name,
            f"LowLimit={section.get('LowLimit')}: above HighLimit={section.get('HighLimit')}.",
        )
        return None, None
    return low, high


def check_inside(
    problems: Problems, section: Section, default: int, low: int | None, high: int | None
) -> None:
    said = f"DefaultValue={section.get('DefaultValue')}"
    if low is not None and default < low:
        problems.add(section.name, f"{said}: below LowLimit={section.get('LowLimit')}.")
    if high is not None and default > high:
        problems.add(section.name, f"{said}: above HighLimit={section.get('HighLimit')}.")


def _limit(problems: Problems, section: Section, key: str, data_type: int) -> int | None:
    text = section.get(key)
    if not text or not data_type:
        return None
    if data_type not in TYPE_BITS or data_type in FLOATS:
        problems.add(section.name, f"{key}={text}: only whole numbers have limits. Leave it empty.")
        return None
    return _fitting(problems, section, key, text, data_type)


def _fitting(
    problems: Problems, section: Section, key: str, text: str, data_type: int, room: int = 0
) -> int | None:
    """A whole number that fits its type with ``room`` above it. Signed ones may be hexadecimal in two's complement."""
    number = integer(text)
    if number is None:
        problems.add(section.name, f"{key}={section.get(key)}: not a number. Write 0x1F or 31.")
        return None
    bits = TYPE_BITS[data_type]
    low, high = (
        (-(1 << bits - 1), (1 << bits - 1) - 1) if data_type in SIGNED else (0, (1 << bits) - 1)
    )
    if data_type in SIGNED and "x" in text.lower() and high < number < 1 << bits:
        number -= 1 << bits
    if low <= number <= high - room:
        return number
    problems.add(
        section.name,
        f"{key}={section.get(key)}: does not fit {TYPE_NAMES[data_type]}, {low} to {high}.",
    )
    return None


def default_value(problems: Problems, section: Section, data_type: int) -> tuple[Number, bool]:
    """The default, and whether the node-ID is to be added to it."""
    text = section.get("DefaultValue")
    if not text or not data_type:
        return None, False
    if data_type in (VISIBLE_STRING, UNICODE_STRING):
        coding = "utf-16-le" if data_type == UNICODE_STRING else "ascii"
        return text.encode(coding, "replace"), False
    if data_type in (OCTET_STRING, DOMAIN_TYPE):
        try:
            return bytes.fromhex(text), False
        except ValueError:
            problems.add(
                section.name,
                f"DefaultValue={text}: not bytes. Write pairs of hexadecimal digits, or nothing.",
            )
            return None, False
    if data_type in FLOATS:
        return _real(problems, section, text, data_type), False
    if match := _NODE_ID.match(text.replace(" ", "")):
        value = match["after"] or match["before"] or "0"
        return _fitting(problems, section, "DefaultValue", value, data_type, room=127), True
    return _fitting(problems, section, "DefaultValue", text, data_type), False


def _real(problems: Problems, section: Section, text: str, data_type: int) -> float | None:
    """A decimal, or the hexadecimal bits of the IEEE number that CiA 306 writes."""
    try:
        if "x" not in text.lower():
            return float(text)
        size, code = (4, ">f") if data_type == REAL32 else (8, ">d")
        number: float = struct.unpack(code, int(text, 16).to_bytes(size, "big"))[0]
        return number
    except (ValueError, OverflowError):
        problems.add(section.name, f"DefaultValue={text}: not a number. Write 1.5.")
        return None
