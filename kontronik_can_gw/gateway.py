"""The assembly of the pure core, and the only surface the runtime sees: bytes, CAN frames and time in, CAN frames and deadlines out.

``now`` is integer nanoseconds of one monotonic clock: the loop's when live, the capture's in replay.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.dbc.messages import Messages
from kontronik_can_gw.esc.telemetry import SECOND, EscSettings, EscTelemetry, Event
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway_status import CanState, GatewayState, GatewayStatus
from kontronik_can_gw.id_conflicts import Conflict, IdConflicts
from kontronik_can_gw.output import Output
from kontronik_can_gw.signals.plan import Layout

if TYPE_CHECKING:
    from kontronik_can_gw.canopen.nodes import CanopenSetup, Nodes

MakeOutput = Callable[[Sequence[EscTelemetry], GatewayStatus, int], Output]
"""ESCs, gateway and time to an output that begins then."""


class Gateway:
    """One gateway: several ESCs in, one CAN bus out. ``canopen`` None: no CANopen nodes; a layout without messages: no DBC output."""

    def __init__(
        self,
        escs: Sequence[EscSettings],
        layout: Layout,
        now: int,
        silent_on_loss: bool = False,
        canopen: "CanopenSetup | None" = None,
        further: Sequence[MakeOutput] = (),
    ) -> None:
        self.escs = [EscTelemetry(settings, now) for settings in escs]
        self.status = GatewayStatus(esc_count=len(escs), started_ns=now)
        dbc = Messages(layout, self.escs, self.status, now, silent_on_loss)
        self.nodes: Nodes | None = None
        if canopen is not None:
            self.nodes = _nodes(canopen, layout, self.escs, self.status, self._apply)
        self._message_bits = dbc.bits
        self._outputs: tuple[Output, ...] = (
            *(() if self.nodes is None else (self.nodes,)),
            *(make(self.escs, self.status, now) for make in further),
            dbc,
        )
        self._conflicts = IdConflicts(self._outputs)
        self._being_saved: list[tuple[int, Output]] = []
        self._link_changes: list[int] = []
        self._dropped = False
        self._second_ns = now
        self.shortest_timeout_ns = self._shortest_timeout()
        """Of all ESCs: live data of one is not available after this."""
        self._next_expiry = 0
        """No ESC has a deadline before this: they only move on, but for a link that comes up, which sets this back."""

    def start(self, now: int, can_open: bool = True) -> None:
        """The runtime has opened what it could: run. Nodes boot when there is a bus that can hear it."""
        self.status.state = GatewayState.RUNNING
        for output in self._outputs:
            output.start(now, can_open)

    def stop(self, now: int) -> None:
        """The last word: a status that says the gateway is going."""
        self.status.state = GatewayState.STOPPING
        for output in self._outputs:
            output.stop(now)

    def receive_bytes(self, esc: int, data: bytes, now: int, since: int) -> None:
        """Bytes of one ESC's UART, read at ``now``. ``since``: none of them had come by then (telemetry.py, Arrival)."""
        if now >= self._next_expiry:
            self._expire(now, but=esc)  # a message may hold values of several ESCs
        for events in self.escs[esc].receive_each(data, now, since):
            self._follow(esc, events, now)

    @property
    def receive_ids(self) -> frozenset[int]:
        """The ids (29-bit ones with EXTENDED) of the frames that ``receive_frame`` is to be given; the same object until they change.

        Those that the outputs listen to, and those that only this gateway sends with: another device that does is to be noticed.
        """
        return self._conflicts.receive_ids

    def receive_frame(self, frame: CanFrame, now: int, at: int) -> None:
        """A data frame of another device with one of ``receive_ids``, read at ``now``; it came ``at``."""
        if not frame.remote and self._conflicts.receive(frame.key, now):
            self.status.id_conflicts += 1
        takers = [output for output in self._outputs if output.receive_ids]
        if takers:
            self._expire(now)
        for output in takers:
            output.receive(frame, now, at)

    def can_opened(self, now: int) -> None:
        """The interface was opened (again): what we sent before may still come back, and is no conflict."""
        self._conflicts.can_opened(now)

    @property
    def first_message_id(self) -> int | None:
        """The lowest id that the gateway itself, not the node of an ESC, sends with; None without any."""
        return self._conflicts.first_own_id()

    def take_conflicts(self) -> list[Conflict]:
        """Conflicts of ids that have begun, or are over, since the last call."""
        return self._conflicts.take()

    def receive_overrun(self, now: int) -> None:
        """The CAN controller lost received frames."""
        for output in self._outputs:
            output.overrun(now)

    def take_saves(self) -> list[tuple[int, Any]]:
        """Parameters to store, (ESC, what), oldest first; each is answered by one call of ``saved`` for that ESC, in this order."""
        found = []
        for output in self._outputs:
            if output.saves:
                found += output.saves
                self._being_saved += [(esc, output) for esc, _ in output.saves]
                output.saves = []
        return found

    def take_rejected_parameters(self) -> list[tuple[int, int]]:
        """Stored values that were rejected at a node's reset: (ESC, index << 8 | sub-index)."""
        found = []
        for output in self._outputs:
            if output.rejected_parameters:
                found += output.rejected_parameters
                output.rejected_parameters = []
        return found

    def saved(self, esc: int, error: str | None, now: int) -> None:
        """An ESC's parameters are on disk; or could not be stored, and why."""
        for number, (of, output) in enumerate(self._being_saved):
            if of == esc:
                del self._being_saved[number]
                output.saved(esc, error, now)
                break

    def parameters_damaged(self, esc: int, now: int) -> None:
        """What was stored for an ESC could not be read: its node runs on defaults and reports it."""
        for output in self._outputs:
            output.parameters_damaged(esc, now)

    def port_opened(self, esc: int, now: int) -> None:
        """An ESC's port is open (again)."""
        self._follow(esc, self.escs[esc].port_opened(), now)

    def port_lost(self, esc: int, now: int) -> None:
        """An ESC's port cannot be used: its values are not available from now on."""
        self._follow(esc, self.escs[esc].port_lost(), now)

    def can_returned(self, now: int) -> None:
        """Frames can be sent again after some were lost: say everything that has no cycle once more."""
        self._expire(now)
        for output in self._outputs:
            output.can_returned(now)

    def held_up(self, now: int, dropped: bool) -> None:
        """The process was held up. Commands that waited are obeyed, SYNCs that waited are not answered any more.

        ``dropped``: measurements that waited to be sent were dropped: they are made anew with the next ``advance``, of what came by then.
        """
        self._expire(now)
        self._dropped = dropped
        for output in self._outputs:
            output.held_up(now)

    def set_can_state(self, state: CanState, now: int) -> None:
        """What the runtime knows of the CAN controller."""
        self._expire(now)
        before, self.status.can_state = self.status.can_state, state
        for output in self._outputs:
            output.on_can_state(before, state, now)

    def advance(self, now: int) -> None:
        """Let time pass: time-outs, cyclic messages."""
        if now >= self._next_expiry:
            self._expire(now)
        if self._dropped:
            self._dropped = False
            for output in self._outputs:
                output.make_anew(now)
        for output in self._outputs:
            output.advance(now)

    def message_bits(self, message: int, now: int, page: int | None = None) -> int:
        """What the layout's message of this index would hold if it were sent now, alive counter and CRC 0; bit 0 is bit 0 of byte 0."""
        return self._message_bits(message, now, page)

    def next_deadline(self) -> int:
        """When ``advance`` is to be called at the latest."""
        due = self._next_expiry or min(esc.next_deadline() for esc in self.escs)
        for output in self._outputs:
            of_output = output.next_deadline()
            if of_output < due:
                due = of_output
        return due

    @property
    def frames_wait(self) -> bool:
        """True while ``take_frames`` has something to hand over."""
        return any(output.frames for output in self._outputs)

    def take_frames(self) -> list[CanFrame]:
        """The frames to send, oldest first, output by output; the list is handed over."""
        frames: list[CanFrame] = []
        for output in self._outputs:
            if output.frames:
                frames += output.frames
                output.frames.clear()
        return frames

    def not_sent(self, now: int) -> None:
        """The frames that were taken last were thrown away. The gateway itself need not know; who records it does."""

    def take_link_changes(self) -> list[int]:
        """ESCs whose link state, layout or device changed since the last call."""
        if not self._link_changes:
            return []
        changes, self._link_changes = self._link_changes, []
        return changes

    @property
    def node_changes(self) -> int:
        """Grows with each change of a node's state or node-ID."""
        return sum([output.state_changes for output in self._outputs])

    @property
    def node_ids(self) -> list[int]:
        """Node-IDs of the nodes; before the start those that they will have."""
        return [node_id for node_id, _, _ in self.node_states()]

    def node_states(self) -> list[tuple[int, Any, int]]:
        """Of each ESC's node: node-ID, state, PDOs sent so far. Empty without nodes."""
        return [state for output in self._outputs for state in output.node_states()]

    def _expire(self, now: int, but: int | None = None) -> None:
        """What is too old by now goes before anything is sent."""
        if now < self._next_expiry:
            return
        for index, esc in enumerate(self.escs):
            if index != but and now >= esc.next_deadline():
                self._follow(index, esc.advance(now), now)
        self._next_expiry = min(esc.next_deadline() for esc in self.escs)
        if now - self._second_ns >= SECOND:
            self._second_ns = now
            self._conflicts.advance(now)
            for output in self._outputs:
                output.on_gateway_change(now, each_second=True)

    def _follow(self, esc: int, events: int, now: int) -> None:
        if events:
            for output in self._outputs:
                output.on_event(esc, events, now)
        if events & Event.LINK:
            self._next_expiry = min(self._next_expiry, self.escs[esc].next_deadline())
            self._link_changes.append(esc)
            escs_ok = sum([e.live is not None for e in self.escs])
            if escs_ok != self.status.escs_ok:
                self.status.escs_ok = escs_ok
                for output in self._outputs:
                    output.on_gateway_change(now)

    def _apply(self, esc: int, settings: EscSettings) -> None:
        """Settings that came over the bus: they hold for everything that is sent, the DBC's messages too."""
        self.escs[esc].apply(settings)
        self.shortest_timeout_ns = self._shortest_timeout()
        self._next_expiry = 0

    def _shortest_timeout(self) -> int:
        return min(esc.settings.timeout_ns for esc in self.escs)


def _nodes(
    setup: "CanopenSetup",
    layout: Layout,
    escs: Sequence[EscTelemetry],
    status: GatewayStatus,
    apply: Callable[[int, EscSettings], None],
) -> "Nodes":
    from kontronik_can_gw.canopen.nodes import Nodes  # nothing of it is loaded without CANopen

    ids = {m.can_id: f"message {m.name}" for m in layout.messages if not m.extended}
    return Nodes(setup, escs, status, apply, ids)
