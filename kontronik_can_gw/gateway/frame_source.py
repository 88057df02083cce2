"""The frames of a gateway: taken at full speed, one by one on a slow bus, or held.

The gate to the bus decides (gate.py). Each call is an entry of a capture, so that a replay sends
the same frames.
"""

from collections.abc import Sequence
from dataclasses import replace

from kontronik_can_gw.core.interface import Core
from kontronik_can_gw.core.output import Output
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.signals.packer import MakeFrame, compile_frame
from kontronik_can_gw.signals.plan import MessageLayout, MessagePlan, Role, SignalPlan


class FrameSource:
    """The part of a gateway that gives frames for the bus."""

    def __init__(self, core: Core, outputs: Sequence[Output], layout: MessageLayout) -> None:
        self.core = core
        self.outputs = outputs
        self.output_frames: list[CanFrame] = []
        """The frames of all outputs, oldest first."""
        for output in outputs:
            self.output_frames += output.frames
            output.frames = self.output_frames
        self.is_held = False
        """True if no frame may be sent except the first one after an outage."""
        self.is_limited = False
        """True if frames of the core are taken by ``take_some`` only."""
        self._has_discarded = False
        """True if measurements were discarded since the last ``advance``."""
        self._has_lost_frames = False
        """True if frames of outputs were discarded since ``hold``."""
        self._first_message = min(layout.messages, key=_has_values, default=None)
        self._make_first: MakeFrame | None = None

    @property
    def frames_wait(self) -> bool:
        """True while ``take_frames`` has something to do."""
        if self.is_held or self.is_limited:
            return False
        return bool(self.output_frames) or self.core.is_pending

    def take_frames(self, now: int) -> list[CanFrame]:
        """Return the frames to send, packed with current values.

        The outputs' own frames are first, oldest first. Then follow slots and messages, each in the
        order in which they became due. The list is empty while frames are held or limited.
        """
        if self.is_held or self.is_limited:
            return []
        frames = self.core.take(now)
        if self.output_frames:
            frames = self.output_frames + frames
            self.output_frames.clear()
        return frames

    def take_some(self, messages: int, now: int) -> list[CanFrame]:
        """Return the outputs' frames and the oldest pending messages, while they are limited.

        A transfer has several frames. Without a pending message there are fewer frames.
        """
        frames = self.output_frames.copy()
        self.output_frames.clear()
        while messages and self.core.is_pending:
            taken = self.core.take_oldest(now)
            frames += taken
            messages -= bool(taken)
        return frames

    def not_sent(self, now: int) -> None:
        """Note that the frames taken last were discarded. Only a recorded gateway needs this."""

    def limit(self, is_limited: bool, has_discarded: bool, now: int) -> None:  # noqa: ARG002
        """Begin or end to take frames by ``take_some`` only.

        ``has_discarded`` means that waiting measurements were discarded. The next ``advance`` sends
        them again with the values known by then.
        """
        self.is_limited = is_limited
        self._has_discarded = self._has_discarded or has_discarded

    # --- outages

    def hold(self, now: int, is_earlier: bool = False) -> None:
        """Send nothing until ``release``, and discard the outputs' waiting frames.

        Messages and slots become pending as usual, and are packed with the values of the release. A
        call while frames are held discards the outputs' new frames, so that answers do not get old.
        ``is_earlier``: a capture is of an earlier version, whose outputs made frames meanwhile.
        """
        self.is_held = True
        self.is_limited = False
        self._has_lost_frames = self._has_lost_frames or bool(self.output_frames)
        self.output_frames.clear()
        if not is_earlier:
            for output in self.outputs:
                output.hold(now)

    def first_frame(self, now: int) -> CanFrame | None:
        """Return a frame without measurements, to be sent while the others are held.

        A bus may still be blocked when the frame is handed over. It then waits in the controller,
        and is sent late. So it must contain nothing that ages:

        1. It is a message without values of ESCs, such as GatewayStatus.
        2. Without such a message, it is the first message with each value of an ESC not available.
        3. Without messages, it is a frame of an output, such as a boot-up or a heartbeat.

        None without such a frame.
        """
        if self._first_message is not None:
            if self._make_first is None:
                self._make_first = compile_frame(_without_measurements(self._first_message))
            return self._make_first(self.core.escs, self.core.status, now, 0, 0)
        frames = (output.first_frame(now) for output in self.outputs)
        return next((frame for frame in frames if frame is not None), None)

    def release(self, now: int) -> None:
        """Send frames again, with everything that has no cycle."""
        self.is_held = False
        self._repeat(now, self._has_lost_frames)
        self._has_lost_frames = False

    def can_returned(self, now: int) -> None:
        """Send everything that has no cycle again, because frames were lost before."""
        self._repeat(now, has_lost_frames=False)

    def _repeat(self, now: int, has_lost_frames: bool) -> None:
        self.core.expire(now)
        self.core.repeat(now)
        for output in self.outputs:
            output.can_returned(now, has_lost_frames)


def _has_values(message: MessagePlan) -> bool:
    return bool(message.escs)


def _without_measurements(message: MessagePlan) -> MessagePlan:
    """Return a message whose values of ESCs are never available."""
    signals = tuple(_without_measurement(signal) for signal in message.signals)
    return replace(message, compiled=signals, renamed=None)


def _without_measurement(signal: SignalPlan) -> SignalPlan:
    if signal.source is None or signal.esc is None:
        return signal
    return replace(signal, role=Role.CONSTANT, constant=signal.not_available, source=None)
