"""A gateway that passes all its calls to a recorder.

A replay of the calls in their order gives the same frames (capture/replay.py).
"""

from collections.abc import Callable, Iterable
from operator import attrgetter
from typing import Any

from kontronik_can_gw.capture.format import COUNTERS, EntryKind, frame_data, numbers_data
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.status import CanState, GatewayStatus

Put = Callable[[int, int, int, bytes, int, int | None], None]
"""A function with the fields of ``Entry``: time, kind, ESC's index, data, flags, arrival."""


_counters_of: Callable[[GatewayStatus], tuple[int, ...]] = attrgetter(*COUNTERS)
Call = tuple[int, int, int, bytes, int | None]
"""Time, kind, ESC's index, data, arrival."""


class RecordedGateway(Gateway):
    """A gateway that records its calls.

    The runtime also changes the counters of ``status`` and the line errors. These changes are
    recorded with the next call.
    """

    is_recorded = True

    def __init__(self, put: Put, *args: Any, **more: Any) -> None:
        """Make a gateway with the arguments ``args`` and ``more``."""
        super().__init__(*args, **more)
        self._put = put
        self._counters = _counters_of(self.status)
        self._line_errors = [0] * len(self.escs)

    def start(self, now: int, can_open: bool = True) -> None:
        self._note(now, EntryKind.START, flags=int(can_open))
        super().start(now, can_open)

    def stop(self, now: int) -> None:
        self._note(now, EntryKind.STOP)
        super().stop(now)

    def receive_bytes(
        self,
        esc: int,
        data: bytes,
        now: int,
        since: int,
    ) -> None:
        self._note(now, EntryKind.BYTES, esc, data, came=since)
        super().receive_bytes(esc, data, now, since)

    def receive_frame(self, frame: CanFrame, now: int, at: int) -> None:
        self._note_line_errors(now)
        data = frame_data(frame)
        self._note(now, EntryKind.FRAME, data=data, came=at)
        super().receive_frame(frame, now, at)

    def held_up(self, now: int, dropped: bool) -> None:
        self._note(now, EntryKind.HELD_UP, flags=int(dropped))
        super().held_up(now, dropped)

    def hold(self, now: int, is_earlier: bool = False) -> None:
        self._note(now, EntryKind.HOLD, flags=int(not is_earlier))
        super().hold(now, is_earlier)

    def limit(self, is_limited: bool, has_discarded: bool, now: int) -> None:
        self._note(now, EntryKind.LIMIT, flags=is_limited | has_discarded << 1)
        super().limit(is_limited, has_discarded, now)

    def take_some(self, messages: int, now: int) -> list[CanFrame]:
        if not self.output_frames and not (messages and self.core.is_pending):
            return []
        self._note(now, EntryKind.TAKE, flags=messages)
        frames = super().take_some(messages, now)
        self._counters = _with_sent(self._counters, len(frames))
        return frames

    def first_frame(self, now: int) -> CanFrame | None:
        self._note(now, EntryKind.FIRST_FRAME)
        frame = super().first_frame(now)
        if frame is not None:
            self._counters = _with_sent(self._counters, 1)
        return frame

    def release(self, now: int) -> None:
        self._note(now, EntryKind.RELEASE)
        super().release(now)

    def can_opened(self, now: int) -> None:
        self._note(now, EntryKind.CAN_OPENED)
        super().can_opened(now)

    def receive_overrun(self, now: int) -> None:
        self._note(now, EntryKind.OVERRUN)
        super().receive_overrun(now)

    def saved(self, esc: int, error: str | None, now: int) -> None:
        has_failed = error is not None
        reason = (error or "").encode()
        self._note(now, EntryKind.SAVED, esc, reason, flags=int(has_failed))
        super().saved(esc, error, now)

    def parameters_damaged(self, esc: int, now: int) -> None:
        self._note(now, EntryKind.DAMAGED, esc)
        super().parameters_damaged(esc, now)

    def port(self, esc: int, is_open: bool, now: int) -> None:
        self._note(now, EntryKind.PORT_OPENED if is_open else EntryKind.PORT_LOST, esc)
        super().port(esc, is_open, now)

    def can_returned(self, now: int) -> None:
        self._note(now, EntryKind.CAN_RETURNED)
        super().can_returned(now)

    def set_can_state(self, state: CanState, now: int) -> None:
        self._note(now, EntryKind.CAN_STATE, flags=int(state))
        super().set_can_state(state, now)

    def advance(self, now: int, with_core: bool = True) -> None:
        if with_core:  # otherwise the core's own call was recorded
            self._note_line_errors(now)
            self._note(now, EntryKind.ADVANCE)
        super().advance(now, with_core)

    def take_frames(self, now: int) -> list[CanFrame]:
        frames = super().take_frames(now)
        self._counters = _with_sent(self._counters, len(frames))
        return frames

    def not_sent(self, now: int) -> None:
        self._put(now, EntryKind.NOT_SENT, 0, b"", 0, None)

    def prepare_turns(self, now: int) -> None:
        """Record counters and line errors before turns in C call the core."""
        self._note_line_errors(now)
        self._note_counters(now)

    def turned(self, calls: Iterable[Call], frames: int) -> None:
        """Record the calls of the core by turns in C. ``frames``: number of frames taken."""
        self._counters = _with_sent(self._counters, frames)
        for now, kind, esc, data, came in calls:
            self._put(now, kind, esc, data, 0, came)

    def _note_line_errors(self, now: int) -> None:
        for index, esc in enumerate(self.escs):
            line_errors = esc.line_errors
            if line_errors != self._line_errors[index]:
                self._line_errors[index] = line_errors
                data = numbers_data(line_errors)
                self._put(now, EntryKind.LINE_ERRORS, index, data, 0, None)

    def _note(
        self,
        now: int,
        kind: EntryKind,
        esc: int = 0,
        data: bytes = b"",
        flags: int = 0,
        came: int | None = None,
    ) -> None:
        self._note_counters(now)
        self._put(now, kind, esc, data, flags, came)

    def _note_counters(self, now: int) -> None:
        counters = _counters_of(self.status)
        if counters != self._counters:
            self._counters = counters
            data = numbers_data(*counters)
            self._put(now, EntryKind.COUNTERS, 0, data, 0, None)


def _with_sent(counters: tuple[int, ...], frames: int) -> tuple[int, ...]:
    """Return counters with more sent frames.

    Usually all frames are sent, so only other changes of the counters need to be recorded.
    """
    sent, *others = counters
    return (sent + frames, *others)


def state_of(gateway: Gateway) -> dict[str, Any]:
    """Return the state with which a replay can begin now."""
    escs = []
    for esc in gateway.escs:
        counters = {
            "energy": esc.energy_mw_ns,
            "run_time": esc.run_time_ns,
            "losses": esc.losses,
            "late_frames": esc.late_frames,
            "suspect_frames": esc.suspect_frames,
            "line_errors": esc.line_errors,
        }
        escs.append(counters | esc.stream_state())
    return {
        "escs": escs,
        "messages": gateway.core.places(),
        "counters": _counters_of(gateway.status),
        "can_state": int(gateway.status.can_state),
        "is_held": int(gateway.is_held),
        "is_limited": int(gateway.is_limited),
        "started_ns": gateway.status.started_ns,
        "heard_ns": max([gateway.status.heard_ns, *[esc.live_ns or 0 for esc in gateway.escs]]),
    }


def devices_of(gateway: Gateway) -> list[dict[str, Any] | None]:
    """Return the device of each ESC according to its last info frame. None before the first."""
    found: list[dict[str, Any] | None] = []
    for esc in gateway.escs:
        info = esc.last_info
        if info is None:
            found.append(None)
            continue
        protocol = esc.protocol
        device = {
            "device": protocol.device_text(info),
            "variant": protocol.value("variant", info),
            "firmware": protocol.firmware_text(info),
            "layout": protocol.layout_text(esc.layout) or "",
        }
        found.append(device)
    return found
