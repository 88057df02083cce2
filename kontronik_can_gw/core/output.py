"""The seam of an output: events of the ESCs and time go in, CAN frames come out.

The gateway holds its outputs in a tuple and treats all of them alike. An output overrides the
calls that concern it. The others do nothing. ``now`` is integer nanoseconds of one monotonic clock.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from kontronik_can_gw.core.slots import Slot
from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry, Event
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.status import CanState, GatewayStatus, NmtState
from kontronik_can_gw.times import NEVER

NO_IDS: frozenset[int] = frozenset()


class Owner(NamedTuple):
    """The user of a CAN id."""

    esc: int | None
    """The ESC whose node sends with the id, or the first ESC of that node. None without a node."""
    what: str
    """A description for messages, such as "message Voltages"."""


class OutputHost(Protocol):
    """The part of the core that an output may use."""

    @property
    def escs(self) -> Sequence[EscTelemetry]:
        """The state of each ESC."""

    @property
    def status(self) -> GatewayStatus:
        """The gateway's own values.

        The runtime writes the values of the CAN interface. Messages with them follow at their next
        cycle, or at once after ``Core.gateway_changed``.
        """

    @property
    def own_ids(self) -> Mapping[int, Owner]:
        """The ids of the messages. 29-bit ids contain ``EXTENDED``."""

    def slot(self, esc: int) -> Slot:
        """Return a new slot of an ESC, from which the core sends measurements itself."""

    def apply(self, esc: int, settings: EscSettings) -> None:
        """Give an ESC other settings."""


class LogLine(NamedTuple):
    """A line for the log. Lines with one subject are counted together if they are frequent."""

    subject: str
    text: str


class Output:
    """One way onto the bus.

    An output appends its frames to ``frames``, oldest first, and the gateway empties the list. All
    outputs of a gateway share this list, so that their frames keep their order. An output must
    not replace it.
    """

    name = ""
    """The key of ``facts`` in the status document."""
    events = Event.ALL
    """``on_event`` is called if at least one of these occurred. Fewer interrupt the core less."""

    def __init__(self) -> None:
        self.frames: list[CanFrame] = []
        self.revision = 0
        """Grows with each change, except for ``frames``, that the runtime has to follow.

        Such changes are ``receive_ids``, ``own_ids``, lines for the log, and those of a
        ``NodeOutput``.
        """
        self._receive_ids = NO_IDS

    @property
    def receive_ids(self) -> frozenset[int]:
        """The CAN ids and blocks of ids (``frames.id_block``) that ``receive`` needs.

        29-bit ids contain ``EXTENDED``. Setting them increases ``revision``.
        """
        return self._receive_ids

    @receive_ids.setter
    def receive_ids(self, ids: frozenset[int]) -> None:
        self._receive_ids = ids
        self.revision += 1

    def own_ids(self) -> Mapping[int, Owner]:
        """Return the ids and blocks of ids that only this output may send with."""
        return {}

    def facts(self) -> dict[str, Any]:
        """Return the output's part of the status document, or an empty one.

        ``lines`` are shown to people.
        """
        return {}

    def take_news(self) -> list[LogLine]:
        """Return the lines for the log since the last call."""
        return []

    def next_deadline(self) -> int:
        """Return the time at which ``advance`` must be called. Earlier calls do no harm."""
        return NEVER

    # --- calls of the gateway

    def start(self, now: int, can_open: bool) -> None:
        """Begin to send. ``can_open`` is True if the CAN interface is open."""

    def stop(self, now: int) -> None:
        """Send the last frames, because the gateway ends."""

    def on_event(self, esc: int, events: int, now: int) -> None:
        """Follow a change of an ESC. ``events`` are bits of ``telemetry.Event``."""

    def on_can_state(self, before: CanState, state: CanState, now: int) -> None:
        """Follow the state of the CAN controller. DOWN may be followed by DOWN."""

    def hold(self, now: int) -> None:
        """Make no frames except answers until ``can_returned``, because no frame may leave.

        Frames of earlier calls that were not sent are discarded. The call may be repeated.
        """

    def can_returned(self, now: int, has_lost_frames: bool = False) -> None:
        """Follow an interface that takes frames again after a loss, or for the first time.

        ``has_lost_frames`` is True if frames that outputs made during the outage were discarded.
        Only a gateway that was never held, and replays of captures of earlier versions, need it.
        """

    def first_frame(self, now: int) -> CanFrame | None:  # noqa: ARG002  see DroneCAN
        """Return a frame without measurements as the first one after an outage, or None.

        Another call asks for a further frame, because the last one has not left the interface.
        """
        return None

    def set_quiet(self, is_quiet: bool, now: int) -> None:
        """Begin or end quiet mode. Outputs only answer requests then.

        Slots rest by themselves. All other calls continue, also ``can_returned``, but no frame
        except an answer may be made, and no deadline returned for one. When quiet mode ends,
        ``can_returned`` follows as soon as the bus works.
        """

    def held_up(self, now: int) -> None:
        """Follow a suspension of the process that ended at ``now``."""

    def repeat_measurements(self, now: int) -> None:
        """Send measurements again, because those that waited to be sent were discarded."""

    def advance(self, now: int) -> None:
        """Let time pass."""

    def receive(self, frame: CanFrame, now: int, at: int) -> None:
        """Take a frame that arrived from the bus at ``at``.

        Every output with ``receive_ids`` gets every received frame, and must check its id.
        """

    def collision(self, esc: int, present: bool, now: int) -> None:
        """Follow another device that begins or stops to send with an id of this ESC's node."""

    def overrun(self, now: int) -> None:
        """Follow a loss of received frames in the CAN controller."""


class NodeState(NamedTuple):
    """The state of one ESC's node."""

    node_id: int
    """1..127, or 255 for a node that waits for one."""
    state: NmtState
    sent: int
    """Number of frames with measurements so far."""


class NodeOutput(Output):
    """An output with a node for each ESC, whose parameters a master can change and store."""

    node_title = "node"
    """The words before a node-ID, for example "CANopen node"."""

    def __init__(self) -> None:
        super().__init__()
        self.saves: list[tuple[int, bytes]] = []
        """Parameters to store, as pairs of ESC and content. The gateway empties the list.

        ``saved`` answers each of them, for one ESC in this order.
        """

    def save(self, esc: int, content: bytes) -> None:
        """Ask the runtime to store the parameters of an ESC's node."""
        self.saves.append((esc, content))
        self.revision += 1

    def saved(self, esc: int, error: str | None, now: int) -> None:
        """Follow the end of the oldest save of this ESC. ``error`` is the reason if it failed."""

    def parameters_damaged(self, esc: int, now: int) -> None:
        """Report that the stored parameters of an ESC could not be read."""

    def node_states(self) -> list[NodeState]:
        """Return the state of each ESC's node."""
        return []

    def take_rejected_parameters(self) -> list[tuple[int, int]]:
        """Return the stored values that resets rejected since the last call.

        A value is a pair of ESC and index << 8 | sub-index.
        """
        return []
