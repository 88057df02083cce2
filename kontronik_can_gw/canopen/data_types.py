"""Data types and object codes of CiA 301 (tables 42 and 44) that the object dictionary can have."""

import struct

DOMAIN, VAR, ARRAY, RECORD = 2, 7, 8, 9
"""Object codes."""
KINDS = {DOMAIN: "DOMAIN", VAR: "VAR", ARRAY: "ARRAY", RECORD: "RECORD"}

BOOLEAN = 0x01
U8, U16, U32 = 0x05, 0x06, 0x07
VISIBLE_STRING, OCTET_STRING, UNICODE_STRING, DOMAIN_TYPE = 0x09, 0x0A, 0x0B, 0x0F
REAL32, REAL64 = 0x08, 0x11
SIGNED = frozenset({0x02, 0x03, 0x04, 0x15})
FLOATS = frozenset({REAL32, REAL64})
TYPE_NAMES = {
    BOOLEAN: "BOOLEAN",
    0x02: "INTEGER8",
    0x03: "INTEGER16",
    0x04: "INTEGER32",
    U8: "UNSIGNED8",
    U16: "UNSIGNED16",
    U32: "UNSIGNED32",
    REAL32: "REAL32",
    VISIBLE_STRING: "VISIBLE_STRING",
    OCTET_STRING: "OCTET_STRING",
    UNICODE_STRING: "UNICODE_STRING",
    DOMAIN_TYPE: "DOMAIN",
    REAL64: "REAL64",
    0x15: "INTEGER64",
    0x1B: "UNSIGNED64",
}
_CODECS = {
    BOOLEAN: struct.Struct("<?"),
    0x02: struct.Struct("<b"),
    0x03: struct.Struct("<h"),
    0x04: struct.Struct("<i"),
    U8: struct.Struct("<B"),
    U16: struct.Struct("<H"),
    U32: struct.Struct("<I"),
    REAL32: struct.Struct("<f"),
    REAL64: struct.Struct("<d"),
    0x15: struct.Struct("<q"),
    0x1B: struct.Struct("<Q"),
}
TYPE_BITS = {code: 8 * found.size for code, found in _CODECS.items()} | {BOOLEAN: 1}
"""Bits of a number type."""
WHOLE = TYPE_BITS.keys() - FLOATS - {BOOLEAN}
"""The types of whole numbers."""


def codec(data_type: int) -> struct.Struct | None:
    """The codec of a number type; None for texts and domains."""
    return _CODECS.get(data_type)


def range_of(data_type: int) -> tuple[int, int]:
    """Smallest and greatest value of a type of whole numbers, or BOOLEAN."""
    bits = TYPE_BITS.get(data_type, 0)
    if data_type in SIGNED:
        return -(1 << bits - 1), (1 << bits - 1) - 1
    return 0, (1 << bits) - 1
