"""What an EDS must hold so that a node of ours can be built from it: found at start, each mistake by object."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.abort import SdoAbort
from kontronik_can_gw.canopen.cob_ids import SDO_ANSWER, SDO_REQUEST, default_ids
from kontronik_can_gw.canopen.data_types import (
    DOMAIN_TYPE,
    SIGNED,
    TYPE_BITS,
    TYPE_NAMES,
    U8,
    U16,
    U32,
    VISIBLE_STRING,
    WHOLE,
    range_of,
)
from kontronik_can_gw.canopen.dictionary import Dictionary, Variable
from kontronik_can_gw.canopen.eds import Eds, Entry
from kontronik_can_gw.canopen.node_settings import NodeSettings, configured_settings
from kontronik_can_gw.canopen.nodes import CanopenSetup, Nodes
from kontronik_can_gw.canopen.objects import BINDINGS
from kontronik_can_gw.canopen.parameters import CHECKED
from kontronik_can_gw.canopen.pdo import COMMUNICATION, MAPPING, MAX_TPDOS
from kontronik_can_gw.canopen.storage import COMMUNICATION as COMMUNICATION_PROFILE
from kontronik_can_gw.canopen.storage import Stored
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.stream import EscStream
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.gateway_status import GatewayStatus
from kontronik_can_gw.slots import Slots

Place = tuple[int, int]
Mistake = tuple[Entry, str]


def _list(data_type: int, last: int) -> Mapping[int, int | None]:
    return {0: U8} | dict.fromkeys(range(1, last + 1), data_type)


_TYPES: Mapping[int, Mapping[int, int | None]] = {
    0x1000: {0: U32},
    0x1001: {0: U8},
    0x1002: {0: U32},
    0x1003: _list(U32, 0xFE),
    0x1005: {0: U32},
    0x1008: {0: VISIBLE_STRING},
    0x1009: {0: VISIBLE_STRING},
    0x100A: {0: VISIBLE_STRING},
    0x1010: _list(U32, 3),
    0x1011: _list(U32, 3),
    0x1014: {0: U32},
    0x1015: {0: U16},
    0x1016: _list(U32, 0x7F),
    0x1017: {0: U16},
    0x1018: _list(U32, 4),
    0x1019: {0: U8},
    0x1020: _list(U32, 2),
    0x1021: {0: DOMAIN_TYPE},
    0x1022: {0: None},  # copies of the table differ
    0x1029: _list(U8, 0xFE),
    0x1200: _list(U32, 2),
    0x1F80: {0: U32},
}
"""Communication objects that the node has services for: types by sub-index (CiA 301 and 302)."""
_PDO = {0: U8, 1: U32, 2: U8, 3: U16, 5: U16, 6: U8}
_MAPPED = _list(U32, 0x40)
_PDOS = range(COMMUNICATION, COMMUNICATION + MAX_TPDOS)
_MAPPINGS = range(MAPPING, MAPPING + MAX_TPDOS)
_TEXTS = {(at.INFO, 6), (at.INFO, 7)}
_UNSIGNED = {
    **{(at.SETTINGS, sub): 8 for sub in range(1, 9)},
    (at.NODE_ID, 1): 8,
    (at.NODE_ID, 2): 8,
    (at.NODE_ID, 3): 32,
    (at.NODE_ID, 4): 32,
    (at.ERROR_CODE, 0): 16,
    (at.RESET_STATISTICS, 1): 32,
}
"""Objects that services read or write, by the bits they need at least."""
_SHOWN = {
    *((index, 0) for index in (0x1001, 0x1002, 0x100A, 0x1021, at.ERROR_CODE)),
    *((0x1018, sub) for sub in range(1, 5)),
    *((0x1200, sub) for sub in range(1, 3)),
    *((at.NODE_ID, sub) for sub in (1, 3, 4)),
    *_TEXTS,
    *BINDINGS,
}
_SERVER = {(0x1200, 1): SDO_REQUEST, (0x1200, 2): SDO_ANSWER}
_MANDATORY = {(0x1000, 0), (0x1001, 0), (0x1018, 1)}


def check_eds(eds: Eds, escs: Sequence[EscSettings], node_ids: Iterable[int] = (1,)) -> None:
    """Whether nodes with these node-IDs, for these ESCs, can be built from an EDS. UserError with every mistake."""
    entries = {(entry.index, entry.sub): entry for entry in eds.entries}
    found = (*_objects(entries), *_settings(entries, escs))
    problems = [f"{entry.place} {entry.name}: {what}" for entry, what in found]
    problems += _missing(entries)
    if not problems:
        numbers = list(node_ids) or [1]  # where all wait for LSS any node-ID may come
        for node_id in numbers:
            problems += _defaults(eds, escs[0], node_id)
        problems += _shared_ids(Dictionary(eds), numbers)
    if problems:
        raise UserError(*(f"{eds.name}: {what}" for what in dict.fromkeys(problems)))


def _missing(entries: Mapping[Place, Entry]) -> Iterator[str]:
    """Objects that are mandatory, by themselves or where their PDO is there, and each object's sub-index 0."""
    needed = set(_MANDATORY)
    for index in {index for index, _ in entries}:
        if index in _PDOS:
            needed |= {(index, 1), (index, 2), (index - COMMUNICATION + MAPPING, 0)}
        elif index in _MAPPINGS:
            needed.add((index - MAPPING + COMMUNICATION, 0))
        needed.add((index, 0))
    for index, sub in sorted(needed - entries.keys()):
        yield f"{index:04X}h:{sub:02X} is mandatory and is not there. Add it."


def _objects(entries: Mapping[Place, Entry]) -> Iterator[Mistake]:
    """Types and access of what telemetry and services show and read."""
    highest = dict(entries.keys())  # the last sub-index of each index
    for place, entry in entries.items():
        index, sub = place
        if index < 0x2000 and (mistake := _communication(entry)):
            yield entry, mistake
        if place in BINDINGS and entry.data_type not in WHOLE:
            what = BINDINGS[place].source.name
            yield entry, f"shows {what}, so it must be of a whole-number type."
        if place in _SHOWN and "w" in entry.access:
            yield entry, "is shown by the node, so it must be read only (AccessType=ro or const)."
        least = _UNSIGNED.get(place, 0)
        if least and (entry.data_type not in WHOLE - SIGNED or TYPE_BITS[entry.data_type] < least):
            yield entry, f"must be of an unsigned type of {least} bits or more."
        if place in _TEXTS and entry.data_type in TYPE_BITS:
            yield entry, "is a text, so it must be a VISIBLE_STRING."
        first = _SERVER.get(place)
        if first is not None and not (entry.default == first and entry.relative):
            yield entry, f"must be $NODEID+0x{first:X}: the SDO server has no other."
        if not sub and entry.default != (last := highest[index]) and last and not _counts(index):
            yield entry, f"must be 0x{last:02X}, the highest sub-index."


def _counts(index: int) -> bool:
    """Whether sub-index 0 is a count that changes: errors kept, objects mapped."""
    return index == 0x1003 or index in _MAPPINGS


def _communication(entry: Entry) -> str | None:
    """What is wrong with a communication object's place and type."""
    types = _TYPES.get(entry.index)
    if entry.index in _PDOS:
        types = _PDO
    elif entry.index in _MAPPINGS:
        types = _MAPPED
    if types is None:
        return "this node has no such service. Remove the object."
    if entry.sub not in types:
        return f"{entry.index:04X}h has no sub-index {entry.sub:X}. Remove it."
    wanted = types[entry.sub]
    if wanted is None or entry.data_type == wanted:
        return None
    return f"must be of type {TYPE_NAMES[wanted]}, 0x{wanted:04X}."


def _settings(entries: Mapping[Place, Entry], escs: Sequence[EscSettings]) -> Iterator[Mistake]:
    """Settings of the configuration that their objects cannot hold."""
    for esc in escs:
        for sub, value in configured_settings(esc).items():
            entry = entries.get((at.SETTINGS, sub))
            if entry is None or entry.data_type not in WHOLE:
                continue
            low, high = range_of(entry.data_type)
            low = low if entry.low is None else entry.low
            high = high if entry.high is None else entry.high
            if not low <= value <= high:
                what = f"cannot hold {value}, which the configuration says of {esc.name}."
                yield entry, f"{what} Use a larger DataType or limit."


def _defaults(eds: Eds, settings: EscSettings, node_id: int) -> Iterator[str]:
    """Defaults that a download would be refused: of single services, then of the PDOs."""
    setup = CanopenSetup(eds, (NodeSettings(node_id),), (Stored(),))
    escs, status = [EscStream(settings, 0)], GatewayStatus()
    node = Nodes(setup, escs, status, Slots(escs, status).add, lambda *_: None).nodes[0]
    dictionary = node.dictionary
    dictionary.reset(COMMUNICATION_PROFILE, node_id, {})
    checks: list[tuple[Variable, Callable[[int], object] | None]]
    checks = [(v, v.check) for v in dictionary.variables.values() if v.entry.index in CHECKED]
    for tpdo in node.tpdos:
        count = dictionary.number(tpdo.indices[1])
        checks += [(variable, tpdo.resolve) for variable in tpdo.mappings[:count]]
    refused = False
    for variable, check in checks:
        entry = variable.entry
        if check is None or not isinstance(value := variable.value, int):
            continue
        try:
            check(value)
        except SdoAbort as error:
            of = f" (node-ID {node_id})" if entry.relative else ""
            maps = entry.index in _MAPPINGS
            remedy = " Map an object with PDOMapping=1, in its own length." if maps else ""
            said = f"DefaultValue {value:#x}{of} is not allowed ({error}).{remedy}"
            yield f"{entry.place} {entry.name}: {said}"
            refused = True
    for tpdo in () if refused else node.tpdos:
        try:
            tpdo.read()
            tpdo.check()
        except SdoAbort as error:
            index, mapping = tpdo.indices
            yield f"TPDO {tpdo.number + 1}: the defaults of {index:04X}h and {mapping:04X}h do not make a PDO of node {node_id} ({error})."


def without_objects(nodes: Nodes) -> list[str]:
    """A line for each TPDO that is valid by its defaults and maps nothing, of all nodes: none of them is ever sent."""
    tpdos = (tpdo for node in nodes.nodes for tpdo in node.tpdos)
    numbers = sorted({tpdo.number for tpdo in tpdos if tpdo.valid and not tpdo.mapped})
    return [
        f"TPDO {number + 1} is never sent: {MAPPING + number:04X}h maps nothing, so {COMMUNICATION + number:04X}h:01 cannot be valid. "
        "Map objects, or set bit 31 of its DefaultValue."
        for number in numbers
    ]


def _shared_ids(dictionary: Dictionary, node_ids: Sequence[int]) -> Iterator[str]:
    """COB-IDs that two defaults have, of one node or of two; each pair of objects once."""
    sync = dictionary.number(0x1005) & 0x7FF
    users = {sync: (0x1005, "1005h:00")}
    found = set()
    for node_id in node_ids:
        for index, sub, cob_id in default_ids(dictionary, node_id):
            who = f"{index:04X}h:{sub:02X} of node {node_id}"
            other, whose = users.setdefault(cob_id, (index, who))
            if whose != who and (other, index) not in found:
                found.add((other, index))
                yield f"COB-ID {cob_id:03X}h is that of {whose} and of {who}. Change one DefaultValue (or add $NODEID)."
