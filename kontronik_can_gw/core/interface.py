"""The interface of the core: bytes of ESCs and time go in, CAN frames and deadlines come out.

There are two implementations with the same behaviour: ``core.python_core.PythonCore`` and, in C,
``native.core.NativeCore``. A core holds the telemetry of each ESC, the messages of a layout and their
schedule. ``receive`` decodes and marks messages as pending, ``advance`` lets cycles and timeouts
pass, and ``take`` packs the pending messages. ``now`` is integer nanoseconds of one monotonic clock.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol

from kontronik_can_gw.core.output import Owner
from kontronik_can_gw.core.slots import Slot
from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.status import GatewayStatus

OnEvent = Callable[[int, int, int], None]
"""ESC, bits of telemetry.Event, time."""


class Follower(NamedTuple):
    """``on_event`` is given what happens, as it happens, with at least one of ``events``."""

    events: int
    on_event: OnEvent


class Core(Protocol):
    """The seam of the core: what the gateway asks of it. In Python it is PythonCore, in C native.core.NativeCore."""

    language: str
    """``Python`` or ``C``."""
    note: str
    """What live frames need Python for although the core is in C, in words; empty: nothing."""

    @property
    def escs(self) -> Sequence[EscTelemetry]:
        """The state of each ESC."""

    @property
    def status(self) -> GatewayStatus:
        """The gateway's own values; the runtime writes the CAN side, then ``gateway_changed`` where that cannot wait."""

    @property
    def own_ids(self) -> Mapping[int, Owner]:
        """The ids of the messages (29-bit ones with EXTENDED), and what for."""

    followers: Sequence[Follower]
    link_changes: list[int]
    """ESCs whose link state, layout or device changed; the owner empties it."""
    shortest_timeout_ns: int
    """Of all ESCs: live data of one is not available after this."""

    def receive(self, esc: int, data: bytes, now: int, since: int) -> None:
        """Bytes of one ESC's UART, read at ``now``. ``since``: none of them had come by then (esc_stream.py, Arrival)."""

    def port(self, esc: int, is_open: bool, now: int) -> None:
        """An ESC's port was opened (again), or cannot be used: its values are not available from now on."""

    def apply(self, esc: int, settings: EscSettings) -> None:
        """Other settings of an ESC from now on."""

    def slot(self, esc: int) -> Slot:
        """A further slot of an ESC."""

    def expire(self, now: int) -> None:
        """What is too old by now goes."""

    def advance(self, now: int) -> None:
        """Let time pass: time-outs, cyclic messages."""

    def next_deadline(self) -> int:
        """When ``advance`` is to be called at the latest."""

    def gateway_changed(self, now: int) -> None:
        """``status`` has changed: messages that hold it follow."""

    def repeat(self, now: int) -> None:
        """Send every message that has no cycle once, so that nobody goes on with values from before a restart or an outage."""

    def stop(self, now: int) -> None:
        """What the gateway says of itself goes out once more, all pages at once, without regard to minimum distances."""

    @property
    def is_pending(self) -> bool:
        """True while ``take`` has something to do."""

    def take(self, now: int) -> list[CanFrame]:
        """The frames of what is due, with the values of now: slots, then messages, each in the order in which they became due."""
