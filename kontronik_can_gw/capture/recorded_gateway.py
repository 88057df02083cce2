"""A gateway that passes all its calls to a recorder.

A replay of the calls in their order gives the same frames (desk/recordings/replay.py).
"""

from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from operator import attrgetter
from typing import Any

from kontronik_can_gw.capture.calls import Recorded, RecordedCall, calls_by_method
from kontronik_can_gw.capture.format import RECORDED_COUNTERS, EntryKind, numbers_data
from kontronik_can_gw.capture.limits import COUNTERS_OF_ESC
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.status import GatewayStatus

Put = Callable[[int, int, int, bytes, int, int | None], None]
"""A function with the fields of ``Entry``: time, kind, ESC's index, data, flags, arrival."""


_counters_of: Callable[[GatewayStatus], tuple[int, ...]] = attrgetter(*RECORDED_COUNTERS)
Call = tuple[int, int, int, bytes, int | None]
"""Time, kind, ESC's index, data, arrival."""


class _Recorder(Gateway):
    """A gateway whose calls in the table ``CALLS`` are recorded before they are made."""

    def record(self, call: RecordedCall, recorded: Recorded) -> None:
        raise NotImplementedError


def _recording(method: str, calls: Sequence[RecordedCall]) -> Callable[..., Any]:
    """Return the gateway's method, so that a call that fits one of ``calls`` is recorded."""
    plain = getattr(Gateway, method)

    @wraps(plain)
    def record_and_call(gateway: _Recorder, *args: Any, **named: Any) -> Any:
        for call in calls:
            recorded = call.encoding.write(*args, **named)
            if recorded is not None:
                gateway.record(call, recorded)
                break
        return plain(gateway, *args, **named)

    return record_and_call


for _method, _calls in calls_by_method():
    setattr(_Recorder, _method, _recording(_method, _calls))


class RecordedGateway(_Recorder):
    """A gateway that records its calls.

    The runtime also changes the counters of ``status`` and the line errors. These changes are
    recorded with the next call.
    """

    is_recorded = True

    def __init__(self, put: Put, *args: Any, **more: Any) -> None:
        """Make a gateway with the arguments ``args`` and ``more``."""
        super().__init__(*args, **more)
        self._put = put
        self.recorded_counters = _counters_of(self.status)
        """The counters that a replay has after the entries so far. Waiting frames count as sent."""
        self._line_errors = [0] * len(self.escs)

    def record(self, call: RecordedCall, recorded: Recorded) -> None:
        """Record a call, and before it the changes since the last one."""
        now, esc, data, flags, came = recorded
        if call.follows_line_errors:
            self._note_line_errors(now)
        self._note_counters(now)
        self._put(now, call.kind, esc, data, flags, came)

    def take_some(self, messages: int, now: int) -> list[CanFrame]:
        if not self.output_frames and not (messages and self.core.is_pending):
            return []
        frames = super().take_some(messages, now)
        self.recorded_counters = _with_sent(self.recorded_counters, len(frames))
        return frames

    def first_frame(self, now: int) -> CanFrame | None:
        frame = super().first_frame(now)
        self.recorded_counters = _with_sent(self.recorded_counters, int(frame is not None))
        return frame

    def take_frames(self, now: int) -> list[CanFrame]:
        frames = super().take_frames(now)
        self.recorded_counters = _with_sent(self.recorded_counters, len(frames))
        return frames

    def not_sent(self, now: int) -> None:
        self._put(now, EntryKind.NOT_SENT, 0, b"", 0, None)

    def prepare_turns(self, now: int) -> None:
        """Record counters and line errors before iterations in C call the core."""
        self._note_line_errors(now)
        self._note_counters(now)

    def turned(self, calls: Iterable[Call], frames: int) -> None:
        """Record the calls of the core by iterations in C. ``frames``: number of frames taken."""
        self.recorded_counters = _with_sent(self.recorded_counters, frames)
        for now, kind, esc, data, came in calls:
            self._put(now, kind, esc, data, 0, came)

    def _note_line_errors(self, now: int) -> None:
        for index, esc in enumerate(self.escs):
            line_errors = esc.line_errors
            if line_errors != self._line_errors[index]:
                self._line_errors[index] = line_errors
                data = numbers_data(line_errors)
                self._put(now, EntryKind.LINE_ERRORS, index, data, 0, None)

    def _note_counters(self, now: int) -> None:
        counters = _counters_of(self.status)
        if counters != self.recorded_counters:
            self.recorded_counters = counters
            data = numbers_data(*counters)
            self._put(now, EntryKind.COUNTERS, 0, data, 0, None)


def _with_sent(counters: tuple[int, ...], frames: int) -> tuple[int, ...]:
    """Return counters with more sent frames.

    Usually all frames are sent, so only other changes of the counters need to be recorded.
    """
    sent, *others = counters
    return (sent + frames, *others)


def state_of(gateway: RecordedGateway) -> dict[str, Any]:
    """Return the state with which a replay can begin now."""
    escs = []
    for esc in gateway.escs:
        counters = {name: getattr(esc, each) for name, (each, _) in COUNTERS_OF_ESC.items()}
        escs.append(counters | esc.stream_state())
    state = {
        "escs": escs,
        "messages": gateway.core.places(),
        "counters": gateway.recorded_counters,
        "can_state": int(gateway.status.can_state),
        "is_held": int(gateway.is_held),
        "started_ns": gateway.status.started_ns,
        "heard_ns": max([gateway.status.heard_ns, *[esc.live_ns or 0 for esc in gateway.escs]]),
    }
    if gateway.is_limited:  # rare, and each segment of an event recording has a state
        state["is_limited"] = 1
    return state


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
