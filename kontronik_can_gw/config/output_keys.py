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
    integer_or_list,
    key,
    meanings,
    table_of,
)
from kontronik_can_gw.signals import units
from kontronik_can_gw.signals.e2e import DATA_IDS, PROFILES
from kontronik_can_gw.signals.plan import SEND_TYPES
from kontronik_can_gw.status import UNCONFIGURED

SHIPPED = "shipped"
NODE_ID = integer(1, 127, also=UNCONFIGURED)
"""Node-ID of a CANopen node."""
_DATA_IDS = integer_or_list(0, 0xFFFF, DATA_IDS)
_CAN_ID_MAX = 0x1FFFFFFF
_UINT32_MAX = 0xFFFFFFFF


# fmt: off
@dataclass(frozen=True)
class DbcConfig:
    """The DBC output."""

    enabled: bool = key(BOOLEAN, True, "send the messages of a DBC")
    file: str = key(TEXT, SHIPPED,
        "DBC file, relative to the configuration's folder. 'shipped' is the DBC of this package")
    node: str | None = key(TEXT, None,
        "node of the DBC whose messages the gateway sends (default: the only node that sends)")
    messages: Sequence[str] = key(NAMES, (),
        "names of the messages to send, for example [\"Motor_*\"]; '*' stands for any characters "
        "(default: all messages of the node)")
    unbound: str = key(choice("error", "start_value"), "error",
        "signals without a source: 'error' refuses them. 'start_value' always sends their "
        "GenSigStartValue, or NotAvailable if they have none, or 0 if they have neither")
    on_loss: str = key(choice("not_available", "silent"), "not_available",
        "without telemetry: 'not_available' sends values marked as not available, "
        "'silent' stops the messages that contain values of an ESC")
    flags_on_loss: int | None = key(integer(0, 1), None,
        "without telemetry: value of flags whose value table has no NotAvailable "
        "(default: their own GenSigStartValue, or 0 if they have none)")
    base_id: int | None = key(integer(0, _CAN_ID_MAX), None,
        "lowest CAN id. All messages are moved by the same distance (default: the ids of the DBC)")
    id_step: int | None = key(integer(1, _CAN_ID_MAX), None,
        "distance between the ids of one ESC and the next if a DBC for one ESC is used for several "
        "(default: the smallest distance without a clash)")
    bind: Mapping[str, str | float] = key(BINDINGS, {},
        "'Signal' or 'Message.Signal' = its source, for example 'battery_voltage' or "
        "'left.battery_voltage', or a constant number")
    e2e: Mapping[str, str] = key(table_of(choice(*PROFILES)), {},
        "name of a message = its AUTOSAR E2E profile; '*' stands for any characters, and an exact "
        "name has priority (default: the profile that the DBC's attributes state)")
    e2e_data_ids: Mapping[str, int | Sequence[int]] = key(table_of(_DATA_IDS), {},
        "name of a message = its AUTOSAR E2E data ID, or a list of 16 with profiles 2 and 22 "
        "(default: the DBC's attribute; profile 1A: the CAN id)")
    units: Mapping[str, str] = key(meanings(units.names()), {},
        "unit text in the DBC = the unit that is meant, "
        "for texts that the gateway does not recognise")
    send_type: Mapping[str, str] = key(meanings(tuple(SEND_TYPES)), {},
        "GenMsgSendType in the DBC = the send type that is meant, "
        "for names that the gateway does not recognise")

    @property
    def silent_on_loss(self) -> bool:
        return self.on_loss == "silent"


@dataclass(frozen=True)
class CanopenConfig:
    """The CANopen nodes, one for each ESC."""

    enabled: bool = key(BOOLEAN, False, "run a CANopen node for each ESC")
    node_id: int = key(NODE_ID, 1,
        "node-ID of the first ESC. The others count up from it. 255: all nodes wait for LSS")
    eds: str = key(TEXT, SHIPPED,
        "EDS file that describes the nodes, relative to the configuration's folder. "
        "'shipped' is the EDS of this package")
    vendor_id: int | None = key(integer(0, _UINT32_MAX), None,
        "vendor-ID in 1018h:1. Only CiA assigns vendor-IDs (default: the EDS's)")
    serial: int | None = key(integer(0, _UINT32_MAX), None,
        "serial number of the first node in 1018h:4. The others count up from it "
        "(default: derived from the machine's id)")
    self_start: bool = key(BOOLEAN, False,
        "true: nodes become OPERATIONAL after boot-up without a master (1F80h). "
        "false: as the EDS defines it")
    read_only: bool = key(BOOLEAN, False, "refuse all writes over the bus, and LSS")
    cia402_mirrors: bool = key(BOOLEAN, True,
        "offer the objects from 6000h to 67FFh (speed, DC link voltage, error code), "
        "for generic drive tools")
    store: str | None = key(TEXT, None,
        "folder for parameters that masters store "
        "(default: the service's state folder; "
        "without a service /var/lib/kontronik-can-gw for root, "
        "~/.local/state/kontronik-can-gw for other users)")


@dataclass(frozen=True)
class DronecanConfig:
    """DroneCAN nodes, for autopilots."""

    enabled: bool = key(BOOLEAN, False, "report the ESCs over DroneCAN")
    node_id: int = key(integer(0, 125), 0,
        "node-ID of the first node. The others count up from it. 0: a server on the bus, "
        "for example ArduPilot or PX4, assigns all node-IDs")
    per_esc_nodes: bool = key(BOOLEAN, False,
        "run a node for each ESC instead of one for the gateway")
    name: str = key(NODE_NAME, "kontronik_can_gw",
        "name of the node. With per_esc_nodes each name is NAME.ESC, ESC being the ESC's name")
    first_index: int = key(integer(0, 31), 0,
        "esc_index of the first ESC. The others count up from it. "
        "PX4 and Betaflight use it unchanged, ArduPilot adds CAN_Dn_UC_ESC_OF")
    rate_hz: int = key(integer(1, 200, "Hz"), 50,
        "esc.Status messages per second for each ESC, while its telemetry is fresh. "
        "ArduPilot needs at least 10")
    extended_hz: int = key(integer(0, 200, "Hz"), 0,
        "esc.StatusExtended messages (throttle, duty, error bits) per second for each ESC. "
        "0 sends none, because this message cannot mark a value as unknown")
    rpm: str = key(choice("motor", "output", "electrical"), "motor",
        "speed to send: 'motor' (for ArduPilot and PX4), 'output' of the gear, or 'electrical' "
        "(for Betaflight)")
    negative_rpm: bool = key(BOOLEAN, True,
        "send a negative rpm while the motor turns backward, as the DSDL requires. "
        "false: never negative")
    health: str = key(choice("gateway", "esc"), "gateway",
        "source of the node's health: 'gateway' alone, or 'esc', "
        "which also counts errors of an ESC and lost telemetry. "
        "While these last, ArduPilot does not arm")
    log_messages: bool = key(BOOLEAN, True,
        "send a LogMessage with the remedy when an error of an ESC begins or ends")
# fmt: on
