"""The checks at start that a node can be built from an EDS. Mistakes name the object."""

from collections.abc import Iterable, Iterator, Mapping, Sequence

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.cob_ids import SDO_ANSWER, SDO_REQUEST, default_ids
from kontronik_can_gw.canopen.dictionary import Dictionary, SdoAbort
from kontronik_can_gw.canopen.eds import (
    SIGNED,
    TYPE_BITS,
    TYPE_NAMES,
    WHOLE,
    Eds,
    EdsEntry,
    range_of,
)
from kontronik_can_gw.canopen.node_settings import NodeSettings, NodeSetup, configured_settings
from kontronik_can_gw.canopen.nodes import nodes_alone
from kontronik_can_gw.canopen.objects import BINDINGS
from kontronik_can_gw.canopen.pdo import COMMUNICATION, MAPPING, MAX_TPDOS
from kontronik_can_gw.canopen.storage import CHECKED, Stored
from kontronik_can_gw.canopen.storage import COMMUNICATION as COMMUNICATION_PROFILE
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings

EntryKey = tuple[int, int]
Mistake = tuple[EdsEntry, str]

_PDOS = range(COMMUNICATION, COMMUNICATION + MAX_TPDOS)
_MAPPINGS = range(MAPPING, MAPPING + MAX_TPDOS)
_FREE = frozenset({0x1022, at.UNITS})
"""Objects without a service that may have any type, because copies of CiA's table differ."""
_PLAIN = _FREE | {0x1000, 0x1008, 0x1009}
"""Objects that are not bound to a service."""
_NUMBERS_OF_ENTRIES = frozenset({0x1003, *_MAPPINGS})
"""Objects whose sub-index 0 is a number that changes."""
_LISTS = {0x1003: 0xFE, 0x1016: 0x7F, 0x1029: 0xFE, MAPPING: 0x40}
"""Lists that may be longer than in the shipped EDS, with their last possible sub-index."""
_BITS = {at.SETTINGS: 8}
"""Least numbers of bits of objects that store their values, if not as in the shipped EDS."""
_SERVER = {(0x1200, 1): SDO_REQUEST, (0x1200, 2): SDO_ANSWER}
_MANDATORY = {(0x1000, 0), (0x1001, 0), (0x1018, 1)}


def check_eds(
    eds: Eds,
    shipped: Eds,
    escs: Sequence[EscSettings],
    node_ids: Iterable[int] = (1,),
) -> None:
    """Check that nodes with these node-IDs, for these ESCs, can be built from an EDS.

    Objects of services must be like those of the shipped EDS: below 2000h of the same type and
    access, and from 2000h on of the same kind. UserError with all mistakes.
    """
    entries = {(entry.index, entry.sub): entry for entry in eds.entries}
    known = {(entry.index, entry.sub): entry for entry in shipped.entries}
    mistakes = [*_objects(entries, known), *_settings(entries, escs)]
    problems = [f"{entry.place} {entry.name}: {problem}" for entry, problem in mistakes]
    problems += _missing(entries)
    if not problems:
        # if all nodes wait for LSS, any node-ID is possible, and 1 is checked
        numbers = list(node_ids) or [1]
        for node_id in numbers:
            problems += _defaults(eds, escs[0], node_id)
        problems += _shared_ids(Dictionary(eds), numbers)
    if problems:
        without_duplicates = dict.fromkeys(problems)
        raise UserError(*(f"{eds.name}: {problem}" for problem in without_duplicates))


def _missing(entries: Mapping[EntryKey, EdsEntry]) -> Iterator[str]:
    """Yield the mandatory objects that are missing.

    Each object needs its sub-index 0, and the two objects of a PDO need each other.
    """
    needed = set(_MANDATORY)
    for index in {index for index, _ in entries}:
        if index in _PDOS:
            mapping = index - COMMUNICATION + MAPPING
            needed |= {(index, 1), (index, 2), (mapping, 0)}
        elif index in _MAPPINGS:
            needed.add((index - MAPPING + COMMUNICATION, 0))
        needed.add((index, 0))
    for index, sub in sorted(needed - entries.keys()):
        yield f"{index:04X}h:{sub:02X} is mandatory but missing. Add it."


def _objects(
    entries: Mapping[EntryKey, EdsEntry], known: Mapping[EntryKey, EdsEntry]
) -> Iterator[Mistake]:
    """Yield mistakes in type, access and default of objects that telemetry and services use.

    ``known`` are the entries of the shipped EDS.
    """
    last_subs = dict(entries.keys())
    for (index, sub), entry in entries.items():
        reference = _reference(known, index, sub)
        if reference is not None:
            for problem in _unlike(entry, reference):
                yield entry, problem
        elif index < 0x2000:
            yield entry, "the gateway's nodes do not have this service. Remove the object."
        first = _SERVER.get((index, sub))
        if first is not None and (entry.default, entry.is_relative) != (first, True):
            yield entry, f"must be $NODEID+0x{first:X}, the COB-ID of the SDO server."
        last = last_subs[index]
        is_wrong = sub == 0 < last and entry.default != last
        if is_wrong and index not in _NUMBERS_OF_ENTRIES:
            yield entry, f"must be 0x{last:02X}, the highest sub-index."


def _reference(
    known: Mapping[EntryKey, EdsEntry],
    index: int,
    sub: int,
) -> EdsEntry | None:
    """Return the entry of the shipped EDS that an entry must be like, or None.

    All PDOs are like the first one. Members that the shipped EDS lacks are like sub-index 1.
    """
    if index in _PDOS:
        index = COMMUNICATION
    elif index in _MAPPINGS:
        index = MAPPING
    reference = known.get((index, sub))
    if reference is None:
        last_sub = 0xFE if index >= 0x2000 else _LISTS.get(index, 0)
        if 0 < sub <= last_sub:
            reference = known.get((index, 1))
    return reference


def _unlike(entry: EdsEntry, shipped: EdsEntry) -> Iterator[str]:
    """Yield the differences that make an object useless for its service."""
    index = entry.index
    wanted = shipped.data_type
    fitting = WHOLE
    problem = "must be of a whole-number type."
    if index < 0x2000 or wanted not in WHOLE:
        fitting = {wanted}
        problem = f"must be of type {TYPE_NAMES[wanted]}, 0x{wanted:04X}."
    elif (index, entry.sub) not in BINDINGS:  # the object stores its value
        bits = _BITS.get(index, TYPE_BITS[wanted])
        fitting = {kind for kind in WHOLE - SIGNED if TYPE_BITS[kind] >= bits}
        problem = f"must be of an unsigned whole-number type of {bits} bits or more."
    if entry.data_type not in fitting and index not in _FREE:
        yield problem
    if "w" not in shipped.access and "w" in entry.access and index not in _PLAIN:
        yield "must be read only (AccessType=ro or const), because only the node writes it."


def _settings(
    entries: Mapping[EntryKey, EdsEntry],
    escs: Sequence[EscSettings],
) -> Iterator[Mistake]:
    """Yield configured settings that do not fit their objects."""
    for esc in escs:
        for sub, value in configured_settings(esc).items():
            entry = entries.get((at.SETTINGS, sub))
            if entry is None or entry.data_type not in WHOLE:
                continue
            low, high = range_of(entry.data_type)
            low = low if entry.low is None else entry.low
            high = high if entry.high is None else entry.high
            if not low <= value <= high:
                problem = f"cannot hold {value}, the configured value of {esc.name}."
                yield entry, f"{problem} Use a larger DataType or limit."


def _defaults(eds: Eds, settings: EscSettings, node_id: int) -> Iterator[str]:
    """Yield defaults that would be refused in a download: of single services, then of PDOs."""
    setup = NodeSetup(eds, NodeSettings(node_id), Stored())
    node = nodes_alone([setup], [settings], {}).nodes[0]
    dictionary = node.dictionary
    dictionary.reset(COMMUNICATION_PROFILE, node_id, {})
    for variable in dictionary.variables.values():
        entry = variable.entry
        value = variable.value
        if entry.index not in CHECKED or variable.check is None:
            continue
        if not isinstance(value, int):
            continue
        try:
            variable.check(value)
        except SdoAbort as error:
            of_node = f" (node-ID {node_id})" if entry.is_relative else ""
            problem = f"DefaultValue {value:#x}{of_node} is not allowed ({error})."
            yield f"{entry.place} {entry.name}: {problem}"
    for tpdo in node.tpdos:
        try:
            tpdo.read()
            tpdo.check()
        except SdoAbort as error:
            parameters = f"{tpdo.communication_index:04X}h and {tpdo.mapping_index:04X}h"
            yield (
                f"TPDO {tpdo.number + 1}: the defaults of {parameters} "
                f"are not a valid PDO of node {node_id} ({error}). "
                "Map objects with PDOMapping=1, in their own lengths, at most 64 bits in total, "
                "and use a free COB-ID."
            )


def _shared_ids(dictionary: Dictionary, node_ids: Sequence[int]) -> Iterator[str]:
    """Yield COB-IDs that two defaults share, of one node or of two. Each pair is named once."""
    sync = dictionary.number(0x1005) & 0x7FF
    users = {sync: (0x1005, "1005h:00")}
    named = set()
    for node_id in node_ids:
        for index, sub, cob_id in default_ids(dictionary, node_id):
            user = f"{index:04X}h:{sub:02X} of node {node_id}"
            other_index, other_user = users.setdefault(cob_id, (index, user))
            if other_user == user or (other_index, index) in named:
                continue
            named.add((other_index, index))
            yield (
                f"COB-ID {cob_id:03X}h is used by {other_user} and by {user}. "
                "Change one DefaultValue (or add $NODEID)."
            )
