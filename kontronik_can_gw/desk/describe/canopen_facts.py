"""The CANopen nodes and their common object dictionary: from the EDS in use, its bindings, and the errors' definitions."""

import re
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import PurePath

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.cob_ids import all_ids
from kontronik_can_gw.canopen.data_types import KINDS, TYPE_BITS, TYPE_NAMES
from kontronik_can_gw.canopen.dictionary import Dictionary
from kontronik_can_gw.canopen.eds import Eds
from kontronik_can_gw.canopen.eds_object import Entry
from kontronik_can_gw.canopen.eds_sections import Problems, read_sections
from kontronik_can_gw.canopen.emergency_codes import BitCodes, GatewayError, register_of
from kontronik_can_gw.canopen.node import Node
from kontronik_can_gw.canopen.nodes import CanopenSetup
from kontronik_can_gw.canopen.objects import BINDINGS
from kontronik_can_gw.canopen.pdo import Tpdo
from kontronik_can_gw.desk.describe.parts import Facts, error, number
from kontronik_can_gw.esc.decoder import Severity
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import MS, EscSettings
from kontronik_can_gw.node_state import UNCONFIGURED

BY_GATEWAY = 0xFF
"""Byte 3 of an emergency that is no error bit of the ESC."""
_BEGINS_WITH = re.compile(r"(?:[0-9A-F]{4}h(?::[0-9A-F]{1,2})?(?:, | and | to | / )?)+: ")
_MASK = (at.SETTINGS, 6)
"""The object that selects the error bits reported as emergencies."""


def canopen_facts(
    setup: CanopenSetup, escs: Sequence[EscSettings], meanings: Mapping[str, str]
) -> Facts:
    """Nodes, objects and emergencies. ``notes``: the lines of the EDS's comment that name none of its objects."""
    eds = setup.eds
    comments = _comments(eds)
    indices = {entry.index for entry in eds.entries}
    nodes = setup.nodes(escs).nodes
    return {
        "file": PurePath(eds.name).name,
        "read_only": any(settings.read_only for settings in setup.settings),
        "notes": [line for line in comments if not _named(line) & indices],
        "nodes": [_node(node, esc) for node, esc in zip(nodes, escs, strict=True)],
        "objects": [_object(eds, index, comments, meanings) for index in sorted(indices)],
        "emergencies": list(_emergencies(eds, escs)),
    }


# --- objects


def _object(eds: Eds, index: int, comments: Sequence[str], meanings: Mapping[str, str]) -> Facts:
    """An object. ``notes``: the lines of the EDS's comment that name it."""
    entries = [entry for entry in eds.entries if entry.index == index]
    return {
        "index": index,
        "name": eds.object_names[index],
        "kind": KINDS[entries[0].object_type],
        "notes": [line for line in comments if index in _named(line)],
        "entries": [_entry(entry, meanings) for entry in entries],
    }


def _entry(entry: Entry, meanings: Mapping[str, str]) -> Facts:
    """An entry. Value in ``unit``: raw * ``resolution``. ``plus_node_id``: the node-ID is added to the default."""
    bound = BINDINGS.get((entry.index, entry.sub))
    source = None if bound is None else bound.source
    return {
        "sub": entry.sub,
        "name": entry.name,
        "type": TYPE_NAMES[entry.data_type],
        "bits": TYPE_BITS.get(entry.data_type),
        "access": entry.access,
        "readable": entry.access != "wo",
        "writable": "w" in entry.access,
        "mappable": entry.mappable,
        "default": _text(entry.default) if isinstance(entry.default, bytes) else entry.default,
        "plus_node_id": entry.relative,
        "low": entry.low,
        "high": entry.high,
        "unit": "" if source is None else source.unit,
        "resolution": None if bound is None else number(1 / bound.steps),
        "source": None if source is None else source.name,
        "meaning": "" if source is None else meanings.get(source.name, ""),
    }


def _comments(eds: Eds) -> list[str]:
    """The lines of [Comments]."""
    found = read_sections(eds.data, Problems(eds.name)).get("comments")
    keys = {} if found is None else found.values
    lines = {int(key[4:]): text for key, text in keys.items() if re.fullmatch(r"line\d+", key)}
    return [lines[number] for number in sorted(lines) if lines[number]]


def _named(line: str) -> set[int]:
    """Indices that a comment describes: those at its beginning, as ``2100h:5 and 2101h: ...``, else all in it."""
    head = _BEGINS_WITH.match(line)
    return {int(text, 16) for text in re.findall(r"\b([0-9A-F]{4})h\b", head[0] if head else line)}


def _text(data: bytes) -> str:
    """Printable text unchanged, other bytes in hexadecimal."""
    text = data.decode("latin-1")
    return text if text.isascii() and text.isprintable() else data.hex(" ")


# --- nodes


def _node(node: Node, esc: EscSettings) -> Facts:
    """The node of an ESC with the COB-IDs that it sends or receives; ``node_id`` None: it waits for LSS."""
    node_id = None if node.node_id == UNCONFIGURED else node.node_id
    ids = sorted(dict(all_ids(node)).items())
    return {
        "esc": esc.name,
        "node_id": node_id,
        "cob_ids": [{"id": cob_id, "use": use} for cob_id, use in ids],
        "pdos": [_pdo(tpdo) for tpdo in node.tpdos if tpdo.valid and node_id is not None],
    }


def _pdo(tpdo: Tpdo) -> Facts:
    """An enabled transmit PDO. ``mapped``: as ``2000h:02 Battery voltage``, from the lowest bit up."""
    entries = [variable.entry for variable in tpdo.mapped]
    return {
        "number": tpdo.number + 1,
        "cob_id": tpdo.cob_id,
        "transmission_type": tpdo.type,
        "inhibit_ms": number(Fraction(tpdo.inhibit_ns, MS)),
        "event_ms": number(Fraction(tpdo.event_ns, MS)),
        "mapped": [f"{entry.index:04X}h:{entry.sub:02X} {entry.name}" for entry in entries],
    }


# --- emergencies


def _emergencies(eds: Eds, escs: Sequence[EscSettings]) -> Iterator[Facts]:
    """Emergencies of the ESCs' bits that the EDS enables, of the gateway's faults, and of "no error"."""
    mask = Dictionary(eds).number(*_MASK)
    for protocol in dict.fromkeys(protocol_named(esc.protocol) for esc in escs):
        bits = protocol.errors.get("operating_errors", ())
        codes, named = BitCodes(bits), {int(bit): error(bit) for bit in bits}
        for bit in range(32 if bits else 0):
            if mask >> bit & 1:
                unnamed = "a bit that has no name yet", "Ask the maker of the ESC."
                about = named.get(bit) or _about(f"bit{bit}", *unnamed)
                yield _emergency(codes.code(bit), bit, None, about)
    for fault in GatewayError:
        code, detail = fault.value
        byte4 = None if fault is GatewayError.HEARTBEAT_LOST else detail
        about = _about(fault.name.lower(), fault.meaning, fault.remedy)
        yield _emergency(code, BY_GATEWAY, byte4, about)
    about = _about("no_error", "no error any more", "Nothing to do.", Severity.STATUS)
    yield _emergency(0, BY_GATEWAY, 0, about)


def _about(name: str, meaning: str, remedy: str, severity: Severity = Severity.ERROR) -> Facts:
    return {"name": name, "severity": severity.value, "meaning": meaning, "remedy": remedy}


def _emergency(code: int, byte3: int, byte4: int | None, about: Facts) -> Facts:
    """An emergency: ``code`` is bytes 0 and 1, ``byte3`` a bit of the ESC or 255 for the gateway, ``byte4`` None: not fixed.

    ``register``: the bits of 1001h that it sets.
    """
    register = register_of(code) if code else 0
    return {"code": code, "byte3": byte3, "byte4": byte4, "register": register, **about}
