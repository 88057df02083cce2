"""The first frame after an outage. It carries no measurement.

A bus may still be blocked when its first frame is handed over. That frame then waits in the
controller, and is sent late when the bus is free again. So it must contain nothing that ages.
"""

from collections.abc import Sequence
from dataclasses import replace

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


def _without_measurements(message: MessagePlan) -> MessagePlan:
    """Return a message whose values of ESCs are never available."""
    signals = tuple(_without_measurement(signal) for signal in message.signals)
    return replace(message, compiled=signals, renamed=None)


def _without_measurement(signal: SignalPlan) -> SignalPlan:
    if signal.source is None or signal.esc is None:
        return signal
    return replace(signal, role=Role.CONSTANT, constant=signal.not_available, source=None)
