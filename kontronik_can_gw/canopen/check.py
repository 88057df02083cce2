"""What an EDS must keep to so that a node of ours can be built from it, beyond CiA 306: found at start, each mistake by name."""

from collections.abc import Iterable, Iterator, Sequence

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.abort import SdoAbort
from kontronik_can_gw.canopen.cob_ids import SDO_ANSWER, SDO_REQUEST, default_ids
from kontronik_can_gw.canopen.data_types import SIGNED, WHOLE, range_of
from kontronik_can_gw.canopen.dictionary import Dictionary, Variable
from kontronik_can_gw.canopen.eds import Eds
from kontronik_can_gw.canopen.node_settings import NodeSettings, configured_settings
from kontronik_can_gw.canopen.nodes import CanopenSetup, Nodes
from kontronik_can_gw.canopen.objects import BINDINGS
from kontronik_can_gw.canopen.parameters import CHECKED
from kontronik_can_gw.canopen.pdo_parameters import COMMUNICATION, MAPPING
from kontronik_can_gw.canopen.storage import COMMUNICATION as COMMUNICATION_PROFILE
from kontronik_can_gw.canopen.storage import Stored
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.stream import EscStream
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.gateway_status import GatewayStatus
from kontronik_can_gw.slots import Slots

_UNSIGNED = {
    1: (*((at.SETTINGS, sub) for sub in range(1, 9)), (at.NODE_ID, 1), (at.NODE_ID, 2)),
    2: ((at.ERROR_CODE, 0),),
    4: ((at.NODE_ID, 3), (at.NODE_ID, 4), (at.RESET_STATISTICS, 1)),
}
"""Objects that services read or write, by the bytes they need at least."""
_SHOWN = (
    *((index, 0) for index in (0x1001, 0x1002, 0x100A, 0x1021, at.ERROR_CODE)),
    *((0x1018, sub) for sub in range(1, 5)),
    *((0x1200, sub) for sub in range(1, 3)),
    *((at.INFO, sub) for sub in (6, 7)),
    *((at.NODE_ID, sub) for sub in (1, 3, 4)),
)
"""What the node itself shows: it cannot be written."""
_SERVER = {1: SDO_REQUEST, 2: SDO_ANSWER}


def check_eds(
    eds: Eds, escs: EscSettings | Sequence[EscSettings], node_ids: Iterable[int] = (1,)
) -> None:
    """Whether nodes with these node-IDs, for these ESCs, can be built from an EDS. UserError with every mistake."""
    all_escs = [escs] if isinstance(escs, EscSettings) else escs
    settings = all_escs[0]
    dictionary = Dictionary(eds)
    problems = [
        f"{eds.name}: {variable.entry.index:04X}h:{variable.entry.sub:02X} {variable.entry.name}: {what}"
        for variable, what in (*_objects(dictionary), *_settings(dictionary, all_escs))
    ]
    if not problems:
        numbers = list(node_ids) or [1]  # where all wait for LSS any node-ID may come
        for node_id in numbers:
            problems += [f"{eds.name}: {what}" for what in _defaults(eds, settings, node_id)]
        problems += [f"{eds.name}: {what}" for what in _shared_ids(dictionary, numbers)]
    if problems:
        raise UserError(*dict.fromkeys(problems))


def _objects(dictionary: Dictionary) -> Iterator[tuple[Variable, str]]:
    """Types and access of what telemetry and services show and read."""

    def there(places: Iterable[tuple[int, int]]) -> Iterator[Variable]:
        return filter(None, (dictionary.get(*place) for place in places))

    for variable in there(BINDINGS):
        shown = BINDINGS[variable.entry.index, variable.entry.sub].source.name
        if variable.entry.data_type not in WHOLE:
            yield variable, f"shows {shown}, so it must be of a whole-number type."
        elif variable.writable or not variable.readable:
            yield variable, f"shows {shown}, so it must be read only (AccessType=ro)."
    for size, places in _UNSIGNED.items():
        for variable in there(places):
            if variable.entry.data_type not in WHOLE - SIGNED or (variable.size or 0) < size:
                yield variable, f"must be of an unsigned type of {8 * size} bits or more."
    for variable in there((at.INFO, sub) for sub in (6, 7)):
        if variable.size is not None:
            yield variable, "is a text, so it must be a VISIBLE_STRING."
    for variable in there(_SHOWN):
        if variable.writable or not variable.readable:
            yield (
                variable,
                "is shown by the node, so it must be read only (AccessType=ro or const).",
            )
    for sub, first in _SERVER.items():
        for variable in there([(0x1200, sub)]):
            if variable.entry.default != first or not variable.entry.relative:
                yield variable, f"must be $NODEID+0x{first:X}: the SDO server has no other."
    for index in (0x1010, 0x1011):
        for variable in dictionary.subs(index):
            if variable.entry.sub > 3:
                yield (
                    variable,
                    "this node stores all, communication and application parameters, sub-index 1 to 3.",
                )


def _settings(
    dictionary: Dictionary, escs: Sequence[EscSettings]
) -> Iterator[tuple[Variable, str]]:
    """Settings of the configuration that their objects cannot hold."""
    for esc in escs:
        for sub, value in configured_settings(esc).items():
            variable = dictionary.get(at.SETTINGS, sub)
            if variable is None or variable.entry.data_type not in WHOLE:
                continue
            low, high = range_of(variable.entry.data_type)
            low = low if variable.entry.low is None else variable.entry.low
            high = high if variable.entry.high is None else variable.entry.high
            if not low <= value <= high:
                yield (
                    variable,
                    f"cannot hold {value}, which the configuration says of {esc.name}. Use a larger DataType or limit.",
                )


def _defaults(eds: Eds, settings: EscSettings, node_id: int) -> Iterator[str]:
    """Defaults that a download would be refused: of single services, then of the PDOs."""
    setup = CanopenSetup(eds, (NodeSettings(node_id),), (Stored(),))
    escs, status = [EscStream(settings, 0)], GatewayStatus()
    node = Nodes(setup, escs, status, Slots(escs, status).add, lambda *_: None).nodes[0]
    dictionary = node.dictionary
    dictionary.reset(COMMUNICATION_PROFILE, node_id, {})
    for variable in dictionary.variables.values():
        if variable.entry.index not in CHECKED or variable.check is None:
            continue
        assert isinstance(variable.value, int)
        try:
            variable.check(variable.value)
        except SdoAbort as error:
            where = f"{variable.entry.index:04X}h:{variable.entry.sub:02X} {variable.entry.name}"
            yield f"{where}: DefaultValue {variable.value:#x} (node-ID {node_id}) is not allowed ({error})."
    for tpdo in node.tpdos:
        try:
            tpdo.configure(0)
            tpdo.check()
        except SdoAbort as error:
            yield (
                f"TPDO {tpdo.number + 1}: the defaults of {COMMUNICATION + tpdo.number:04X}h and "
                f"{MAPPING + tpdo.number:04X}h do not make a PDO of node {node_id} ({error})."
            )


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
