"""Replays a capture through the gateway's core.

The result is the CAN frames that the recorded gateway sent, each at its time. The same core is used
as in a live run, with the recorded times. So frames and times are identical to the live run if no
entry is missing. Nothing waits or is sent.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from kontronik_can_gw.capture.calls import CALL_OF, RecordedCall
from kontronik_can_gw.capture.format import (
    RECORDED_COUNTERS,
    SETTLE_NS,
    VERSION,
    Entry,
    EntryKind,
    read_json,
    read_numbers,
)
from kontronik_can_gw.capture.limits import COUNTERS_OF_ESC, check_counters, check_state, check_time
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.gateway.transmit_queue import TransmitQueue
from kontronik_can_gw.status import CanState, GatewayState


class TimedFrame(NamedTuple):
    """A CAN frame with its time. ``received`` is False if the gateway sent it."""

    time_ns: int
    frame: CanFrame
    received: bool = False


class Replay:
    """Plays entries on a gateway.

    ``marked``: the gateway's state on the bus is REPLAY instead of RUNNING. ``state``: the counters
    in the header. If the beginning of the run is missing (no START entry), the gateway starts with
    the first ADVANCE entry and adopts the STATE entries of the next seconds (SETTLE_NS). After them
    the messages equal the live ones. ``version``: the version of the capture's format. A gateway
    that wrote version 1 did not count a lost port as a loss of telemetry, so its replay does not
    either.
    """

    def __init__(
        self,
        gateway: Gateway,
        state: Mapping[str, Any] | None = None,
        marked: bool = False,
        version: int = VERSION,
    ) -> None:
        self.gateway = gateway
        self.lost = 0
        """Number of entries that the recorder could not record."""
        self.rejected = 0
        """Number of entries that are invalid."""
        self._marked = marked
        self._counts_lost_ports = version > 1
        self._waiting = TransmitQueue()
        self._taken: list[TimedFrame] = []
        """Frames of the last iteration. The next entry shows if they were sent."""
        self._is_started = False
        self._adopt_until: int | None = None
        """While the beginning of the run is missing, STATE entries up to the first one after this
        time are adopted. Otherwise None.
        """
        self._adopt(state or {})

    def follow(self, entries: Iterable[Entry]) -> Iterator[TimedFrame]:
        """Yield the frames that were received and sent, in order."""
        for entry in entries:
            yield from self.play(entry)
        yield from self.finish()

    def play(self, entry: Entry) -> list[TimedFrame]:
        """Play one entry on the gateway.

        Returns the frames that were sent before it, and the frame that was received with it.
        """
        if entry.kind == EntryKind.NOT_SENT:
            self._taken = []
            return []
        found = self.finish()
        try:
            found += self._play(entry)
        except Exception:
            # the calls of a damaged or hostile capture may raise any exception
            self.rejected += 1
        return found

    @property
    def frames_wait(self) -> bool:
        """True while the next entry decides whether the frames of the last iteration were sent."""
        return bool(self._taken)

    def add_frames(self, taken: list[TimedFrame]) -> None:
        """Continue after a player. ``taken``: the frames of its last iteration on this gateway."""
        self._taken += taken

    def finish(self) -> list[TimedFrame]:
        """Return the frames of the last iteration. Must be called after the last entry."""
        found = self._taken
        self._taken = []
        return found

    def _play(self, entry: Entry) -> list[TimedFrame]:
        check_time(entry.time_ns)
        check_time(entry.came_ns)
        call = CALL_OF.get(EntryKind(entry.kind))
        if call is None:
            self._follow_note(entry)
            return []
        if not self._is_started and call.kind == EntryKind.ADVANCE:
            # The beginning of the run is missing.
            self._adopt_until = entry.time_ns + SETTLE_NS
            self._make_call(CALL_OF[EntryKind.START], (entry.time_ns, True))
        if call.kind == EntryKind.PORT_LOST and not self._counts_lost_ports:
            esc = self.gateway.escs[entry.esc]
            esc.losses -= int(esc.up)  # the call adds one
        arguments = call.encoding.read(entry)
        result = self._make_call(call, arguments)
        if call.takes_frames:
            self._collect_frames(entry.time_ns)
        if call.kind == EntryKind.FRAME:
            return [TimedFrame(entry.time_ns, arguments[0], True)]
        if isinstance(result, CanFrame):
            self.gateway.status.sent_frames += 1
            self._taken = [TimedFrame(entry.time_ns, result)]
        elif isinstance(result, list):
            self._add_taken(result, entry.time_ns)
        return []

    def _make_call(self, call: RecordedCall, arguments: tuple[Any, ...]) -> object:
        """Make a recorded call. Returns its result: frames that were sent, or None."""
        result: object = getattr(self.gateway, call.method)(*arguments)
        if call.kind == EntryKind.START:
            self._is_started = True
            if self._marked:
                self.gateway.status.state = GatewayState.REPLAY
        return result

    def _follow_note(self, entry: Entry) -> None:
        """Follow an entry that is not a call."""
        match entry.kind:
            case EntryKind.COUNTERS:
                counters = read_numbers(entry.data)
                check_counters(counters)
                self._adopt_counters(counters)
            case EntryKind.LINE_ERRORS:
                (self.gateway.escs[entry.esc].line_errors,) = read_numbers(entry.data)
            case EntryKind.LOST:
                self.lost += sum(read_numbers(entry.data))
            case EntryKind.STATE if self._adopt_until is not None:
                state = read_json(entry.data)
                check_state(state)
                self._adopt(state)
                if entry.time_ns >= self._adopt_until:
                    self._adopt_until = None

    def _collect_frames(self, now: int) -> None:
        gateway = self.gateway
        gateway.take_saves()  # otherwise the list would grow
        self._add_taken(gateway.take_frames(now), now)
        gateway.take_link_changes()
        gateway.take_rejected_parameters()
        gateway.conflicts.take()

    def _add_taken(self, taken: list[CanFrame], now: int) -> None:
        frames = in_order(taken, self._waiting)
        self.gateway.status.sent_frames += len(frames)
        self._taken = [TimedFrame(now, frame) for frame in frames]

    def _adopt(self, state: Mapping[str, Any]) -> None:
        """Adopt the counters from before the recording began."""
        states = state.get("escs", ())
        for esc, found in zip(self.gateway.escs, states, strict=False):
            for name, (attribute, _) in COUNTERS_OF_ESC.items():
                setattr(esc, attribute, found.get(name, 0))
            if "counters" in found:
                esc.adopt_stream_state(found["counters"], found["held"], found["window"])
        gateway = self.gateway
        gateway.core.adopt_places(state.get("messages", ()))
        self._adopt_counters(state.get("counters", ()))
        status = gateway.status
        status.started_ns = state.get("started_ns", status.started_ns)
        status.heard_ns = state.get("heard_ns", status.heard_ns)
        status.can_state = CanState(state.get("can_state", status.can_state))
        gateway.is_held |= bool(state.get("is_held"))
        gateway.is_limited |= bool(state.get("is_limited"))

    def _adopt_counters(self, counters: Sequence[int]) -> None:
        for name, counter in zip(RECORDED_COUNTERS, counters, strict=False):
            setattr(self.gateway.status, name, counter)


def in_order(frames: list[CanFrame], waiting: TransmitQueue) -> list[CanFrame]:
    """Return the frames of one iteration in the order in which they are passed to the interface.

    ``waiting`` is the transmit queue, the same one for each iteration.
    """
    waiting.put_all(frames)
    return waiting.take_all()
