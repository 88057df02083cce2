"""Outages of the bus: frames are held, and the first frame after it carries no measurement.

A bus may still be blocked when its first frame is handed over. That frame then waits in the
controller, and is sent late when the bus is free again. So it must contain nothing that ages.
"""

from collections.abc import Sequence
from dataclasses import replace

from kontronik_can_gw.core.interface import Core
from kontronik_can_gw.core.output import Output
from kontronik_can_gw.esc.telemetry import EscTelemetry
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.signals.packer import MakeFrame, compile_frame
from kontronik_can_gw.signals.plan import Layout, MessagePlan, Role, SignalPlan
from kontronik_can_gw.status import GatewayStatus


class FirstFrame:
    """Makes the first frame.

    1. It is a message without values of ESCs, such as GatewayStatus.
    2. If there is none, it is the first message with each value of an ESC not available.
    3. Without messages, it is a frame of an output, such as a heartbeat.
    """

    def __init__(self, layout: Layout, outputs: Sequence[Output]) -> None:
        by_use = sorted(layout.messages, key=lambda message: bool(message.escs))
        self._message = by_use[0] if by_use else None
        self._outputs = outputs
        self._make: MakeFrame | None = None

    def make(
        self, escs: Sequence[EscTelemetry], status: GatewayStatus, now: int
    ) -> CanFrame | None:
        """Return the frame with the gateway's current state. None if no frame is possible."""
        if self._message is None:
            frames = (output.first_frame(now) for output in self._outputs)
            return next((frame for frame in frames if frame is not None), None)
        if self._make is None:
            self._make = compile_frame(_without_measurements(self._message))
        return self._make(escs, status, now, 0, 0)


class HoldsFrames:
    """The part of a gateway that holds its frames during an outage."""

    def __init__(self, core: Core, outputs: Sequence[Output], layout: Layout) -> None:
        self.core = core
        self.outputs = outputs
        self.output_frames: list[CanFrame] = []
        """The frames of all outputs, oldest first."""
        for output in outputs:
            self.output_frames += output.frames
            output.frames = self.output_frames
        self.is_held = False
        """True if no frame may be sent except the first one after an outage."""
        self._first_frame = FirstFrame(layout, outputs)
        self._has_lost_frames = False
        """True if frames of outputs were discarded since ``hold``."""

    def hold(self, now: int) -> None:  # noqa: ARG002  a recorded gateway needs it
        """Send nothing until ``release``, and discard the outputs' waiting frames.

        Messages and slots become pending as usual, and are packed with the values of the release. A
        call while frames are held discards the outputs' new frames, so that answers do not get old.
        """
        self.is_held = True
        self._has_lost_frames = self._has_lost_frames or bool(self.output_frames)
        self.output_frames.clear()

    def first_frame(self, now: int) -> CanFrame | None:
        """Return a frame without measurements, to be sent while the others are held.

        When it has left the interface, the bus works again. None if there is no such frame.
        """
        return self._first_frame.make(self.core.escs, self.core.status, now)

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


def _without_measurements(message: MessagePlan) -> MessagePlan:
    """Return a message whose values of ESCs are never available."""
    signals = tuple(_without_measurement(signal) for signal in message.signals)
    return replace(message, compiled=signals, renamed=None)


def _without_measurement(signal: SignalPlan) -> SignalPlan:
    if signal.source is None or signal.esc is None:
        return signal
    return replace(signal, role=Role.CONSTANT, constant=signal.not_available, source=None)
