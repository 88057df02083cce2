"""Tables of CANopen: nodes, objects and emergencies, of the EDS in use, its bindings and the errors' definitions."""

from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import PurePath

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.cob_ids import uses
from kontronik_can_gw.canopen.dictionary import Dictionary
from kontronik_can_gw.canopen.eds import TYPE_NAMES, Eds, Entry
from kontronik_can_gw.canopen.emergency_codes import BitCodes, GatewayError, register_of
from kontronik_can_gw.canopen.node import Node
from kontronik_can_gw.canopen.nodes import CanopenSetup
from kontronik_can_gw.canopen.objects import BINDINGS
from kontronik_can_gw.desk.describe.markdown import Row, Table
from kontronik_can_gw.desk.describe.tables import meanings_of, number, protocols_of
from kontronik_can_gw.esc.telemetry import MS, EscSettings
from kontronik_can_gw.node_state import UNCONFIGURED

_MASK = (at.SETTINGS, 6)
"""The object that selects the error bits reported as emergencies."""
_EMERGENCIES = (
    "Messages of the CANopen nodes: bytes 0 and 1 are the code, byte 2 is the register 1001h, byte 3 the bit of the ESC's error word, "
    "or FFh for a fault that the gateway finds. The log and kontronik-can-gw status name these faults too."
)


def objects(setup: CanopenSetup, escs: Sequence[EscSettings]) -> list[Table]:
    """Nodes with their COB-IDs and PDOs, and the object dictionary that all have."""
    eds, nodes = setup.eds, setup.nodes(escs).nodes
    named = [(_title(node, esc), node) for node, esc in zip(nodes, escs, strict=True)]
    ids = [
        {"node": name, "cob_id": cob_id, "use": use}
        for name, node in named
        for cob_id, use in sorted({use.cob_id: use.what for use in uses(node)}.items())
    ]
    writes = any(settings.read_only for settings in setup.settings)
    refused = "Nothing can be written over the bus: canopen.read_only is true." if writes else ""
    text = [f"{PurePath(eds.name).name}. {refused}"]
    meanings = meanings_of(escs)
    return [
        Table("COB-IDs", ["A node for each ESC. One that waits for LSS has few."], ids, by="node"),
        Table("TPDOs", ["As they are when the node starts."], list(_pdos(named)), by="node"),
        Table("Objects", text, [_object(eds, entry, meanings) for entry in eds.entries]),
    ]


def _title(node: Node, esc: EscSettings) -> str:
    return f"{esc.name}, {'waits for LSS' if node.node_id == UNCONFIGURED else node.node_id}"


def _pdos(nodes: Sequence[tuple[str, Node]]) -> Iterator[Row]:
    """Enabled transmit PDOs. ``mapped``: from the lowest bit up."""
    for name, node in nodes:
        for tpdo in node.tpdos:
            if tpdo.valid and node.node_id != UNCONFIGURED:
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


def _object(eds: Eds, entry: Entry, meanings: Mapping[str, str]) -> Row:
    """An entry. Value in ``unit``: raw * ``step``. ``node_id``: the node-ID is added to the default; a live value has none."""
    bound = BINDINGS.get((entry.index, entry.sub))
    default = entry.default.decode("latin-1") if isinstance(entry.default, bytes) else entry.default
    name = eds.object_names[entry.index]
    return {
        "object": entry.place,
        "name": entry.name if entry.name.startswith(name) else f"{name}: {entry.name}",
        "type": TYPE_NAMES[entry.data_type],
        "access": entry.access,
        "pdo": entry.mappable,
        "default": default if bound is None else None,
        "node_id": entry.relative,
        "min": entry.low,
        "max": entry.high,
        "step": None if bound is None else number(1 / bound.steps),
        "unit": "" if bound is None else bound.source.unit,
        "shows": "" if bound is None else bound.source.name,
        "meaning": "" if bound is None else meanings.get(bound.source.name, ""),
    }


# --- emergencies


def emergencies(eds: Eds | None, escs: Sequence[EscSettings]) -> list[Table]:
    """Emergencies of the ESCs' bits that the EDS enables, and of the gateway's faults."""
    mask = 0 if eds is None else Dictionary(eds).number(*_MASK)
    rows: list[Row] = []
    for protocol in protocols_of(escs):
        bits = protocol.errors.get("operating_errors", ())
        codes, named = BitCodes(bits), {int(bit): bit for bit in bits}
        for bit in (bit for bit in range(32 if bits else 0) if mask >> bit & 1):
            found = named.get(bit)
            about = (f"bit{bit}", "a bit that has no name yet", "Ask the maker of the ESC.")
            if found is not None:
                about = (found.text, found.meaning, found.remedy)
            rows.append(_emergency(codes.code(bit), str(bit), None, about))
    for fault in GatewayError:
        code, detail = fault.value
        byte4 = None if fault is GatewayError.HEARTBEAT_LOST else detail
        about = (fault.name.lower(), fault.meaning, fault.remedy)
        rows.append(_emergency(code, "FFh", byte4, about))
    rows.append(_emergency(0, "FFh", 0, ("no_error", "no error any more", "Nothing to do.")))
    return [Table("Emergencies", [_EMERGENCIES], rows)]


def _emergency(code: int, byte3: str, byte4: int | None, about: tuple[str, str, str]) -> Row:
    """``register``: the bits of 1001h that it sets; ``byte4`` None: not fixed."""
    row: Row = {"code": code, "register": register_of(code) if code else 0, "byte3": byte3}
    return {**row, "byte4": byte4, "name": about[0], "meaning": about[1], "remedy": about[2]}
