"""The interface of the core, which turns bytes of ESCs and time into CAN frames and deadlines.

There are two implementations with the same behaviour: ``core.python_core.PythonCore`` and, in C,
``native.core.NativeCore``. A core holds the telemetry of each ESC, the messages of a layout and
their schedule. ``receive`` decodes and marks messages as pending, ``advance`` lets cycles and
timeouts pass, and ``take`` packs the pending messages. ``now`` is integer nanoseconds of one
monotonic clock.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

from kontronik_can_gw.core.output import OutputHost
from kontronik_can_gw.frames import CanFrame

OnEvent = Callable[[int, int, int], None]
"""Takes the ESC, bits of ``telemetry.Event``, and the time."""


class Follower(NamedTuple):
    """A function that is called as soon as at least one of ``events`` occurs."""

    events: int
    on_event: OnEvent


class SchedulePosition(NamedTuple):
    """The state of a message that a replay cannot compute if it begins later. Times are in ns."""

    alive: int
    page: int
    """Index of the next group."""
    sent_ns: int
    """Time of the last frame. -1: none was sent."""
    deferred_until: int
    """Time until which the next frame is deferred. -1: it is not."""
    cycle_deferred: int
    """1 if the deferred frame is the one of a cycle."""


class Core(OutputHost, Protocol):
    """All that the gateway uses of a core. Calls must be in the order of their times."""

    language: str
    """``Python`` or ``C``."""
    note: str
    """The reason why Python works on live frames, or "" if only the core in C does."""
    followers: Sequence[Follower]
    link_changes: list[int]
    """ESCs whose link state, layout or device changed. The owner empties the list."""

    # --- ESCs

    def receive(
        self,
        esc: int,
        data: bytes,
        now: int,
        since: int,
    ) -> None:
        """Take bytes of one ESC that were read at ``now``.

        ``since`` is a time at which none of these bytes had arrived yet. Their age counts from it
        (``core/esc_stream.py``, Arrival).
        """

    def port(self, esc: int, is_open: bool, now: int) -> None:
        """Follow an ESC's port that was opened or lost. In both cases its values are dropped."""

    # --- a replay that begins later in a run

    def places(self) -> list[SchedulePosition]:
        """Return the place of each message in its schedule."""

    def adopt_places(self, places: Sequence[Sequence[int]]) -> None:
        """Continue from these places.

        Call it also after the windows of ESCs were set, because deadlines change with them.
        """

    # --- time

    def expire(self, now: int) -> None:
        """Drop expired values."""

    def advance(self, now: int) -> None:
        """Let time pass: drop expired values, and mark messages and slots whose cycle is due.

        Quiet mode begins when no ESC has been heard for the configured time. The messages with
        values of the gateway are sent for the last time then, and nothing else becomes pending
        (``status.is_quiet``). Live data of any ESC end it. Both changes are reported as
        ``Event.QUIET``.
        """

    def next_deadline(self) -> int:
        """Return the time at which ``advance`` must be called. Earlier calls do no harm."""

    # --- messages

    def gateway_changed(self, now: int) -> None:
        """Mark the messages that follow changes of ``status``."""

    def repeat(self, now: int) -> None:
        """Mark every message without a cycle.

        So no receiver keeps values from before a restart or an outage.
        """

    def stop(self, now: int) -> None:
        """Mark the messages with values of the gateway, all groups, without minimum delay times."""

    @property
    def is_pending(self) -> bool:
        """True while ``take`` has something to do."""

    def take(self, now: int) -> list[CanFrame]:
        """Return the frames of pending slots and messages, packed with current values.

        Slots are first. Both are in the order in which they became due.
        """

    def take_oldest(self, now: int) -> list[CanFrame]:
        """Return the frames of the slot or message that became due first.

        The list is empty if it has nothing to send, for example because its value did not change.
        """
