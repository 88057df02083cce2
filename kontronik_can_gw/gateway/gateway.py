"""The core together with its outputs. The runtime uses nothing else of them.

Bytes, received CAN frames and time go in. CAN frames to send and the next deadline come out.
``now`` is integer nanoseconds of one monotonic clock: of the loop, or of a capture in a replay.
"""

from collections.abc import Sequence
from dataclasses import replace

from kontronik_can_gw.core.interface import Follower, OnEvent
from kontronik_can_gw.core.output import NodeOutput, NodeState
from kontronik_can_gw.core.output_setup import OutputMaker
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.esc.telemetry import Event
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.frame_source import FrameSource
from kontronik_can_gw.gateway.id_conflicts import IdConflicts
from kontronik_can_gw.native.load import make_core
from kontronik_can_gw.status import CanState, GatewayState
from kontronik_can_gw.times import NEVER


class Gateway(FrameSource):
    """One gateway between several ESCs and one CAN bus.

    It sends the messages of the layout and the frames of ``outputs``. Each of the two may be empty.
    """

    is_recorded = False
    """True if each call is recorded (``capture/recorded_gateway.py``)."""

    def __init__(
        self,
        settings: CoreSettings,
        now: int,
        outputs: Sequence[OutputMaker] = (),
    ) -> None:
        layout = settings.layout
        slots = sum([maker.slots for maker in outputs])
        core = make_core(replace(settings, slots=slots), now)
        super().__init__(core, tuple([maker.make(core, now) for maker in outputs]), layout)
        self.layout = layout.fingerprint if layout.messages else None
        """The fingerprint of the messages, as in a DBC of ``dbc -c``. None without messages."""
        self.escs = self.core.escs
        self.status = self.core.status
        self.node_outputs = [each for each in self.outputs if isinstance(each, NodeOutput)]
        self.core.followers = [
            *[Follower(each.events, each.on_event) for each in self.outputs],
            Follower(Event.QUIET, _quiet_follower(self)),
        ]
        self.conflicts = IdConflicts(self.core.own_ids, self.outputs)
        self._being_saved: list[tuple[int, NodeOutput]] = []

    # --- start and end

    def start(self, now: int, can_open: bool = True) -> None:
        """Begin to send. Nodes boot when the CAN interface is open."""
        self.status.state = GatewayState.RUNNING
        self.core.repeat(now)
        for output in self.outputs:
            output.start(now, can_open)

    def stop(self, now: int) -> None:
        """Send a final status that reports the shutdown."""
        self.status.state = GatewayState.STOPPING
        self.core.stop(now)
        for output in self.outputs:
            output.stop(now)

    # --- ESCs

    def receive_bytes(
        self,
        esc: int,
        data: bytes,
        now: int,
        since: int,
    ) -> None:
        """Take bytes of one ESC that were read at ``now``. See ``Core.receive`` for ``since``."""
        self.core.receive(esc, data, now, since)

    def port(self, esc: int, is_open: bool, now: int) -> None:
        """Follow an ESC's port that was opened or lost. In both cases its values are dropped."""
        self.core.port(esc, is_open, now)

    def take_link_changes(self) -> list[int]:
        """Return the ESCs whose link state, layout or device changed since the last call."""
        changes = self.core.link_changes
        self.core.link_changes = []
        return changes

    # --- received frames

    @property
    def receive_ids(self) -> frozenset[int]:
        """The CAN ids and blocks of ids of the frames that ``receive_frame`` needs.

        Outputs listen to some of them. The others are own ids, so that another device that sends
        with them is noticed. 29-bit ids contain ``EXTENDED``. The object stays the same until the
        ids change.
        """
        return self.conflicts.receive_ids

    def receive_frame(self, frame: CanFrame, now: int, at: int) -> None:
        """Take a frame of another device that was read at ``now`` and arrived ``at``."""
        if not frame.remote and self.conflicts.receive(frame.key, now):
            self.status.id_conflicts += 1
        takers = [output for output in self.outputs if output.receive_ids]
        if takers:
            self.core.expire(now)
        for output in takers:
            output.receive(frame, now, at)

    # --- the CAN interface

    def can_opened(self, now: int) -> None:
        """Follow an interface that was opened. It may still return our own earlier frames."""
        self.conflicts.can_opened(now)

    def receive_overrun(self, now: int) -> None:
        """Follow a loss of received frames in the CAN controller."""
        for output in self.outputs:
            output.overrun(now)

    def set_can_state(self, state: CanState, now: int) -> None:
        """Follow the state of the CAN controller."""
        self.core.expire(now)
        before = self.status.can_state
        self.status.can_state = state
        if state is not before:
            self.core.gateway_changed(now)
            if before is CanState.BUS_OFF and state is not CanState.DOWN:
                # Frames that were handed over during bus-off never reached the bus.
                self.core.repeat(now)
        for output in self.outputs:
            output.on_can_state(before, state, now)

    # --- parameters of nodes

    def take_saves(self) -> list[tuple[int, bytes]]:
        """Return parameters to store, as pairs of ESC and content, oldest first.

        The caller must answer each of them with ``saved``, for one ESC in this order.
        """
        found = []
        for output in self.node_outputs:
            if output.saves:
                found += output.saves
                self._being_saved += [(esc, output) for esc, _ in output.saves]
                output.saves = []
        return found

    def saved(self, esc: int, error: str | None, now: int) -> None:
        """Follow the end of the oldest save of an ESC. ``error`` is the reason if it failed."""
        for number, (of_esc, output) in enumerate(self._being_saved):
            if of_esc == esc:
                del self._being_saved[number]
                output.saved(esc, error, now)
                break

    def take_rejected_parameters(self) -> list[tuple[int, int]]:
        """Return the stored values that resets rejected since the last call.

        A value is a pair of ESC and index << 8 | sub-index.
        """
        found = []
        for output in self.node_outputs:
            found += output.take_rejected_parameters()
        return found

    def parameters_damaged(self, esc: int, now: int) -> None:
        """Let an ESC's node report that its stored parameters could not be read."""
        for output in self.node_outputs:
            output.parameters_damaged(esc, now)

    def node_states(self) -> list[NodeState]:
        """Return the state of each ESC's node. The list is empty without nodes."""
        states = []
        for output in self.node_outputs:
            states += output.node_states()
        return states

    @property
    def revision(self) -> int:
        """A number that grows with each change of an output that the runtime has to follow."""
        return sum([output.revision for output in self.outputs])

    # --- time

    def held_up(self, now: int, dropped: bool) -> None:
        """Follow a suspension of the process that ended at ``now``.

        Commands that waited are obeyed, SYNCs that waited are not answered. ``dropped`` means that
        waiting measurements were discarded. The next ``advance`` sends them again with the values
        known by then.
        """
        self.core.expire(now)
        self._has_discarded = dropped
        for output in self.outputs:
            output.held_up(now)

    def advance(self, now: int, with_core: bool = True) -> None:
        """Let time pass: timeouts and cyclic messages.

        ``with_core`` is False if the core in C has advanced by itself.
        """
        if with_core:
            self.core.advance(now)
        if now >= self.conflicts.due:
            self.conflicts.advance(now)
        if self._has_discarded:
            self._has_discarded = False
            self.core.repeat(now)
            for output in self.outputs:
                output.repeat_measurements(now)
        for output in self.outputs:
            output.advance(now)

    def next_deadline(self, with_core: bool = True) -> int:
        """Return the time at which ``advance`` must be called. Earlier calls do no harm."""
        due = self.core.next_deadline() if with_core else NEVER
        due = min(due, self.conflicts.due)
        for output in self.outputs:
            due = min(due, output.next_deadline())
        return due


def _quiet_follower(gateway: Gateway) -> OnEvent:
    """Return the function that follows the begin and the end of the core's quiet mode.

    After quiet mode, everything is sent as after an outage. So frames are held until ``release``.
    """

    def follow(_esc: int, _events: int, now: int) -> None:
        is_quiet = bool(gateway.status.is_quiet)
        for output in gateway.outputs:
            output.set_quiet(is_quiet, now)
        if not is_quiet:
            gateway.is_held = True

    return follow
