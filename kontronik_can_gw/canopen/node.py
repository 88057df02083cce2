"""One CANopen node: the services that share the object dictionary of one ESC (CiA 301).

Frames, events of the ESC and time go in, frames come out. Each service gets the dictionary and
binds its own objects. An object that no service binds only stores its value. The node itself does
what concerns several services: resets, changes of state, and the routing of frames.
"""

from collections.abc import Iterator
from functools import partial
from typing import Protocol

from kontronik_can_gw.canopen import nmt
from kontronik_can_gw.canopen.bound_values import bind_values
from kontronik_can_gw.canopen.cob_ids import (
    HEARTBEAT,
    INVALID_BIT,
    LSS_ANSWER,
    LSS_REQUEST,
    NMT,
    SDO_ANSWER,
    SDO_REQUEST,
    SYNC,
    FrameTaker,
    Use,
)
from kontronik_can_gw.canopen.dictionary import Abort, Variable
from kontronik_can_gw.canopen.emergency import Emergencies
from kontronik_can_gw.canopen.emergency_codes import BitCodes, GatewayError
from kontronik_can_gw.canopen.esc_objects import EscObjects
from kontronik_can_gw.canopen.lss import Identity, LssSlave
from kontronik_can_gw.canopen.nmt import Command, Consumer, Nmt, Producer
from kontronik_can_gw.canopen.node_settings import NodeSetup
from kontronik_can_gw.canopen.pdo import SyncConsumer, Tpdos
from kontronik_can_gw.canopen.sdo import SdoServer
from kontronik_can_gw.canopen.storage import Parameters, Stored, encode
from kontronik_can_gw.core.output import OutputHost
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.status import UNCONFIGURED, NmtState
from kontronik_can_gw.times import NEVER

_WITH_COB_ID = frozenset({0x1005, 0x1014, 0x1016, *range(0x1800, 0x1A00)})
"""Objects whose download may change COB-IDs."""


class NodeHost(Protocol):
    """The owner of a node, which connects it with the bus, the store and the other nodes."""

    def send(self, frame: CanFrame) -> None:
        """Send a frame."""

    def save(self, esc: int, content: bytes) -> None:
        """Store the parameters of the node with this number."""

    def note_change(self) -> None:
        """Follow a change of the node's state or of its COB-IDs."""

    def is_cob_id_used(self, cob_id: int, user: object) -> bool:
        """Return True if another user of the gateway has this COB-ID. ``user`` as in ``Use``."""

    def is_node_id_used(self, node_id: int, node: "Node") -> bool:
        """Return True if another node or a message prevents this node from having a node-ID."""


class Node:
    """The node of one ESC.

    ``number`` is the index of the ESC in ``core``. After calls of its services, ``set_due`` must be
    called.
    """

    def __init__(
        self,
        number: int,
        setup: NodeSetup,
        core: OutputHost,
        host: NodeHost,
    ) -> None:
        esc = core.escs[number]
        self.esc = esc
        self.due = NEVER
        """The time at which ``advance`` must be called."""
        settings = setup.settings
        self.settings = settings
        base = esc.settings if setup.base is None else setup.base
        dictionary = setup.dictionary(base)
        self.dictionary = dictionary
        self._number = number
        self._host = host
        self.rejected: list[int] = []
        """The keys of stored values that resets rejected. The host empties it."""
        is_used = host.is_cob_id_used
        self.nmt = Nmt(dictionary, settings.self_start, self._entered)
        codes = BitCodes(esc.protocol.errors.get("operating_errors", ()))
        self.emergencies = Emergencies(dictionary, self._send, is_used, codes)
        self.producer = Producer(dictionary, self._send_heartbeat)
        self.consumer = Consumer(dictionary, self._watch_changed)
        self.sync = SyncConsumer(dictionary, is_used)
        self.sdo = SdoServer(dictionary, self._send_sdo, settings.segment_ns)
        self.parameters = Parameters(dictionary, setup.stored, self.sdo, self._save)
        self.identity = Identity(
            dictionary,
            settings,
            self.parameters,
            lambda node_id: host.is_node_id_used(node_id, self),
            self.reset_communication,
        )
        self.lss = LssSlave(self.identity, partial(self._send, LSS_ANSWER))
        bind_values(dictionary, esc, core.status)
        new_slot = partial(core.slot, number)
        self.tpdos = Tpdos(dictionary, new_slot, core.status, is_used)
        self._esc_objects = EscObjects(
            dictionary,
            esc,
            core.status,
            emergencies=self.emergencies,
            nmt=self.nmt,
            device=settings.device,
            changed=partial(core.apply, number),
        )
        self._timers = (
            self.producer,
            self.consumer,
            self.sdo,
            self.emergencies,
            self.tpdos,
        )
        version = settings.version.encode("ascii", "replace")
        dictionary.bind(0x100A, read=lambda _now: version)
        dictionary.bind(0x1021, read=lambda _now: setup.eds.data)  # the stored EDS
        dictionary.written = self._on_download

    @property
    def state(self) -> NmtState:
        """The NMT state."""
        return self.nmt.state

    @property
    def node_id(self) -> int:
        """1..127, or 255 before the first reset and for a node that waits for LSS."""
        return self.identity.active_node_id

    @property
    def claimed_node_id(self) -> int:
        """The node-ID of the node, or before power-on the one that it will have."""
        if self.state is NmtState.INITIALISING:
            return self.identity.pending_node_id
        return self.node_id

    # --- COB-IDs

    def uses(self) -> Iterator[Use]:
        """Yield the COB-IDs that the node sends with or receives as its own."""
        yield Use(NMT, "NMT")
        yield Use(LSS_REQUEST, "LSS")
        yield Use(LSS_ANSWER, "LSS")
        if self.node_id == UNCONFIGURED:
            return
        name = f"CANopen node {self.node_id}"
        yield Use(self.sync.cob_id, "SYNC", SYNC)
        yield Use(SDO_REQUEST + self.node_id, f"SDO requests to {name}")
        yield Use(HEARTBEAT + self.node_id, f"the heartbeat of {name}", is_own=True)
        yield Use(SDO_ANSWER + self.node_id, f"SDO responses of {name}", is_own=True)
        emergencies = self.emergencies
        cob_id = emergencies.cob_id
        if not cob_id & INVALID_BIT:
            yield Use(cob_id & 0x7FF, f"emergencies of {name}", emergencies, is_own=True)
        for tpdo in self.tpdos:
            if tpdo.is_valid:
                yield Use(tpdo.cob_id, f"TPDO {tpdo.number + 1} of {name}", tpdo, is_own=True)

    def routes(self) -> Iterator[tuple[int, FrameTaker]]:
        """Yield the COB-IDs that the node receives, each with the function that takes its frames.

        The heartbeats that it watches are included.
        """
        yield LSS_REQUEST, lambda data, now, _at: self.lss.receive(data, now)
        if self.node_id != UNCONFIGURED:
            yield NMT, self._on_nmt
            yield self.sync.cob_id, self._on_sync
            yield SDO_REQUEST + self.node_id, self._on_sdo
            for node_id in self.consumer.node_ids:
                yield HEARTBEAT + node_id, partial(self.consumer.receive, node_id)

    def _on_nmt(self, data: bytes, now: int, _at: int) -> None:
        command = nmt.command(data, self.node_id)
        if command is Command.RESET_NODE:
            self.reset_node(now)
        elif command is Command.RESET_COMMUNICATION:
            self.reset_communication(now)
        elif command is not None:
            self.nmt.enter(nmt.STATE_AFTER[command], now)

    def _on_sdo(self, data: bytes, now: int, _at: int) -> None:
        if self.nmt.communicates:
            self.sdo.receive(data, now)

    def _on_sync(self, data: bytes, now: int, at: int) -> None:
        if not self.nmt.communicates:
            return
        counter = self.sync.counter(data)
        self.emergencies.set(GatewayError.SYNC_LENGTH, counter is None, now, at=at)
        if counter is not None:
            self.tpdos.on_sync(counter, now, at)

    # --- resets

    def reset_node(self, now: int) -> None:
        """Reset the node, as after power-on: also objects of manufacturer and profile.

        A node without a node-ID stays silent until LSS gives it one.
        """
        self.tpdos.stop()
        self.emergencies.close()  # nothing is sent before the boot-up message
        self.parameters.reset_application(self.identity.pending_node_id)
        self._esc_objects.apply_settings(now)
        self._reset_communication(now)

    def reset_communication(self, now: int) -> None:
        """Activate the pending node-ID, restore power-on values of 1000h..1FFFh, and boot."""
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
            self.producer.stop()
        else:
            self.producer.configure(now)
            self._send_heartbeat()  # the boot-up message
            self.nmt.enter(NmtState.PRE_OPERATIONAL, now)
            if self.nmt.starts_itself:
                self.nmt.enter(NmtState.OPERATIONAL, now)
        self.rejected += parameters.rejected
        parameters.verify()
        self._host.note_change()

    # --- calls of the host

    def on_event(self, events: int, now: int) -> None:
        """Follow a change of the ESC. ``events`` are bits of ``telemetry.Event``."""
        self._esc_objects.on_event(events, now)
        # An event can only make the emergencies due earlier. The other services become due later.
        self.due = min(self.due, self.emergencies.due)

    def advance(self, now: int) -> None:
        """Let time pass until ``now``, which is ``due`` or later."""
        for timer in self._timers:
            timer.advance(now)

    def saved(self, error: str | None, now: int) -> None:
        """Follow the end of the oldest save. ``error`` is the reason if it failed."""
        ticket = self.parameters.saved(error is None)
        if error is None:
            self.emergencies.set(GatewayError.PARAMETER_FILE, False, now)
        if ticket is None:
            self.lss.stored(error is None)
        else:
            self.sdo.confirm(None if error is None else Abort.HARDWARE, ticket)

    def returned(self, now: int) -> None:
        """Follow the end of bus-off, or the return of the interface.

        With 1029h:1 = 0 the node boots, so that its master configures it again. CiA 301 asks for
        PRE-OPERATIONAL. After the boot-up, a self-starting node without a master works again, too.
        """
        if self.nmt.boots_after_outage and self.node_id != UNCONFIGURED:
            self.reset_communication(now)
        else:
            self.producer.beat(now)
            self.repeat(now)

    def repeat(self, now: int, ended: GatewayError | None = None) -> None:
        """Send active errors and PDOs that are sent on change again, because frames were lost.

        ``ended`` is an error that has ended and was not reported.
        """
        self.emergencies.repeat(now, ended)
        self.tpdos.repeat(now)

    def set_due(self) -> None:
        """Compute ``due`` from the services."""
        self.due = min([timer.due for timer in self._timers])

    # --- calls of the services

    def _send(self, cob_id: int, data: bytes) -> None:
        self._host.send(CanFrame(cob_id, data, queued=True))

    def _save(self, stored: Stored) -> None:
        self._host.save(self._number, encode(stored))

    def _send_sdo(self, data: bytes) -> None:
        self._send(SDO_ANSWER + self.node_id, data)

    def heartbeat(self) -> CanFrame:
        """Return a heartbeat. It is not sent."""
        return CanFrame(HEARTBEAT + self.node_id, bytes([self.state]))

    def _send_heartbeat(self) -> None:
        self._send(HEARTBEAT + self.node_id, bytes([self.state]))

    def _entered(self, now: int) -> None:
        """Follow a change of the NMT state."""
        self.tpdos.stop()
        self._host.note_change()
        if self.state is NmtState.STOPPED:
            self.emergencies.close()
            self.sdo.reset()
            return
        self.emergencies.open(now)
        if self.state is NmtState.OPERATIONAL:
            for tpdo in self.tpdos:
                tpdo.start(now)

    def _watch_changed(
        self,
        node_id: int,
        is_lost: bool,
        now: int,
        at: int,
    ) -> None:
        """Report that a watched heartbeat is missing since ``at``, or is back."""
        self.emergencies.set(GatewayError.HEARTBEAT_LOST, is_lost, now, node_id, at)
        if is_lost:
            self.nmt.behave(1, now)

    def _on_download(self, variable: Variable, has_changed: bool, now: int) -> None:
        for tpdo in self.tpdos:
            tpdo.on_download(variable, now)
        self.parameters.on_download(variable, has_changed)
        if variable.entry.index in _WITH_COB_ID:
            self._host.note_change()
