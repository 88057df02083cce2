"""Data types of CiA 301 (table 44) that the object dictionary can have."""

import struct

BOOLEAN = 0x01
U8, U16, U32 = 0x05, 0x06, 0x07
VISIBLE_STRING, OCTET_STRING, UNICODE_STRING, DOMAIN_TYPE = 0x09, 0x0A, 0x0B, 0x0F
REAL32, REAL64 = 0x08, 0x11
_TYPES = {
    BOOLEAN: ("BOOLEAN", "?"),
    0x02: ("INTEGER8", "b"),
    0x03: ("INTEGER16", "h"),
    0x04: ("INTEGER32", "i"),
    U8: ("UNSIGNED8", "B"),
    U16: ("UNSIGNED16", "H"),
    U32: ("UNSIGNED32", "I"),
    REAL32: ("REAL32", "f"),
    VISIBLE_STRING: ("VISIBLE_STRING", ""),
    OCTET_STRING: ("OCTET_STRING", ""),
    UNICODE_STRING: ("UNICODE_STRING", ""),
    DOMAIN_TYPE: ("DOMAIN", ""),
    REAL64: ("REAL64", "d"),
    0x15: ("INTEGER64", "q"),
    0x1B: ("UNSIGNED64", "Q"),
}
"""Name, and of a number its struct code."""
TYPE_NAMES = {code: name for code, (name, _) in _TYPES.items()}
SIGNED = frozenset(code for code, (_, form) in _TYPES.items() if form and form in "bhiq")
FLOATS = frozenset({REAL32, REAL64})
CODECS = {code: struct.Struct(f"<{form}") for code, (_, form) in _TYPES.items() if form}
"""Of the number types, by their codes."""
TYPE_BITS = {code: 8 * found.size for code, found in CODECS.items()} | {BOOLEAN: 1}
"""Bits of a number type."""
WHOLE = TYPE_BITS.keys() - FLOATS - {BOOLEAN}
"""The types of whole numbers."""


def range_of(data_type: int) -> tuple[int, int]:
    """Smallest and greatest value of a type of whole numbers, or BOOLEAN."""
    bits = TYPE_BITS.get(data_type, 0)
    if data_type in SIGNED:
        return -(1 << bits - 1), (1 << bits - 1) - 1
    return 0, (1 << bits) - 1
