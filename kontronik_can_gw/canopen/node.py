"""One CANopen node: the services put together over the object dictionary of one ESC (CiA 301).

Frames, telemetry events and time in, frames out. The dictionary is built from the EDS in use; ``Node`` binds what is known in it to
telemetry and services, and leaves the rest plain storage.
"""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from typing import Protocol

from kontronik_can_gw.canopen import heartbeat, nmt, sync
from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.abort import Abort, SdoAbort
from kontronik_can_gw.canopen.dictionary import Dictionary, Value, Variable, fits, key
from kontronik_can_gw.canopen.eds import Eds
from kontronik_can_gw.canopen.emergency import Emergencies, GatewayError
from kontronik_can_gw.canopen.heartbeat import NEVER
from kontronik_can_gw.canopen.lss import UNCONFIGURED, LssSlave
from kontronik_can_gw.canopen.nmt import Command, NmtState
from kontronik_can_gw.canopen.objects import BINDINGS, Bound
from kontronik_can_gw.canopen.pdo import (
    COB_ID,
    COMMUNICATION,
    INVALID_BIT,
    MAPPING,
    MOST,
    Tpdo,
    restricted,
)
from kontronik_can_gw.canopen.sdo import SdoServer
from kontronik_can_gw.canopen.storage import VERIFY, Stored
from kontronik_can_gw.esc.kontronik.states import Device, device_text
from kontronik_can_gw.esc.telemetry import MS, SECOND, EscSettings, EscTelemetry, Event, LinkState
from kontronik_can_gw.esc.values import CanState, GatewayState, GatewayStatus, Group
from kontronik_can_gw.frames import CanFrame

SAVE, LOAD, RESET = (int.from_bytes(word, "little") for word in (b"save", b"load", b"rset"))
EMERGENCY, SDO_REQUEST, SDO_ANSWER, LSS_REQUEST, LSS_ANSWER = 0x80, 0x600, 0x580, 0x7E5, 0x7E4
COMMUNICATION_PROFILE, APPLICATION_PROFILE = (0x1000, 0x1FFF), (0x2000, 0xFFFF)
CHECKED = frozenset({0x1005, 0x1014, 0x1016, 0x1019, 0x1F80})
"""Objects of services whose values have rules beyond type and limits (those of PDOs have their own)."""
_NO_CONFIGURATION = frozenset({0x1003, 0x1010, 0x1011, VERIFY, at.RESET_STATISTICS})
"""Objects that can be written and are no part of a configuration."""
_VALID = (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL)
_CATCHING_UP_NS = SECOND // 2
"""After a hold-up no heartbeat is missed for this long unless it was seen to be late: what came meanwhile is read piece by piece."""
FrameTaker = Callable[[bytes, int, int], None]
"""Is given a frame's data, the time, and when the frame came."""
_SELF_START_OFF = 4
_MAX_SAVES = 4
_MIN_TIMEOUT_MS, _MAX_TIMEOUT_MS = 20, 60_000  # whatever the limits of an EDS are
_LAST_VALUE, _CODES = 1, 2  # 2100h:5; 0: abort


@dataclass(frozen=True)
class NodeSettings:
    """What the configuration says of a node.

    ``node_id``: 1..127, or 255 for a node that waits for LSS. ``vendor_id`` None: as the EDS says. ``segment_ns``: distance of the
    segments of a block upload. ``device``: the device that is expected on the line, None for any.
    """

    node_id: int
    serial: int = 0
    vendor_id: int | None = None
    self_start: bool = False
    read_only: bool = False
    bitrate: int = 500_000
    segment_ns: int = 0
    version: str = ""
    device: Device | None = None


class Surroundings(Protocol):
    """What a node asks of the gateway around it."""

    def send(self, frame: CanFrame) -> None:
        """Put a frame out."""

    def save(self, node: "Node", stored: Stored) -> None:
        """Begin to store; ``node.saved`` is called with the result."""

    def settings_changed(self, node: "Node", settings: EscSettings) -> None:
        """2100h was written or reset."""

    def routes_changed(self) -> None:
        """The node listens to other COB-IDs now."""

    def passed_over(self, node: "Node", keys: list[int]) -> None:
        """Stored values that did not hold at a reset: they do not fit the EDS, or clash."""

    def state_changed(self) -> None:
        """The node's NMT state or node-ID is another one."""

    def cob_id_taken(self, cob_id: int, user: object) -> bool:
        """Whether something else of the gateway uses this id; ``user`` as in ``Node.chosen_ids``."""

    def node_id_taken(self, node_id: int, node: "Node") -> bool:
        """Whether another node of the gateway has this node-ID, now or from its next reset on, or another message a COB-ID of it."""


def esc_settings(dictionary: Dictionary, base: EscSettings) -> EscSettings:
    """The settings of 2100h; ``base`` where the EDS has no object for one."""
    number = dictionary.number
    gear = Fraction(
        number(at.SETTINGS, 2, base.gear.numerator) or 1,
        number(at.SETTINGS, 3, base.gear.denominator) or 1,
    )
    return replace(
        base,
        pole_pairs=max(1, number(at.SETTINGS, 1, base.pole_pairs)),
        gear=gear,
        timeout_ns=min(
            max(_MIN_TIMEOUT_MS, number(at.SETTINGS, 4, base.timeout_ns // MS)), _MAX_TIMEOUT_MS
        )
        * MS,
        cell_count=number(at.SETTINGS, 7, base.cell_count),
        crc_error_threshold=number(at.SETTINGS, 8, base.crc_error_threshold),
    )


def configured_settings(base: EscSettings) -> dict[int, int]:
    """Sub-indices of 2100h that the configuration sets, and to what."""
    standard = EscSettings()
    listed = (
        (1, base.pole_pairs, standard.pole_pairs),
        (2, base.gear.numerator, 1),
        (3, base.gear.denominator, 1),
        (4, base.timeout_ns // MS, standard.timeout_ns // MS),
        (7, base.cell_count, standard.cell_count),
    )
    return {sub: given for sub, given, default in listed if given != default}


def default_ids(dictionary: Dictionary, node_id: int) -> Iterator[tuple[int, int, int]]:
    """Valid COB-IDs of emergencies and PDOs by their defaults: index, sub-index, id."""
    if dictionary.get(0x1014) is None:
        yield 0x1014, 0, EMERGENCY + node_id
    for number, variable in dictionary.variables.items():
        index, sub = number >> 8, number & 0xFF
        if index == 0x1014 or (index in range(COMMUNICATION, MAPPING) and sub == COB_ID):
            cob_id = int(variable.default(node_id))
            if not cob_id & INVALID_BIT:
                yield index, sub, cob_id & 0x7FF


def make_dictionary(
    eds: Eds, base: EscSettings, settings: NodeSettings, stored: Stored
) -> Dictionary:
    """The dictionary of a node before its first reset, the configuration's values as power-on values and the stored ones in place.

    Where the configuration leaves a setting at its default, the EDS's default holds.
    """
    dictionary = Dictionary(eds)
    for sub, given in configured_settings(base).items():
        if (variable := dictionary.get(at.SETTINGS, sub)) is not None:
            variable.power_on = given
    if settings.vendor_id is not None and (variable := dictionary.get(0x1018, 1)) is not None:
        variable.power_on = settings.vendor_id
    if (variable := dictionary.get(0x1018, 4)) is not None:
        variable.power_on = settings.serial
    if settings.self_start and (variable := dictionary.get(0x1F80)) is not None:
        variable.power_on = int(variable.power_on) & ~_SELF_START_OFF
    dictionary.read_only = settings.read_only
    dictionary.reset(*APPLICATION_PROFILE, settings.node_id, stored.application)
    return dictionary


class Node:
    """One ESC's node. ``receive``, ``on_event`` and ``advance`` are all that happens to it."""

    def __init__(
        self,
        eds: Eds,
        dictionary: Dictionary,
        esc: EscTelemetry,
        gateway: GatewayStatus,
        settings: NodeSettings,
        stored: Stored,
        around: Surroundings,
    ) -> None:
        self.esc = esc
        self.dictionary = dictionary
        self.settings = settings
        self.state = NmtState.INITIALISING
        self.node_id = UNCONFIGURED
        self.pending_node_id = settings.node_id if stored.node_id is None else stored.node_id
        self.due = NEVER
        self.misfits: list[int] = []
        """Keys of stored values that were passed over at the last reset."""
        self._base = esc.settings
        self._gateway = gateway
        self._around = around
        self._stored = stored
        self._wanted = stored
        self._bus_node_id = stored.node_id
        # the SDO server's ticket, None for LSS
        self._waiting_saves: deque[tuple[int | None, Stored]] = deque()
        self._next_overrun = 0
        self._off_bus = False
        self._outage = False
        self._held_up_ns = self._judged_from = -NEVER
        self._live = False  # for the edge of 1029h:2
        history = sum(1 for _ in dictionary.subs(0x1003))
        self.emergencies = Emergencies(self._send_emergency, max(1, history))
        self.producer = heartbeat.Producer()
        self.consumer = heartbeat.Consumer()
        self.sdo = SdoServer(dictionary, self._send_sdo, settings.segment_ns)
        self.lss = LssSlave(self, self._send_lss)
        self._bound: dict[tuple[int, int], Bound] = {}
        self.tpdos = [
            Tpdo(n, dictionary, self._bound, esc, gateway, around.send)
            for n in range(MOST)
            if dictionary.get(COMMUNICATION + n) is not None
        ]
        self._bind_services(eds)
        self._bind_sources()
        dictionary.written = self._on_download

    # --- life

    def power_on(self, now: int) -> None:
        """The gateway starts. A node without a node-ID stays silent until LSS gives it one."""
        self._off_bus = self._outage = False  # what was before is nobody's concern
        self.reset_node(now)

    def reset_node(self, now: int) -> None:
        """NMT reset node: manufacturer's and profile objects too."""
        self._stop_pdos()
        self.emergencies.close()  # nothing is said before the boot-up message
        node_id = self.pending_node_id
        self.misfits = self.dictionary.reset(
            *APPLICATION_PROFILE, node_id, self._stored.application
        )
        self._apply_settings(now)
        self.reset_communication(now, keep_misfits=True)

    def reset_communication(self, now: int, keep_misfits: bool = False) -> None:
        """NMT reset communication: the pending node-ID, power-on values of 1000h..1FFFh, boot-up."""
        if not keep_misfits:
            self.misfits = []
        self._stop_pdos()
        self.sdo.reset()
        self.lss.reset()
        self.emergencies.reset()
        self.node_id = self.pending_node_id
        self.misfits += self.dictionary.reset(
            *COMMUNICATION_PROFILE, self.node_id, self._stored.communication
        )
        self.release_ids()
        self._drop_what_breaks_rules()
        for tpdo in self.tpdos:
            self._configure_or_default(tpdo, now)
        self._configure_heartbeat(now)
        self.emergencies.inhibit_ns = self.dictionary.number(0x1015) * MS // 10
        self.state = NmtState.INITIALISING
        if self.node_id == UNCONFIGURED:
            self.producer.configure(0, now)
        else:
            self._send(heartbeat.COB_ID + self.node_id, bytes([NmtState.INITIALISING]))
            self._enter(NmtState.PRE_OPERATIONAL, now)
            otherwise = 0 if self.settings.self_start else None
            if not self.dictionary.number(0x1F80, otherwise=otherwise) & _SELF_START_OFF:
                self._enter(NmtState.OPERATIONAL, now)
        if self.misfits:
            self._around.passed_over(self, self.misfits)
        if (
            self.misfits
            or self.dictionary.to_store(*APPLICATION_PROFILE, self.node_id)
            != self._stored.application
        ):
            self._configuration_changed()  # 1020h was stored with other application parameters
        self._around.routes_changed()
        self._around.state_changed()
        self._set_due()

    def release_ids(self) -> None:
        """What PDOs had is free for another."""
        for tpdo in self.tpdos:
            tpdo.valid = False

    def future_ids(self, node_id: int) -> set[int]:
        """COB-IDs that this node would choose by its defaults with another node-ID."""
        return {cob_id for _, _, cob_id in default_ids(self.dictionary, node_id)}

    def routes(self) -> Iterator[tuple[int, FrameTaker]]:
        """COB-IDs this node listens to, and who takes them."""
        yield LSS_REQUEST, self._on_lss
        if self.node_id == UNCONFIGURED:
            return
        yield nmt.COB_ID, self._on_nmt
        yield SDO_REQUEST + self.node_id, self._on_sdo
        yield self.dictionary.number(0x1005) & 0x7FF, self._on_sync
        for node_id in self.consumer.node_ids:
            yield heartbeat.COB_ID + node_id, partial(self._on_heartbeat, node_id)

    def cob_ids(self) -> Iterator[tuple[int, str]]:
        """COB-IDs this node sends with or listens to as its own, and what they are."""
        yield nmt.COB_ID, "NMT"
        yield LSS_REQUEST, "LSS"
        yield LSS_ANSWER, "LSS"
        if self.node_id == UNCONFIGURED:
            return
        yield self.dictionary.number(0x1005) & 0x7FF, "SYNC"
        yield SDO_REQUEST + self.node_id, f"SDO requests to CANopen node {self.node_id}"
        yield from self.transmit_ids()

    def transmit_ids(self) -> Iterator[tuple[int, str]]:
        """COB-IDs that nobody else on the bus may send with, and what they are."""
        if self.node_id == UNCONFIGURED:
            return
        who = f"CANopen node {self.node_id}"
        yield heartbeat.COB_ID + self.node_id, f"the heartbeat of {who}"
        yield SDO_ANSWER + self.node_id, f"SDO answers of {who}"
        if not self.emergency_id & INVALID_BIT:
            yield self.emergency_id & 0x7FF, f"emergencies of {who}"
        for tpdo in self.tpdos:
            if tpdo.valid:
                yield tpdo.cob_id, f"TPDO {tpdo.number + 1} of {who}"

    def chosen_ids(self) -> Iterator[tuple[object, int]]:
        """COB-IDs that a master can choose: (who uses it, id). All nodes may have the same SYNC, so it is one user."""
        if self.node_id == UNCONFIGURED:
            return
        yield sync, self.dictionary.number(0x1005) & 0x7FF
        if not self.emergency_id & INVALID_BIT:
            yield self, self.emergency_id & 0x7FF
        for tpdo in self.tpdos:
            if tpdo.valid:
                yield tpdo, tpdo.cob_id

    # --- what happens

    def on_event(self, events: int, now: int) -> None:
        """Something of the ESC changed: bits of telemetry.Event."""
        esc = self.esc
        if events & Event.LIVE and esc.live is not None:
            self.emergencies.set_word(esc.live.operating_errors, now)
        if events & (Event.LINK | Event.INFO) or self._live is (esc.live is None):
            self._follow_link(events, now)
        if self.state is NmtState.OPERATIONAL:
            for tpdo in self.tpdos:
                if events & tpdo.triggers:
                    tpdo.on_event(now)
        self._set_due()

    def on_can_state(self, state: CanState, now: int) -> None:
        """The CAN controller's state changed."""
        # bus-off is worse than passive, not its end
        if state in (CanState.ERROR_PASSIVE, CanState.ERROR_ACTIVE, CanState.ERROR_WARNING):
            self.emergencies.set(GatewayError.CAN_PASSIVE, state is CanState.ERROR_PASSIVE, now)
        if state in (CanState.BUS_OFF, CanState.DOWN):
            self._off_bus = self._off_bus or state is CanState.BUS_OFF
            self._outage = True
            self._communication_error(now)
        elif self._outage and state is not CanState.UNKNOWN:
            self._return_from_outage(now)
        self._set_due()

    def set_error(self, error: GatewayError, present: bool, now: int) -> None:
        """Something the gateway found."""
        self.emergencies.set(error, present, now)
        self._set_due()

    def can_returned(self, now: int) -> None:
        """Frames can be sent again after some were lost: say once more what is wrong, and what is sent on change only."""
        if self._outage:
            self._return_from_outage(now)
        else:
            self._tell_again(now)
        self._set_due()

    def held_up(self, now: int) -> None:
        """The process was held up until ``now``: a SYNC from before is not answered, a heartbeat may still wait to be read."""
        self._held_up_ns, self._judged_from = now, now + _CATCHING_UP_NS
        self._set_due()

    def make_anew(self, now: int) -> None:
        """PDOs that waited to be sent were dropped: say once more what is."""
        if self.state is NmtState.OPERATIONAL:
            for tpdo in self.tpdos:
                tpdo.tell_again(now)
            self._set_due()

    def overrun(self, now: int) -> None:
        """Received frames were lost in the controller: said once a second at most."""
        if now < self._next_overrun:
            return
        self._next_overrun = now + SECOND
        self.emergencies.pulse(GatewayError.RECEIVE_OVERRUN, now)
        self._set_due()

    def advance(self, now: int) -> None:
        """Let time pass."""
        if now < self.due:
            return
        if self.producer.ticks(now):
            self._send(heartbeat.COB_ID + self.node_id, bytes([self.state]))
        if now >= self._judged_from:
            self._judge_heartbeats(now, now)
        self.sdo.advance(now)
        self.emergencies.advance(now)
        for tpdo in self.tpdos:
            tpdo.advance(now)
        self._set_due()

    def saved(self, error: str | None, now: int) -> None:
        """The oldest request to store is done: on disk, or failed for a reason."""
        ticket, stored = self._waiting_saves.popleft()
        if error is None:
            self._stored = stored
            self.set_error(GatewayError.PARAMETER_FILE, False, now)
        elif not self._waiting_saves:
            self._wanted = self._stored
        if ticket is None:
            self.lss.stored(error is None)
        else:
            self.sdo.confirm(None if error is None else Abort.HARDWARE, now, ticket)
        self._set_due()

    # --- LSS: the node as its slave sees it (lss.Host)

    @property
    def identity(self) -> tuple[int, int, int, int]:
        number, settings = self.dictionary.number, self.settings
        vendor_id, serial = number(0x1018, 1), number(0x1018, 4, otherwise=settings.serial)
        return vendor_id, number(0x1018, 2), number(0x1018, 3), serial

    @property
    def claimed_node_id(self) -> int:
        """The node-ID it has; before it is powered on the one it will have."""
        return self.pending_node_id if self.state is NmtState.INITIALISING else self.node_id

    @property
    def active_node_id(self) -> int:
        return self.node_id

    def configure_node_id(self, node_id: int) -> bool:
        """A new node-ID for the next reset communication. False where writing is switched off or another node of ours has it."""
        if self.settings.read_only or (
            node_id != UNCONFIGURED and self._around.node_id_taken(node_id, self)
        ):
            return False
        self._set_pending(node_id)
        return True

    def store_configuration(self) -> bool:
        if self.settings.read_only:
            return False
        try:
            self._save(None, replace(self._wanted, node_id=self._bus_node_id))
        except SdoAbort:
            return False
        return True

    def lss_left_configuration(self, now: int) -> None:
        if self.node_id == UNCONFIGURED and self.pending_node_id != UNCONFIGURED:
            self.reset_communication(now)

    # --- frames in

    def _on_nmt(self, data: bytes, now: int, _at: int) -> None:
        command = nmt.command(data, self.node_id)
        if command is None:
            return
        if command is Command.RESET_NODE:
            self.reset_node(now)
        elif command is Command.RESET_COMMUNICATION:
            self.reset_communication(now)
        else:
            self._enter(nmt.STATE_AFTER[command], now)
        self._set_due()

    def _on_sdo(self, data: bytes, now: int, _at: int) -> None:
        if self.state in _VALID:
            self.sdo.receive(data, now)
            self._set_due()

    def _on_lss(self, data: bytes, now: int, _at: int) -> None:
        self.lss.receive(data, now)
        self._set_due()

    def _on_sync(self, data: bytes, now: int, at: int) -> None:
        if self.state not in _VALID:
            return
        counter = sync.counter(data, self.dictionary.number(0x1019))
        self.emergencies.set(GatewayError.SYNC_LENGTH, counter is None, now)
        if counter is not None and self.state is NmtState.OPERATIONAL:
            for tpdo in self.tpdos:
                tpdo.on_sync(counter, now, answer=at > self._held_up_ns)
        self._set_due()

    def _on_heartbeat(self, node_id: int, data: bytes, now: int, at: int) -> None:
        if len(data) != 1:
            return
        self._judge_heartbeats(at, now)  # it may have come too late, and others not at all
        if self.consumer.receive(node_id, at):
            self.emergencies.set(GatewayError.HEARTBEAT_LOST, False, now, node_id)
        self._set_due()

    def _judge_heartbeats(self, until: int, now: int) -> None:
        for node_id in self.consumer.advance(until):
            self.emergencies.set(GatewayError.HEARTBEAT_LOST, True, now, node_id)
            self._communication_error(now)

    # --- frames out

    def _send(self, cob_id: int, data: bytes) -> None:
        self._around.send(CanFrame(cob_id, data, queued=True))

    def _send_sdo(self, data: bytes) -> None:
        self._send(SDO_ANSWER + self.node_id, data)

    def _send_lss(self, data: bytes) -> None:
        self._send(LSS_ANSWER, data)

    def _send_emergency(self, data: bytes) -> bool:
        if self.emergency_id & INVALID_BIT:
            return False
        self._send(self.emergency_id & 0x7FF, data)
        return True

    @property
    def emergency_id(self) -> int:
        """1014h; that of the predefined connection set where the EDS has dropped it."""
        return self.dictionary.number(0x1014, otherwise=EMERGENCY + self.node_id)

    # --- states

    def _enter(self, state: NmtState, now: int) -> None:
        if state is self.state:
            return
        self._stop_pdos()
        self.state = state
        self._around.state_changed()
        if state is NmtState.STOPPED:
            self.emergencies.close()
            self.sdo.reset()
            return
        self.emergencies.open(now)
        if state is NmtState.OPERATIONAL:
            for tpdo in self.tpdos:
                tpdo.start(now)

    def _stop_pdos(self) -> None:
        if self.state is NmtState.OPERATIONAL:
            for tpdo in self.tpdos:
                tpdo.stop()

    def _communication_error(self, now: int) -> None:
        self._behave(self.dictionary.number(0x1029, 1), now)

    def _return_from_outage(self, now: int) -> None:
        """The controller left bus-off, or the interface is back. With 1029h:1 = 0 the node boots, so that its master sets it up anew.

        CiA 301 asks for PRE-OPERATIONAL then; a boot-up besides is what brings a node without a master, self-starting, to work again.
        """
        off_bus, self._off_bus, self._outage = self._off_bus, False, False
        if self.dictionary.number(0x1029, 1) == 0 and self.node_id != UNCONFIGURED:
            self.reset_communication(now)
        else:
            self.producer.beat(now)
            self._tell_again(now)
        if off_bus:
            self.emergencies.pulse(GatewayError.BUS_OFF_LEFT, now)

    def _tell_again(self, now: int) -> None:
        self.emergencies.tell_again(now)
        if self.state is NmtState.OPERATIONAL:
            for tpdo in self.tpdos:
                tpdo.tell_again(now)

    def _behave(self, behaviour: int, now: int) -> None:
        """Error behaviour of 1029h: 0 PRE-OPERATIONAL (if OPERATIONAL), 1 no change, 2 STOPPED."""
        if behaviour == 0 and self.state is NmtState.OPERATIONAL:
            self._enter(NmtState.PRE_OPERATIONAL, now)
        elif behaviour == 2 and self.state in _VALID:
            self._enter(NmtState.STOPPED, now)

    def _follow_link(self, events: int, now: int) -> None:
        esc, found = self.esc, self.emergencies
        link = esc.link
        if events & Event.LINK:
            if link is LinkState.PORT_ERROR:
                found.set(GatewayError.PORT_GONE, True, now)
            found.set(GatewayError.TELEMETRY_LOST, link is LinkState.LOST, now)
            found.set(GatewayError.CRC_RATE, link is LinkState.DEGRADED, now)
            found.set(GatewayError.PORT_GONE, link is LinkState.PORT_ERROR, now)
        if events & Event.INFO and esc.info is not None and self.settings.device is not None:
            found.set(GatewayError.OTHER_DEVICE, esc.info.device != self.settings.device, now)
        if self._live and esc.live is None and link in (LinkState.LOST, LinkState.PORT_ERROR):
            self._behave(self.dictionary.number(0x1029, 2), now)
        self._live = esc.live is not None

    def _set_due(self) -> None:
        due = [self.producer.due, max(self.consumer.due, self._judged_from), self.emergencies.due]
        if (sdo := self.sdo.next_deadline()) is not None:
            due.append(sdo)
        due += [tpdo.due for tpdo in self.tpdos]
        self.due = min(due)

    # --- parameters

    def _on_download(self, variable: Variable, changed: bool, now: int) -> None:
        for tpdo in self.tpdos:
            tpdo.on_download(variable, now)
        if changed and variable.entry.index not in _NO_CONFIGURATION:
            self._configuration_changed()

    def _configuration_changed(self) -> None:
        """1020h no longer names the configuration: its master downloads it anew."""
        for variable in self.dictionary.subs(VERIFY):
            variable.value = 0

    def _configure_or_default(self, tpdo: Tpdo, now: int) -> None:
        """Stored PDO parameters that no longer make sense with this EDS give way to the defaults; without a free COB-ID there is no PDO."""
        try:
            tpdo.configure(now)
            tpdo.check(lambda cob_id: self._around.cob_id_taken(cob_id, tpdo))
        except SdoAbort:
            for number, variable in self.dictionary.variables.items():
                if number >> 8 in (COMMUNICATION + tpdo.number, MAPPING + tpdo.number):
                    if variable.value != (default := variable.default(self.node_id)):
                        self.misfits.append(number)
                    variable.value = default
            tpdo.configure(now)
            cob_id = self.dictionary.get(COMMUNICATION + tpdo.number, COB_ID)
            if cob_id is not None and tpdo.valid and not self._is_free(tpdo):
                cob_id.value = int(cob_id.value) | INVALID_BIT
                self.misfits.append(key(COMMUNICATION + tpdo.number, COB_ID))
                tpdo.configure(now)

    def _is_free(self, tpdo: Tpdo) -> bool:
        return not restricted(tpdo.cob_id) and not self._around.cob_id_taken(tpdo.cob_id, tpdo)

    def _drop_what_breaks_rules(self) -> None:
        """Stored communication parameters pass the same checks as downloads, or give way to the defaults."""
        for number in self._stored.communication:
            variable = self.dictionary.variables.get(number)
            if variable is None or variable.check is None or number >> 8 not in CHECKED:
                continue
            assert isinstance(variable.value, int)
            try:
                variable.check(variable.value)
            except SdoAbort:
                variable.value = variable.default(self.node_id)
                self.misfits.append(number)

    def _configure_heartbeat(self, now: int) -> None:
        self.producer.configure(self.dictionary.number(0x1017), now)
        self.consumer = heartbeat.Consumer()
        self.consumer.configure(
            v.value for v in self.dictionary.subs(0x1016) if isinstance(v.value, int)
        )

    def _apply_settings(self, now: int) -> None:
        settings = esc_settings(self.dictionary, self._base)
        self.emergencies.mask = self.dictionary.number(at.SETTINGS, 6)
        if self.esc.live is not None:
            self.emergencies.set_word(self.esc.live.operating_errors, now, force=True)
        if settings != self.esc.settings:
            self._around.settings_changed(self, settings)

    def _set_pending(self, node_id: int) -> None:
        self.pending_node_id = node_id
        self._bus_node_id = node_id

    def _save(self, ticket: int | None, stored: Stored) -> None:
        if len(self._waiting_saves) >= _MAX_SAVES:  # a disk that does not come round
            raise SdoAbort(Abort.LOCAL_CONTROL)
        self._wanted = stored
        self._waiting_saves.append((ticket, stored))
        self._around.save(self, stored)

    def _store(self, part: int) -> None:
        """1010h: sub-index 1 all, 2 communication, 3 application parameters."""
        stored = self._wanted
        if part in (1, 2):
            stored = replace(
                stored, communication=self.dictionary.to_store(*COMMUNICATION_PROFILE, self.node_id)
            )
        application = self.dictionary.to_store(*APPLICATION_PROFILE, self.node_id)
        if part in (1, 3):
            stored = replace(stored, application=application, node_id=self._bus_node_id)
        whole = self.dictionary.to_store(*COMMUNICATION_PROFILE, self.node_id), application
        if (stored.communication, stored.application) != whole:
            stored = stored.unverified()
        self._save(self.sdo.waiting, stored)

    def _restore(self, part: int) -> None:
        """1011h: defaults from the next reset on. A node-ID that LSS stored stays: it is taken back by LSS."""
        stored = self._wanted
        if part in (1, 2):
            stored = replace(stored, communication={})
        if part in (1, 3):
            stored = replace(stored, application={})
        self._save(self.sdo.waiting, stored.unverified())

    # --- binding

    def _bind_services(self, eds: Eds) -> None:
        get = self.dictionary.get

        def read(index: int, sub: int, value: Callable[[int], Value]) -> None:
            if (variable := get(index, sub)) is not None:
                variable.read = value

        def hook(
            index: int,
            sub: int,
            check: Callable[[int], None] | None = None,
            written: Callable[[int], bool] | None = None,
        ) -> None:
            if (variable := get(index, sub)) is not None:
                variable.check, variable.written = check, written

        read(0x1001, 0, lambda _now: self.emergencies.register)
        read(0x1002, 0, lambda _now: self._status_register())
        read(0x1003, 0, lambda _now: len(self.emergencies.history))
        hook(0x1003, 0, _only_zero, lambda _now: self._clear_history())
        for variable in self.dictionary.subs(0x1003):
            variable.read = partial(self._history, variable.entry.sub)
        hook(0x1005, 0, self._check_sync_cob_id, self._rerouted)
        version = self.settings.version.encode("ascii", "replace")
        read(0x100A, 0, lambda _now: version)
        for part in (1, 2, 3):
            read(0x1010, part, lambda _now: int(not self.settings.read_only))
            read(0x1011, part, lambda _now: int(not self.settings.read_only))
            hook(0x1010, part, _signature(SAVE), partial(self._later, self._store, part))
            hook(0x1011, part, _signature(LOAD), partial(self._later, self._restore, part))
        hook(0x1014, 0, self._check_emergency_cob_id, self._rerouted)
        hook(0x1015, 0, None, lambda _now: self._set_emergency_inhibit())
        for variable in self.dictionary.subs(0x1016):
            variable.check = partial(self._check_watch, variable)
            variable.written = self._watches_changed
        hook(0x1017, 0, None, self._heartbeat_changed)
        hook(0x1019, 0, sync.check_overflow)
        hook(0x1F80, 0, _no_master)
        data = eds.data
        read(0x1021, 0, lambda _now: data)
        for tpdo in self.tpdos:
            index = COMMUNICATION + tpdo.number
            changed = partial(self._tpdo_changed, tpdo)
            hook(index, 1, partial(self._check_tpdo_cob_id, tpdo), changed)
            hook(index, 2, tpdo.check_type, changed)
            hook(index, 3, tpdo.check_while_invalid, changed)
            hook(index, 5, None, changed)
            hook(index, 6, tpdo.check_sync_start, changed)
            hook(MAPPING + tpdo.number, 0, tpdo.check_count, changed)
            for variable in self.dictionary.subs(MAPPING + tpdo.number):
                variable.check, variable.written = tpdo.check_entry, changed
        read(at.INFO, 6, lambda _now: self._device_name())
        read(at.INFO, 7, lambda _now: self._firmware())
        for variable in self.dictionary.subs(at.SETTINGS):
            variable.written = self._settings_written
        read(at.NODE_ID, 1, lambda _now: self.node_id)
        read(at.NODE_ID, 2, lambda _now: self.pending_node_id)
        hook(at.NODE_ID, 2, self._check_node_id, self._node_id_written)
        read(at.NODE_ID, 3, lambda _now: self.settings.bitrate)
        read(at.NODE_ID, 4, lambda _now: self.settings.bitrate)
        hook(at.RESET_STATISTICS, 1, _signature(RESET), lambda _now: self._reset_statistics())
        read(at.ERROR_CODE, 0, lambda _now: self.emergencies.code)

    def _bind_sources(self) -> None:
        """Objects that show a value of the ESC or of the gateway."""
        for (index, sub), bound in BINDINGS.items():
            variable = self.dictionary.get(index, sub)
            if variable is not None:
                self._bound[index, sub] = bound
                variable.read = self._reader(variable, bound)

    def _reader(self, variable: Variable, bound: Bound) -> Callable[[int], Value]:
        esc, gateway, dictionary = self.esc, self._gateway, self.dictionary
        low, high = range_of(variable)
        not_available = high if low == 0 else low
        is_live = bound.source.group is Group.LIVE

        def read(now: int) -> Value:
            behaviour = dictionary.number(at.SETTINGS, 5)
            if is_live and esc.live is None:
                if behaviour == _CODES:
                    return not_available
                if esc.last_live is None:
                    raise SdoAbort(Abort.NO_DATA)
                if behaviour != _LAST_VALUE:
                    raise SdoAbort(Abort.DEVICE_STATE)
                value = bound.last(esc, high)
            else:
                value = bound.read(esc, gateway, now, high)
            if value is not None and low <= value <= high:
                return value
            if behaviour == _CODES:
                return not_available
            raise SdoAbort(Abort.NO_DATA)

        return read

    # --- objects of services

    def _status_register(self) -> int:
        """1002h: bits 7..0 link status as 2020h:1, 15..8 CAN state, 16 telemetry fresh, 17 information fresh."""
        esc = self.esc
        return (
            int(esc.link)
            | (self._gateway.state is GatewayState.REPLAY) << 6
            | (esc.info is not None) << 7
            | int(self._gateway.can_state) << 8
            | (esc.live is not None) << 16
            | (esc.info is not None) << 17
        )

    def _history(self, number: int, _now: int) -> int:
        history = self.emergencies.history
        if number > len(history):
            raise SdoAbort(Abort.NO_DATA)
        return history[number - 1]

    def _clear_history(self) -> bool:
        self.emergencies.history.clear()
        return True

    def _later(self, work: Callable[[int], None], part: int, _now: int) -> bool:
        work(part)
        return False

    def _rerouted(self, _now: int) -> bool:
        self._around.routes_changed()
        return True

    def _check_emergency_cob_id(self, value: int) -> None:
        """1014h: bits 0..30 cannot change while it is valid; no 29-bit or restricted id, none that is taken."""
        old, valid = self.emergency_id, not value & INVALID_BIT
        if value & 0x7FFFF800 or (valid and restricted(value & 0x7FF)):
            raise SdoAbort(Abort.VALUE)
        if valid and not old & INVALID_BIT and old != value:
            raise SdoAbort(Abort.VALUE)
        if valid and self._around.cob_id_taken(value & 0x7FF, self):
            raise SdoAbort(Abort.INCOMPATIBLE)

    def _check_sync_cob_id(self, value: int) -> None:
        sync.check_cob_id(value, restricted(value & 0x7FF))
        if self._around.cob_id_taken(value & 0x7FF, sync):
            raise SdoAbort(Abort.INCOMPATIBLE)

    def _set_emergency_inhibit(self) -> bool:
        self.emergencies.inhibit_ns = self.dictionary.number(0x1015) * MS // 10
        return True

    def _check_watch(self, me: Variable, value: int) -> None:
        others = [
            v.value
            for v in self.dictionary.subs(0x1016)
            if v is not me and isinstance(v.value, int)
        ]
        heartbeat.check_consumer(value, others)

    def _watches_changed(self, now: int) -> bool:
        lost = self.consumer.lost
        self.consumer.configure(
            v.value for v in self.dictionary.subs(0x1016) if isinstance(v.value, int)
        )
        for node_id in set(lost).difference(self.consumer.lost):
            self.emergencies.set(GatewayError.HEARTBEAT_LOST, False, now, node_id)
        self._around.routes_changed()
        return True

    def _heartbeat_changed(self, now: int) -> bool:
        self.producer.configure(self.dictionary.number(0x1017), now)
        return True

    def _check_tpdo_cob_id(self, tpdo: Tpdo, value: int) -> None:
        tpdo.check_cob_id(value, lambda cob_id: self._around.cob_id_taken(cob_id, tpdo))

    def _tpdo_changed(self, tpdo: Tpdo, now: int) -> bool:
        tpdo.configure(now)
        self._around.routes_changed()  # its COB-ID may be another one
        return True

    def _device_name(self) -> bytes:
        info = self.esc.last_info
        if info is None:
            raise SdoAbort(Abort.NO_DATA)
        return (device_text(info.device) or f"device {info.device}").encode("ascii")

    def _firmware(self) -> bytes:
        info = self.esc.last_info
        if info is None:
            raise SdoAbort(Abort.NO_DATA)
        return info.firmware.encode("ascii")

    def _settings_written(self, now: int) -> bool:
        self._apply_settings(now)
        return True

    def _check_node_id(self, value: int) -> None:
        if not 1 <= value <= 127:
            raise SdoAbort(Abort.VALUE)
        if self._around.node_id_taken(value, self):
            raise SdoAbort(Abort.INCOMPATIBLE)

    def _node_id_written(self, _now: int) -> bool:
        self._set_pending(self.dictionary.number(at.NODE_ID, 2))
        return True

    def _reset_statistics(self) -> bool:
        self.esc.reset_statistics()
        return True


def _only_zero(value: int) -> None:
    if value:
        raise SdoAbort(Abort.VALUE)


def _no_master(value: int) -> None:
    """1F80h of a slave: only the bits about starting by itself (2) and starting others (3, without meaning here)."""
    if value & ~0x0C:
        raise SdoAbort(Abort.VALUE)


def _signature(wanted: int) -> Callable[[int], None]:
    def check(value: int) -> None:
        if value != wanted:
            raise SdoAbort(Abort.TRANSFER)

    return check


def range_of(variable: Variable) -> tuple[int, int]:
    """Smallest and greatest value of a whole-number type; (0, -1) for other types."""
    size = variable.size
    if size is None:
        return 0, -1
    bits = 8 * size
    return (
        (-(1 << bits - 1), (1 << bits - 1) - 1) if fits(variable, -1, 1) else (0, (1 << bits) - 1)
    )
