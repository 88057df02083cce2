"""The core with its outputs, and the only surface the runtime sees: bytes, CAN frames and time in, CAN frames and deadlines out.

``now`` is integer nanoseconds of one monotonic clock: the loop's when live, the capture's in replay.
"""

from collections.abc import Sequence

from kontronik_can_gw.core.interface import Core, Follower
from kontronik_can_gw.core.output import NodeOutput, NodeState
from kontronik_can_gw.core.output_setup import OutputMaker
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.id_conflicts import IdConflicts
from kontronik_can_gw.native.load import make_core
from kontronik_can_gw.signals.plan import Layout
from kontronik_can_gw.status import CanState, GatewayState
from kontronik_can_gw.times import NEVER


class Gateway:
    """One gateway between several ESCs and one CAN bus.

    ``outputs`` are sent besides the messages of the layout. Each of the two may be empty.
    """

    is_recorded = False
    """True where each call is to be known (capture/recorded_gateway.py)."""

    def __init__(
        self,
        escs: Sequence[EscSettings],
        layout: Layout,
        now: int,
        silent_on_loss: bool = False,
        outputs: Sequence[OutputMaker] = (),
    ) -> None:
        self.core: Core
        self.why_python: str
        """Why the core is the one in Python; empty with the one in C."""
        slots = sum([maker.slots for maker in outputs])
        self.core, self.why_python = make_core(escs, layout, now, silent_on_loss, slots)
        self.layout = layout.fingerprint if layout.messages else None
        """Of the messages, as it stands in a DBC that `dbc -c` writes; None without messages."""
        self.escs, self.status = self.core.escs, self.core.status
        self.outputs = tuple([maker.make(self.core, now) for maker in outputs])
        self.output_frames: list[CanFrame] = []
        """Frames of all outputs, oldest first."""
        for output in self.outputs:
            self.output_frames += output.frames
            output.frames = self.output_frames
        self.has_outputs = bool(self.outputs)
        """False: nothing but the layout's messages is sent, and no id to receive ever changes."""
        self.core.followers = [Follower(each.events, each.on_event) for each in self.outputs]
        self.conflicts = IdConflicts(self.core.own_ids, self.outputs)
        self.node_outputs = [each for each in self.outputs if isinstance(each, NodeOutput)]
        self._being_saved: list[tuple[int, NodeOutput]] = []
        self._dropped = False

    @property
    def core_note(self) -> str:
        """Why the core is the one in Python, or is not all that runs; empty where it is the one in C alone."""
        return self.why_python or self.core.note

    def start(self, now: int, can_open: bool = True) -> None:
        """The runtime has opened what it could: run. Nodes boot when there is a bus that can hear it."""
        self.status.state = GatewayState.RUNNING
        self.core.repeat(now)
        for output in self.outputs:
            output.start(now, can_open)

    def stop(self, now: int) -> None:
        """The last word: a status that says the gateway is going."""
        self.status.state = GatewayState.STOPPING
        self.core.stop(now)
        for output in self.outputs:
            output.stop(now)

    def receive_bytes(self, esc: int, data: bytes, now: int, since: int) -> None:
        """Bytes of one ESC's UART, read at ``now``. ``since``: none of them had come by then (esc_stream.py, Arrival)."""
        self.core.receive(esc, data, now, since)

    @property
    def receive_ids(self) -> frozenset[int]:
        """The ids (29-bit ones with EXTENDED), and blocks of ids, of the frames that ``receive_frame`` is to be given.

        The same object until they change.

        Those that the outputs listen to, and those that only this gateway sends with: another device that does is to be noticed.
        """
        return self.conflicts.receive_ids

    def receive_frame(self, frame: CanFrame, now: int, at: int) -> None:
        """A data frame of another device with one of ``receive_ids``, read at ``now``; it came ``at``."""
        if not frame.remote and self.conflicts.receive(frame.key, now):
            self.status.id_conflicts += 1
        takers = [output for output in self.outputs if output.receive_ids]
        if takers:
            self.core.expire(now)
        for output in takers:
            output.receive(frame, now, at)

    def can_opened(self, now: int) -> None:
        """The interface was opened (again): what we sent before may still come back, and is no conflict."""
        self.conflicts.can_opened(now)

    def receive_overrun(self, now: int) -> None:
        """The CAN controller lost received frames."""
        for output in self.outputs:
            output.overrun(now)

    def take_saves(self) -> list[tuple[int, bytes]]:
        """Parameters to store, (ESC, what), oldest first; each is answered by one call of ``saved`` for that ESC, in this order."""
        found = []
        for output in self.node_outputs:
            if output.saves:
                found += output.saves
                self._being_saved += [(esc, output) for esc, _ in output.saves]
                output.saves = []
        return found

    def take_rejected_parameters(self) -> list[tuple[int, int]]:
        """Stored values that were rejected at a node's reset: (ESC, index << 8 | sub-index)."""
        found = []
        for output in self.node_outputs:
            found += output.take_rejected_parameters()
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
        for output in self.node_outputs:
            output.parameters_damaged(esc, now)

    def port(self, esc: int, is_open: bool, now: int) -> None:
        """An ESC's port is open (again), or cannot be used: its values are not available from now on."""
        self.core.port(esc, is_open, now)

    def can_returned(self, now: int) -> None:
        """Frames can be sent again after some were lost: say everything that has no cycle once more."""
        self.core.expire(now)
        self.core.repeat(now)
        for output in self.outputs:
            output.can_returned(now)

    def held_up(self, now: int, dropped: bool) -> None:
        """The process was held up. Commands that waited are obeyed, SYNCs that waited are not answered any more.

        ``dropped``: measurements that waited to be sent were dropped: they are made anew with the next ``advance``, of what came by then.
        """
        self.core.expire(now)
        self._dropped = dropped
        for output in self.outputs:
            output.held_up(now)

    def set_can_state(self, state: CanState, now: int) -> None:
        """What the runtime knows of the CAN controller."""
        self.core.expire(now)
        before, self.status.can_state = self.status.can_state, state
        if state is not before:
            self.core.gateway_changed(now)
            if before is CanState.BUS_OFF and state is not CanState.DOWN:
                self.core.repeat(now)  # what was handed over meanwhile never reached the bus
        for output in self.outputs:
            output.on_can_state(before, state, now)

    def advance(self, now: int, with_core: bool = True) -> None:
        """Let time pass: time-outs, cyclic messages."""
        if with_core:
            self.core.advance(now)
        self.conflicts.advance(now)
        if self._dropped:
            self._dropped = False
            self.core.repeat(now)
            for output in self.outputs:
                output.repeat_measurements(now)
        for output in self.outputs:
            output.advance(now)

    def next_deadline(self, with_core: bool = True) -> int:
        """When ``advance`` is to be called at the latest."""
        due = self.core.next_deadline() if with_core else NEVER
        due = min(due, self.conflicts.next_deadline())
        for output in self.outputs:
            due = min(due, output.next_deadline())
        return due

    @property
    def frames_wait(self) -> bool:
        """True while ``take_frames`` has something to do."""
        return bool(self.output_frames) or self.core.is_pending

    def take_frames(self, now: int) -> list[CanFrame]:
        """The frames to send: the outputs' frames, oldest first, then the core's due frames, packed with current values."""
        frames = self.core.take(now)
        if self.output_frames:
            frames = self.output_frames + frames
            self.output_frames.clear()
        return frames

    def not_sent(self, now: int) -> None:
        """The frames that were taken last were thrown away. The gateway itself need not know; who records it does."""

    def take_link_changes(self) -> list[int]:
        """ESCs whose link state, layout or device changed since the last call."""
        changes = self.core.link_changes
        if changes:
            self.core.link_changes = []
        return changes

    @property
    def revision(self) -> int:
        """A number that grows with each change of an output that the runtime has to follow."""
        return sum([output.revision for output in self.outputs])

    def node_states(self) -> list[NodeState]:
        """Return the state of each ESC's node. The list is empty without nodes."""
        states = []
        for output in self.node_outputs:
            states += output.node_states()
        return states
