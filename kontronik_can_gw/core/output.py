"""The seam of an output: what turns events of the ESCs and time into CAN frames, and takes frames from the bus.

The gateway holds its outputs in a tuple and treats all alike. An output overrides what concerns it; everything else does nothing. ``now``
is integer nanoseconds of one monotonic clock.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from kontronik_can_gw.esc.telemetry import Event
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.status import CanState
from kontronik_can_gw.times import NEVER

NO_IDS: frozenset[int] = frozenset()
SLOTS = 4
"""Slots that an output may have for each ESC and be sent by the core in C; further ones are sent in Python."""


class Owner(NamedTuple):
    """What sends with an id: ``esc`` is the ESC whose node it is, the first of several; None: no node."""

    esc: int | None
    what: str


class Output:
    """One way onto the bus. Frames are appended to ``frames``, oldest first; the owner empties it.

    All outputs of a gateway share one list, so that their frames keep their order. Do not replace it.
    """

    name = ""
    """Of what ``facts`` says."""
    events = Event.ALL
    """What ``on_event`` is given: with at least one of these. The fewer, the less the core is interrupted."""

    def __init__(self) -> None:
        self.frames: list[CanFrame] = []
        self.receive_ids: frozenset[int] = NO_IDS
        """The ids (29-bit ones with EXTENDED) and blocks of ids (frames.id_block) that ``receive`` is to be given.

        The same object until they or ``own_ids`` change.
        """
        self.saves: list[tuple[int, Any]] = []
        """(ESC, parameters) to store; the owner empties it and answers each by ``saved``, in this order."""
        self.rejected_parameters: list[tuple[int, int]] = []
        """(ESC, index << 8 | sub-index) of stored values that were rejected at a reset; the owner empties it."""
        self.state_changes = 0
        """Grows with each change of a node's state or node-ID."""
        self.news: list[str] = []
        """What is to be logged of such a change; the owner empties it."""

    @property
    def marks(self) -> tuple[object, ...]:
        """Others where something has changed that the runtime follows, but for ``frames``."""
        ids, changes = self.receive_ids, self.state_changes
        # ids of the same content may be others; as long as they are held, nothing else has their address
        return id(ids), changes, len(self.saves), len(self.rejected_parameters), ids

    def own_ids(self) -> Mapping[int, Owner]:
        """The ids, and blocks of ids, that only this output sends with, and what for."""
        return {}

    def facts(self) -> dict[str, Any]:
        """What is to be known of this output, as JSON; ``lines`` are for people. Empty: nothing."""
        return {}

    def node_states(self) -> list[tuple[int, Any, int]]:
        """Of each ESC's node: node-ID, state, frames with measurements so far. Empty without nodes."""
        return []

    def next_deadline(self) -> int:
        """When ``advance`` is to be called at the latest."""
        return NEVER

    # --- what happens

    def take_slots(self, slot: Callable[[int], Any]) -> None:
        """The gateway is made. ``slot`` gives a further slot of the core (slots.Slot) of an ESC, for frames that need no Python."""

    def start(self, now: int, can_open: bool) -> None:
        """The gateway runs. ``can_open``: there is a bus that can hear it."""

    def stop(self, now: int) -> None:
        """The gateway is about to end."""

    def on_event(self, esc: int, events: int, now: int) -> None:
        """Something of an ESC changed: bits of telemetry.Event."""

    def on_can_state(self, before: CanState, state: CanState, now: int) -> None:
        """The CAN controller's state, as the runtime knows it; DOWN may be followed by DOWN."""

    def can_returned(self, now: int) -> None:
        """Frames can be sent again after some were lost, or for the first time."""

    def held_up(self, now: int) -> None:
        """The process was held up until ``now``."""

    def make_anew(self, now: int) -> None:
        """Measurements that waited to be sent were dropped."""

    def advance(self, now: int) -> None:
        """Let time pass."""

    def receive(self, frame: CanFrame, now: int, at: int) -> None:
        """A frame from the bus, which came ``at``; it may be none of ``receive_ids``."""

    def collision(self, esc: int, present: bool, now: int) -> None:
        """Another device begins, or has ceased, to send with an id of this ESC's node."""

    def overrun(self, now: int) -> None:
        """The CAN controller lost received frames."""

    def saved(self, esc: int, error: str | None, now: int) -> None:
        """The oldest of ``saves`` of this ESC is on disk, or could not be stored and why."""

    def parameters_damaged(self, esc: int, now: int) -> None:
        """What was stored for an ESC could not be read."""
