"""The keys of the outputs. Each class is a table of the configuration, as in keys.py."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from kontronik_can_gw.config.kinds import (
    BINDINGS,
    BOOLEAN,
    NAMES,
    NODE_NAME,
    TEXT,
    choice,
    integer,
    key,
    meanings,
    table_of,
)
from kontronik_can_gw.signals import units
from kontronik_can_gw.signals.plan import SEND_TYPES
from kontronik_can_gw.status import UNCONFIGURED

SHIPPED = "shipped"
NODE_ID = integer(1, 127, also=UNCONFIGURED)
"""Node-ID of a CANopen node."""
_CAN_ID_MAX = 0x1FFFFFFF
_UINT32_MAX = 0xFFFFFFFF


# fmt: off
@dataclass(frozen=True)
class DbcConfig:
    """The DBC output."""

    enabled: bool = key(BOOLEAN, True, "send the messages of a DBC")
    file: str = key(TEXT, SHIPPED,
        "DBC file, relative to this configuration; 'shipped' is the one of this package")
    node: str | None = key(TEXT, None, "transmitter node in the DBC whose messages are sent")
    messages: Sequence[str] = key(NAMES, (),
        "names of the messages to send, '*' for any characters, as [\"Motor_*\"] (default: all of the node)")
    unbound: str = key(choice("error", "start_value"), "error",
        "signals bound to nothing: 'error' refuses them, "
        "'start_value' sends their GenSigStartValue (else NotAvailable, else 0) for ever")
    on_loss: str = key(choice("not_available", "silent"), "not_available",
        "without telemetry: 'not_available' sends values marked as such, 'silent' stops messages with an ESC's values")
    flags_on_loss: int | None = key(integer(0, 1), None,
        "value without telemetry of flags that have no NotAvailable in their value table "
        "(default: their own GenSigStartValue, else 0)")
    base_id: int | None = key(integer(0, _CAN_ID_MAX), None,
        "move the messages so that the lowest id is this")
    id_step: int | None = key(integer(1, _CAN_ID_MAX), None,
        "distance of the ids from ESC to ESC when a one-ESC DBC serves several")
    bind: Mapping[str, str | float] = key(BINDINGS, {},
        "'Message.Signal' or 'Signal' = a source ('battery_voltage', 'left.battery_voltage') or a constant number")
    e2e_data_ids: Mapping[str, int] = key(table_of(integer(0, 0xFFFF)), {},
        "message name = AUTOSAR E2E data id")
    units: Mapping[str, str] = key(meanings(units.names()), {},
        "unit text of the DBC = the unit that it means")
    send_type: Mapping[str, str] = key(meanings(tuple(SEND_TYPES)), {},
        "GenMsgSendType of the DBC = its meaning")

    @property
    def silent_on_loss(self) -> bool:
        return self.on_loss == "silent"


@dataclass(frozen=True)
class CanopenConfig:
    """The CANopen nodes, one for each ESC."""

    enabled: bool = key(BOOLEAN, False, "be a CANopen node for each ESC")
    node_id: int = key(NODE_ID, 1,
        "node-ID of the first ESC, the others follow; 255: all wait for LSS")
    eds: str = key(TEXT, SHIPPED,
        "EDS file the nodes are built from, relative to this configuration; 'shipped' is the one of this package")
    vendor_id: int | None = key(integer(0, _UINT32_MAX), None,
        "vendor-ID in 1018h:1; only CiA assigns one (default: as the EDS says)")
    serial: int | None = key(integer(0, _UINT32_MAX), None,
        "serial number of the first node in 1018h:4, the others follow (default: made from the machine's id)")
    self_start: bool = key(BOOLEAN, False,
        "go OPERATIONAL after boot-up without a master (1F80h); otherwise as the EDS says")
    read_only: bool = key(BOOLEAN, False, "refuse every write over the bus, and LSS")
    cia402_mirrors: bool = key(BOOLEAN, True,
        "show the objects 6000h..67FFh (speed, DC link voltage, error code) that generic drive tools know")
    store: str | None = key(TEXT, None,
        "folder of the parameters that masters store (default: the service's state folder; else for root /var/lib/kontronik-can-gw, "
        "for others ~/.local/state/kontronik-can-gw)")


@dataclass(frozen=True)
class DronecanConfig:
    """DroneCAN nodes, for autopilots."""

    enabled: bool = key(BOOLEAN, False, "report the ESCs by DroneCAN")
    node_id: int = key(integer(0, 125), 0,
        "node-ID of the first node, the others follow; 0: all ask an allocator on the bus (ArduPilot and PX4 are one)")
    per_esc_nodes: bool = key(BOOLEAN, False, "a node for each ESC instead of one for the gateway")
    name: str = key(NODE_NAME, "kontronik_can_gw",
        "name of the node; with per_esc_nodes a dot and the ESC's name follow")
    first_index: int = key(integer(0, 31), 0,
        "esc_index of the first ESC, the others follow; PX4 and Betaflight take it as it is, ArduPilot adds CAN_Dn_UC_ESC_OF")
    rate_hz: int = key(integer(1, 200), 50,
        "esc.Status of each ESC in a second while its telemetry is fresh; ArduPilot needs 10")
    extended_hz: int = key(integer(0, 200), 0,
        "esc.StatusExtended (throttle, duty, error bits) of each ESC in a second; 0: none, because it cannot mark a value as unknown")
    rpm: str = key(choice("motor", "output", "electrical"), "motor",
        "speed that is sent: of the 'motor' (ArduPilot, PX4), of the 'output' of the gear, 'electrical' (Betaflight)")
    negative_rpm: bool = key(BOOLEAN, True,
        "rpm is negative while the motor turns backward, as the DSDL requires; false: never negative")
    health: str = key(choice("gateway", "esc"), "gateway",
        "source of the node's health: 'esc' includes errors of an ESC and lost telemetry, with which ArduPilot does not arm")
    log_messages: bool = key(BOOLEAN, True,
        "send errors of an ESC that begin and end as LogMessage, with the remedy")
# fmt: on
