"""Parameters of a node (uavcan.protocol.param.GetSet): a list to be read; what somebody sets stays as it is."""

import struct
from collections.abc import Sequence

from kontronik_can_gw.dronecan.types import MAX_PARAMETER_NAME

Parameter = tuple[str, int | float | str]
_VALUE_SIZES = {0: 0, 1: 8, 2: 4, 3: 1}
"""Bytes of a value by the tag of its union: none, integer, real, boolean."""
_STRING = 4


def answer(request: bytes, parameters: Sequence[Parameter]) -> bytes | None:
    """The response: the parameter that is named, else that of the index; an empty one where there is none. None to what is no request."""
    if len(request) < 2:
        return None
    index, tag = request[0] | request[1] >> 3 << 8, request[1] & 7
    rest = request[2:]
    if tag == _STRING and rest and len(rest) > rest[0]:
        rest = rest[1 + rest[0] :]
    elif tag in _VALUE_SIZES and len(rest) >= _VALUE_SIZES[tag]:
        rest = rest[_VALUE_SIZES[tag] :]
    else:
        return None
    if wanted := rest.decode("latin-1"):
        found = [each for each in parameters if each[0] == wanted]
    else:
        found = list(parameters[index : index + 1])
    # without a default and limits: nobody can set it
    name, value = (found[0][0], _value(found[0][1])) if found else ("", b"\0")
    return value + b"\0\0\0" + name.encode("ascii")[:MAX_PARAMETER_NAME]


def _value(value: float | str) -> bytes:
    if isinstance(value, int):
        return struct.pack("<Bq", 1, value)
    if isinstance(value, float):
        return struct.pack("<Bf", 2, value)
    text = value.encode("ascii")
    return bytes((_STRING, len(text))) + text
