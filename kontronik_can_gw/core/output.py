"""The seam of an output: what turns events of the ESCs and time into CAN frames, and takes frames from the bus.

The gateway holds its outputs in a tuple and treats all alike. An output overrides what concerns it; everything else does nothing. ``now``
is integer nanoseconds of one monotonic clock.
"""

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any, NamedTuple, Protocol

from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry, Event
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.status import CanState, GatewayStatus
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


class Given(NamedTuple):
    """What an output is made from, besides the ESCs: what a capture holds of it."""

    table: Any
    """Its table of the configuration."""
    identity: bytes
    """A digest of what identifies this machine; empty where there is nothing."""
    version: tuple[int, int]
    """Of the program: major and minor."""
    seed: int
    """A random number of 64 bits, of this start."""


class OutputSetup(Protocol):
    """An output that can be made, and what is to be known of it before."""

    @property
    def name(self) -> str:
        """As in OUTPUTS."""

    @property
    def title(self) -> str:
        """What they are, in a sentence."""

    @property
    def given(self) -> Given:
        """What it is made from."""

    def make(self, escs: Sequence[EscTelemetry], gateway: GatewayStatus, now: int) -> Output:
        """The output as it is at the start."""

    def taken_ids(self) -> Mapping[int, str]:
        """The ids and blocks of ids that no message may have, and what has them."""

    def traffic(self) -> tuple[float, float]:
        """Frames and bits a second to be expected, with the most stuffing."""

    def warnings(self, bitrate: int) -> list[str]:
        """What may not work as it is meant, on a bus with this bit rate."""

    def summary(self) -> list[str]:
        """What ``check`` shows, in short: lines of up to 78 characters that begin with the output's name in 10 columns."""

    def lines(self) -> list[str]:
        """What ``check --json`` has: facts a line each."""


OUTPUTS = ("dronecan",)
"""The outputs besides DBC and CANopen: each is a folder, loaded only where it is enabled.

Its module ``setup`` has ``configured``, which makes an OutputSetup; its table of the configuration has its name and a key ``enabled``.
"""


def setup_of(name: str, given: Given, escs: Sequence[EscSettings]) -> OutputSetup:
    """The setup of the output with this name. UserError with the mistakes in its table."""
    setup: OutputSetup = import_module(f"{__package__}.{name}.setup").configured(given, escs)
    return setup
