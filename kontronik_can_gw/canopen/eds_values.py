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
    range_of,
)
from kontronik_can_gw.canopen.eds_sections import Section, choices, integer

_NODE_ID = re.compile(
    r"\$NODEID(?:\+(?P<after>[^+]+))?$|(?P<before>[^+]+)\+\$NODEID$", re.IGNORECASE
)
Number = int | float | bytes | None


def data_type_of(section: Section, kind: int, index: int) -> int:
    """The type; 0, after a complaint, where it is refused."""
    data_type = section.number("DataType", DOMAIN_TYPE if kind == DOMAIN else None)
    if data_type is None:
        if not section.get("DataType"):
            section.wrong("DataType: missing. Write 0x0005 for UNSIGNED8 and so on.")
        return 0
    said = f"DataType=0x{data_type:04X}"
    if kind == DOMAIN and data_type != DOMAIN_TYPE:
        section.wrong(f"{said}: the type of a DOMAIN is 0x000F.")
    elif data_type not in TYPE_NAMES:
        section.wrong(f"{said}: not supported. Take one of {choices(TYPE_NAMES)}.")
    elif TYPE_BITS.get(data_type, 0) > 32 and index < 0x2000:
        section.wrong(f"{said}: 64 bits are for objects from 2000h on.")
    else:
        return data_type
    return 0


def limits(section: Section, data_type: int) -> tuple[int | None, int | None]:
    low, high = (_limit(section, key, data_type) for key in ("LowLimit", "HighLimit"))
    if low is not None and high is not None and low > high:
        section.wrong(f"{section.said('LowLimit')}: above {section.said('HighLimit')}.")
        return None, None
    return low, high


def _limit(section: Section, key: str, data_type: int) -> int | None:
    text = section.get(key)
    if not text or not data_type:
        return None
    if data_type not in TYPE_BITS or data_type in FLOATS:
        section.wrong(f"{key}={text}: only whole numbers have limits. Leave it empty.")
        return None
    return _fitting(section, key, text, data_type)


def _fitting(section: Section, key: str, text: str, data_type: int, room: int = 0) -> int | None:
    """A whole number that fits its type with ``room`` above it. Signed ones may be hexadecimal in two's complement."""
    number = integer(text)
    if number is None:
        section.wrong(f"{section.said(key)}: not a number. Write 0x1F or 31.")
        return None
    low, high = range_of(data_type)
    if data_type in SIGNED and "x" in text.lower() and high < number <= high - low:
        number -= high - low + 1
    if low <= number <= high - room:
        return number
    section.wrong(f"{section.said(key)}: does not fit {TYPE_NAMES[data_type]}, {low} to {high}.")
    return None


def default_value(
    section: Section, data_type: int, low: int | None, high: int | None
) -> tuple[Number, bool]:
    """The default, and whether the node-ID is to be added to it. Without, it must be from ``low`` to ``high``."""
    text = section.get("DefaultValue")
    if not text or not data_type:
        return None, False
    if data_type in (VISIBLE_STRING, UNICODE_STRING):
        coding = "utf-16-le" if data_type == UNICODE_STRING else "ascii"
        return text.encode(coding, "replace"), False
    said = section.said("DefaultValue")
    if data_type in (OCTET_STRING, DOMAIN_TYPE):
        try:
            return bytes.fromhex(text), False
        except ValueError:
            section.wrong(f"{said}: not bytes. Write pairs of hexadecimal digits, or nothing.")
            return None, False
    if data_type in FLOATS:
        return _real(section, text, data_type), False
    if match := _NODE_ID.match(text.replace(" ", "")):
        value = match["after"] or match["before"] or "0"
        return _fitting(section, "DefaultValue", value, data_type, room=127), True
    default = _fitting(section, "DefaultValue", text, data_type)
    if default is not None and low is not None and default < low:
        section.wrong(f"{said}: below {section.said('LowLimit')}.")
    if default is not None and high is not None and default > high:
        section.wrong(f"{said}: above {section.said('HighLimit')}.")
    return default, False


def _real(section: Section, text: str, data_type: int) -> float | None:
    """A decimal, or the hexadecimal bits of the IEEE number that CiA 306 writes."""
    try:
        if "x" not in text.lower():
            return float(text)
        size, code = (4, ">f") if data_type == REAL32 else (8, ">d")
        number: float = struct.unpack(code, int(text, 16).to_bytes(size, "big"))[0]
        return number
    except (ValueError, OverflowError):
        section.wrong(f"DefaultValue={text}: not a number. Write 1.5.")
        return None
