"""Tables of CANopen nodes, objects and emergencies.

They are made from the EDS in use, the bindings of its objects and the definitions of the errors.
"""

from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import PurePath

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.dictionary import Dictionary
from kontronik_can_gw.canopen.eds import TYPE_NAMES, Eds, EdsEntry
from kontronik_can_gw.canopen.emergency_codes import BitCodes, GatewayError, register_of
from kontronik_can_gw.canopen.node import Node
from kontronik_can_gw.canopen.objects import BINDINGS
from kontronik_can_gw.canopen.setup import CanopenSetup
from kontronik_can_gw.desk.describe.markdown import MarkdownTable, Row
from kontronik_can_gw.desk.describe.tables import meanings_of, number, protocols_of
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.status import UNCONFIGURED
from kontronik_can_gw.times import MS

_MASK = (at.SETTINGS, 6)
"""The object that selects the error bits reported as emergencies."""
_EMERGENCIES = (
    "An emergency of a CANopen node has the code in bytes 0 and 1 and the register 1001h in "
    "byte 2. Byte 3 is the number of the bit in the ESC's error word, or FFh for a fault that the "
    "gateway detected. The log and kontronik-can-gw status report these faults too."
)


def objects(setup: CanopenSetup, escs: Sequence[EscSettings]) -> list[MarkdownTable]:
    """Return tables of the nodes' COB-IDs and TPDOs, and of their object dictionary."""
    eds = setup.eds
    named = []
    for node, esc in zip(setup.nodes(escs).nodes, escs, strict=True):
        state = "waits for LSS" if node.node_id == UNCONFIGURED else node.node_id
        named.append((f"{esc.name}, {state}", node))
    refused = ""
    if any(settings.read_only for settings in setup.settings):
        refused = "Nothing can be written over the bus: canopen.read_only is true."
    text = [f"{PurePath(eds.name).name}. {refused}"]
    meanings = meanings_of(escs)
    return [
        MarkdownTable(
            "COB-IDs",
            ["There is a node for each ESC. A node that waits for LSS uses only a few COB-IDs."],
            list(_cob_ids(named)),
            by="node",
        ),
        MarkdownTable(
            "TPDOs",
            ["The TPDOs as they are when the node starts."],
            list(_pdos(named)),
            by="node",
        ),
        MarkdownTable("Objects", text, [_object(eds, entry, meanings) for entry in eds.entries]),
    ]


def _cob_ids(nodes: Sequence[tuple[str, Node]]) -> Iterator[Row]:
    """Yield a row for each COB-ID of each node."""
    for name, node in nodes:
        use_of = {use.cob_id: use.what for use in node.uses()}
        for cob_id, use in sorted(use_of.items()):
            yield {"node": name, "cob_id": cob_id, "use": use}


def _pdos(nodes: Sequence[tuple[str, Node]]) -> Iterator[Row]:
    """Yield a row for each enabled transmit PDO. Mapped objects are listed from the lowest bit."""
    for name, node in nodes:
        if node.node_id == UNCONFIGURED:
            continue
        for tpdo in node.tpdos:
            if not tpdo.is_valid:
                continue
            entries = [variable.entry for variable in tpdo.mapped]
            yield {
                "node": name,
                "TPDO": tpdo.number + 1,
                "cob_id": tpdo.cob_id,
                "type": tpdo.type,
                "inhibit_ms": number(Fraction(tpdo.inhibit_ns, MS)),
                "event_ms": number(Fraction(tpdo.event_ns, MS)),
                "mapped": [f"{entry.place} {entry.name}" for entry in entries],
            }


_RESTARTS = "It restarts at 0 after the highest number of its type."
_LONG_AGE = "65534 means this age or more, and 65535 that nothing has arrived yet."
_NOTES = {"data_age": _LONG_AGE, "info_age": _LONG_AGE}


def _object(eds: Eds, entry: EdsEntry, meanings: Mapping[str, str]) -> Row:
    """Return the row of an entry.

    The value in ``unit`` is raw * ``step``. ``node_id`` is true if the node-ID is added to the
    default. An entry that shows a value of the ESC or the gateway has no default.
    """
    bound = BINDINGS.get((entry.index, entry.sub))
    default: object = entry.default
    if isinstance(default, bytes):
        default = default.decode("latin-1")
    object_name = eds.object_names[entry.index]
    name = entry.name
    if not name.startswith(object_name):
        name = f"{object_name}: {name}"
    step = None
    unit = ""
    shows = ""
    note = ""
    if bound is not None:
        default = None
        step = number(1 / bound.steps)
        unit = bound.source.unit
        shows = bound.source.name
        note = _RESTARTS if bound.source.rolls else _NOTES.get(shows, "")
    return {
        "object": entry.place,
        "name": name,
        "type": TYPE_NAMES[entry.data_type],
        "access": entry.access,
        "pdo": entry.is_mappable,
        "default": default,
        "node_id": entry.is_relative,
        "min": entry.low,
        "max": entry.high,
        "step": step,
        "unit": unit,
        "shows": shows,
        "meaning": " ".join(filter(None, (meanings.get(shows, ""), note))),
    }


# --- emergencies


def emergencies(eds: Eds | None, escs: Sequence[EscSettings]) -> list[MarkdownTable]:
    """Return the table of emergencies: bits that the EDS enables, and faults of the gateway."""
    mask = 0 if eds is None else Dictionary(eds).number(*_MASK)
    rows: list[Row] = []
    for protocol in protocols_of(escs):
        bits = protocol.errors.get("operating_errors", ())
        if not bits:
            continue
        codes = BitCodes(bits)
        about_bits = {int(bit): (bit.text, bit.meaning, bit.remedy) for bit in bits}
        for position in range(32):
            if not mask >> position & 1:
                continue
            about = (
                f"bit{position}",
                "a bit without a name",
                "Ask the manufacturer of the ESC.",
            )
            if position in about_bits:
                about = about_bits[position]
            rows.append(_emergency(codes.code(position), str(position), None, about))
    for fault in GatewayError:
        code, detail = fault.value
        byte4 = None if fault is GatewayError.HEARTBEAT_LOST else detail
        about = (fault.name.lower(), fault.meaning, fault.remedy)
        rows.append(_emergency(code, "FFh", byte4, about))
    rows.append(_emergency(0, "FFh", 0, ("no_error", "all errors have ended", "Nothing to do.")))
    return [MarkdownTable("Emergencies", [_EMERGENCIES], rows)]


def _emergency(code: int, byte3: str, byte4: int | None, about: tuple[str, str, str]) -> Row:
    """Return the row of an emergency. ``about`` is its name, meaning and remedy.

    ``register`` has the bits of 1001h that it sets. ``byte4`` is None if it is not fixed.
    """
    name, meaning, remedy = about
    return {
        "code": code,
        "register": register_of(code) if code else 0,
        "byte3": byte3,
        "byte4": byte4,
        "name": name,
        "meaning": meaning,
        "remedy": remedy,
    }
