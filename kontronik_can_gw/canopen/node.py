"""One CANopen node: the services put together over the object dictionary of one ESC (CiA 301).

Frames, telemetry events and time in, frames out. Each service is given the dictionary and binds its own objects; what is bound to no
service is plain storage. The node itself has what several services have a part in: resets, states, which frame goes where.
"""

from functools import partial
from typing import TYPE_CHECKING

from kontronik_can_gw.canopen.bound_values import bind_values
from kontronik_can_gw.canopen.cob_ids import HEARTBEAT, LSS_ANSWER, SDO_ANSWER
from kontronik_can_gw.canopen.dictionary import Abort, Variable
from kontronik_can_gw.canopen.emergency import Emergencies
from kontronik_can_gw.canopen.emergency_codes import BitCodes, GatewayError
from kontronik_can_gw.canopen.esc_objects import EscObjects
from kontronik_can_gw.canopen.lss import Identity, LssSlave
from kontronik_can_gw.canopen.nmt import Consumer, Nmt, Producer
from kontronik_can_gw.canopen.node_settings import NodeSetup
from kontronik_can_gw.canopen.pdo import Tpdos
from kontronik_can_gw.canopen.sdo import SdoServer
from kontronik_can_gw.canopen.storage import Parameters, Stored, encode
from kontronik_can_gw.canopen.sync import SyncConsumer
from kontronik_can_gw.esc.telemetry import EscTelemetry
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.status import UNCONFIGURED, GatewayStatus, NmtState
from kontronik_can_gw.times import NEVER

if TYPE_CHECKING:
    from kontronik_can_gw.canopen.nodes import Nodes

_WITH_COB_ID = frozenset({0x1005, 0x1014, 0x1016, *range(0x1800, 0x1A00)})
"""Objects whose download may change COB-IDs."""


class Node:
    """One ESC's node. ``set_due`` follows each call of one of its services. ``number``: of its ESC in the setup."""

    def __init__(
        self,
        number: int,
        setup: NodeSetup,
        esc: EscTelemetry,
        gateway: GatewayStatus,
        owner: "Nodes",
    ) -> None:
        self.esc = esc
        base = esc.settings if setup.base is None else setup.base
        self.dictionary = dictionary = setup.dictionary(base)
        self.settings = settings = setup.settings
        self._number = number
        self.due = NEVER
        self._owner = owner
        taken = owner.cob_id_taken
        self.nmt = Nmt(dictionary, settings.self_start, self._entered)
        codes = BitCodes(esc.protocol.errors.get("operating_errors", ()))
        self.emergencies = Emergencies(dictionary, self._send, taken, codes)
        self._producer = Producer(dictionary, self._send_heartbeat)
        self.consumer = Consumer(dictionary, self._watch_changed)
        self.sync = SyncConsumer(dictionary, taken)
        self.sdo = SdoServer(dictionary, self._send_sdo, settings.segment_ns)
        self.parameters = Parameters(dictionary, setup.stored, self.sdo, self._save)
        self.identity = Identity(
            dictionary,
            settings,
            self.parameters,
            lambda node_id: owner.node_id_taken(node_id, self),
            self.reset_communication,
        )
        self.lss = LssSlave(self.identity, partial(self._send, LSS_ANSWER))
        bind_values(dictionary, esc, gateway)
        self.tpdos = Tpdos(dictionary, partial(owner.slot, number), gateway, taken)
        changed = partial(owner.settings_changed, number)
        self._esc_objects = EscObjects(self, gateway, changed)
        self._timers = (self._producer, self.consumer, self.sdo, self.emergencies, self.tpdos)
        dictionary.bind(0x100A, read=lambda _now: settings.version.encode("ascii", "replace"))
        dictionary.bind(0x1021, read=lambda _now: setup.eds.data)  # the stored EDS
        dictionary.written = self._on_download

    @property
    def state(self) -> NmtState:
        return self.nmt.state

    @property
    def node_id(self) -> int:
        """1..127; 255 before the first reset and for a node that waits for LSS."""
        return self.identity.active_node_id

    @property
    def claimed_node_id(self) -> int:
        """The node-ID it has; before it is powered on the one it will have."""
        is_on = self.state is not NmtState.INITIALISING
        return self.node_id if is_on else self.identity.pending_node_id

    # --- resets

    def reset_node(self, now: int) -> None:
        """NMT reset node, and power-on: manufacturer's and profile objects too. Without a node-ID it stays silent until LSS gives one."""
        self.tpdos.stop()
        self.emergencies.close()  # nothing is sent before the boot-up message
        self.parameters.reset_application(self.identity.pending_node_id)
        self._esc_objects.apply_settings(now)
        self._reset_communication(now)

    def reset_communication(self, now: int) -> None:
        """NMT reset communication: the pending node-ID, power-on values of 1000h..1FFFh, boot-up."""
        self.parameters.rejected = []
        self._reset_communication(now)

    def _reset_communication(self, now: int) -> None:
        parameters = self.parameters
        self.tpdos.stop()
        self.sdo.reset()
        self.lss.reset()
        self.emergencies.reset()
        node_id = self.identity.activate()
        parameters.reset_communication(node_id)
        self.emergencies.configure(node_id)
        self.tpdos.release_ids()
        parameters.reject_what_breaks_rules()
        for tpdo in self.tpdos:
            parameters.rejected += tpdo.reset(node_id, now)
        self.consumer.reset()
        self.nmt.state = NmtState.INITIALISING
        if node_id == UNCONFIGURED:
            self._producer.stop()
        else:
            self._producer.configure(now)
            self._send_heartbeat()  # the boot-up message
            self.nmt.enter(NmtState.PRE_OPERATIONAL, now)
            if self.nmt.starts_itself:
                self.nmt.enter(NmtState.OPERATIONAL, now)
        if parameters.rejected:
            self._owner.reject(self._number, parameters.rejected)
        parameters.verify()
        self._owner.rerouted = True
        self._owner.revision += 1

    # --- what happens

    def on_event(self, events: int, now: int) -> None:
        """Something of the ESC changed: bits of telemetry.Event."""
        self._esc_objects.on_event(events, now)
        self.due = min(self.due, self.emergencies.due)  # the others move on at most

    def advance(self, now: int) -> None:
        """Let time pass."""
        if now < self.due:
            return
        for timer in self._timers:
            timer.advance(now)
        self.set_due()

    def saved(self, error: str | None, now: int) -> None:
        """The oldest request to store is done: on disk, or failed for a reason."""
        ticket = self.parameters.saved(error is None)
        if error is None:
            self.emergencies.set(GatewayError.PARAMETER_FILE, False, now)
        if ticket is None:
            self.lss.stored(error is None)
        else:
            self.sdo.confirm(None if error is None else Abort.HARDWARE, ticket)

    # --- what services give out

    def _send(self, cob_id: int, data: bytes) -> None:
        self._owner.send(CanFrame(cob_id, data, queued=True))

    def _save(self, stored: Stored) -> None:
        self._owner.save(self._number, encode(stored))

    def _send_sdo(self, data: bytes) -> None:
        self._send(SDO_ANSWER + self.node_id, data)

    def _send_heartbeat(self) -> None:
        self._send(HEARTBEAT + self.node_id, bytes([self.state]))

    # --- what services cause in others

    def _entered(self, now: int) -> None:
        """The NMT state is another one."""
        self.tpdos.stop()
        self._owner.revision += 1
        if self.state is NmtState.STOPPED:
            self.emergencies.close()
            self.sdo.reset()
            return
        self.emergencies.open(now)
        if self.state is NmtState.OPERATIONAL:
            for tpdo in self.tpdos:
                tpdo.start(now)

    def _watch_changed(self, node_id: int, lost: bool, now: int, at: int) -> None:
        """Reports that a watched heartbeat is missing since ``at``, or is back."""
        self.emergencies.set(GatewayError.HEARTBEAT_LOST, lost, now, node_id, at)
        if lost:
            self.nmt.behave(1, now)

    def _on_download(self, variable: Variable, changed: bool, now: int) -> None:
        for tpdo in self.tpdos:
            tpdo.on_download(variable, now)
        self.parameters.on_download(variable, changed)
        if variable.entry.index in _WITH_COB_ID:
            self._owner.rerouted = True

    def returned(self, now: int) -> None:
        """The controller left bus-off, or the interface is back. With 1029h:1 = 0 the node boots, so that its master sets it up anew.

        CiA 301 asks for PRE-OPERATIONAL then; a boot-up besides is what brings a node without a master, self-starting, to work again.
        """
        if self.nmt.boots_after_outage and self.node_id != UNCONFIGURED:
            self.reset_communication(now)
        else:
            self._producer.beat(now)
            self.repeat(now)

    def repeat(self, now: int) -> None:
        """Frames were lost: what is sent on change only, and what is wrong, is sent once more."""
        self.emergencies.repeat(now)
        self.tpdos.repeat(now)

    def set_due(self) -> None:
        """Look when ``advance`` has something to do: after each call of a service."""
        self.due = min([timer.due for timer in self._timers])
