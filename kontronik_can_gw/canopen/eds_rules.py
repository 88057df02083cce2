"""What CiA 301 and 302 ask of communication objects, and of default PDO mappings: without it the services could not work."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from kontronik_can_gw.canopen.data_types import (
    ARRAY,
    DOMAIN,
    DOMAIN_TYPE,
    KINDS,
    RECORD,
    TYPE_BITS,
    TYPE_NAMES,
    U8,
    U16,
    U32,
    VAR,
    VISIBLE_STRING,
)
from kontronik_can_gw.canopen.eds_object import EdsObject

Wrong = Callable[[str, str], None]
"""Is given the section and the text of a mistake."""

_MANDATORY = (0x1000, 0x1001, 0x1018)
_MAX_MAPPED = 0x40
_PDO_BITS = 64


@dataclass(frozen=True)
class _Shape:
    """What CiA 301 and 302 ask of a communication object: object codes, types by sub-index, sub-indices it cannot be without."""

    kinds: tuple[int, ...]
    types: Mapping[int, tuple[int, ...]]
    needed: tuple[int, ...] = ()


def _var(*types: int) -> _Shape:
    return _Shape((VAR,), {0: types})


def _list(kind: int, data_type: int, last: int, *needed: int) -> _Shape:
    return _Shape((kind,), {0: (U8,)} | dict.fromkeys(range(1, last + 1), (data_type,)), needed)


_COMMUNICATION: Mapping[int, _Shape] = {
    0x1000: _var(U32),
    0x1001: _var(U8),
    0x1002: _var(U32),
    0x1003: _list(ARRAY, U32, 0xFE, 1),
    0x1005: _var(U32),
    0x1008: _var(VISIBLE_STRING),
    0x1009: _var(VISIBLE_STRING),
    0x100A: _var(VISIBLE_STRING),
    0x1010: _list(ARRAY, U32, 0x7F, 1),
    0x1011: _list(ARRAY, U32, 0x7F, 1),
    0x1014: _var(U32),
    0x1015: _var(U16),
    0x1016: _list(ARRAY, U32, 0x7F, 1),
    0x1017: _var(U16),
    0x1018: _list(RECORD, U32, 4, 1),
    0x1019: _var(U8),
    0x1020: _list(ARRAY, U32, 2, 1, 2),
    0x1021: _Shape((DOMAIN, VAR), {0: (DOMAIN_TYPE,)}),
    0x1022: _var(U8, U16),  # copies of the table differ in the width
    0x1029: _list(ARRAY, U8, 0xFE, 1),
    0x1200: _list(RECORD, U32, 2, 1, 2),
    0x1F80: _var(U32),
}
# Sub-index 4 is reserved.
_PDO_COMMUNICATION = _Shape(
    (RECORD,), {0: (U8,), 1: (U32,), 2: (U8,), 3: (U16,), 5: (U16,), 6: (U8,)}, (1, 2)
)
_PDO_MAPPING = _Shape((RECORD, ARRAY), _list(RECORD, U32, 0x40).types)
_PDO_COMMUNICATIONS, _PDO_MAPPINGS = range(0x1800, 0x1A00), range(0x1A00, 0x1C00)


def counts(index: int) -> bool:
    """Whether sub-index 0 is a count that changes: errors kept, objects mapped."""
    return index == 0x1003 or index in _PDO_MAPPINGS


def _shape(index: int) -> _Shape | None:
    if index in _PDO_COMMUNICATIONS:
        return _PDO_COMMUNICATION
    if index in _PDO_MAPPINGS:
        return _PDO_MAPPING
    return _COMMUNICATION.get(index)


def check(objects: Mapping[int, EdsObject], wrong: Wrong) -> None:
    """Report what is wrong."""
    for index in _MANDATORY:
        if index not in objects:
            wrong(f"{index:04X}", "this object is mandatory and is not there. Add it.")
    for index in sorted(objects):
        if index < 0x2000:
            _check_communication(objects[index], wrong)
    for index in sorted(objects):
        partner = index + 0x200 if index in _PDO_COMMUNICATIONS else index - 0x200
        if index in range(0x1800, 0x1C00) and partner not in objects:
            text = f"[{partner:04X}] of the same PDO is not there. Add it or remove this object."
            wrong(f"{index:04X}", text)
        if index in _PDO_MAPPINGS:
            _check_mapping(objects[index], objects, wrong)


def _check_communication(item: EdsObject, wrong: Wrong) -> None:
    where = f"{item.index:04X}"
    shape = _shape(item.index)
    if shape is None:
        wrong(where, f"{item.name}: this node has no such service. Remove the object.")
        return
    if item.kind not in KINDS:
        return
    if item.kind not in shape.kinds:
        kind = f"{KINDS[shape.kinds[0]]}, 0x{shape.kinds[0]:X}"
        wrong(where, f"ObjectType=0x{item.kind:X}: this object is of type {kind}.")
        return
    for sub in shape.needed:
        if sub not in item.subs:
            wrong(where, f"sub-index {sub:X} is mandatory and is not there. Add it.")
    for sub, entry in item.subs.items():
        types = shape.types.get(sub)
        if types is None:
            wrong(item.section(sub), f"{where}h has no sub-index {sub:X}. Remove it.")
        elif entry.data_type not in (0, *types) and (sub or item.kind in (VAR, DOMAIN)):
            wanted = f"{TYPE_NAMES[types[0]]}, 0x{types[0]:04X}"
            text = f"DataType=0x{entry.data_type:04X}: this one is of type {wanted}."
            wrong(item.section(sub), text)


def _check_mapping(item: EdsObject, objects: Mapping[int, EdsObject], wrong: Wrong) -> None:
    count = item.subs[0].default if 0 in item.subs else 0
    bits = 0
    for sub in range(1, min(count, _MAX_MAPPED) + 1) if isinstance(count, int) else ():
        entry = item.subs.get(sub)
        value = entry.default if entry else None
        if entry is None or not isinstance(value, int) or entry.relative:
            wrong(item.section(sub), "DefaultValue: this part of the mapping is not there.")
            continue
        bits += value & 0xFF
        if problem := _mapping_problem(value, objects):
            wrong(item.section(sub), f"DefaultValue=0x{value:08X}: {problem}")
    if bits > _PDO_BITS:
        text = f"{bits} bits are mapped, a PDO has {_PDO_BITS}. Map fewer objects."
        wrong(f"{item.index:04X}", text)


def _mapping_problem(value: int, objects: Mapping[int, EdsObject]) -> str | None:
    index, sub, bits = value >> 16, value >> 8 & 0xFF, value & 0xFF
    target = objects[index].subs.get(sub) if index in objects else None
    place = f"{index:04X}h:{sub:02X}"
    if target is None:
        return f"there is no {place}. Add it or map another."
    if not target.mappable or target.access == "rww":
        return f"{place} is not for TPDOs. Write PDOMapping=1 there or map another."
    length = TYPE_BITS.get(target.data_type, 0)
    if target.data_type and (not length or target.access == "wo"):
        return f"{place} cannot be sent: it is write-only or has no fixed length. Map another."
    if target.data_type and length != bits:
        return f"{place} has {length} bits. Write 0x{value & ~0xFF | length:08X}."
    return None
