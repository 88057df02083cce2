"""Follows quiet mode: discards frames that wait when it begins, and logs its begin and end."""

import logging

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.gateway.transmit_queue import Sent
from kontronik_can_gw.runtime.can.can_port import CanPort
from kontronik_can_gw.runtime.can.transmitter import LASTING_BUSY_NS, Transmitter
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.times import NEVER


class QuietMode:
    """Compares the gateway's quiet mode with the last known one."""

    def __init__(
        self,
        config: CanConfig,
        gateway: Gateway,
        transmitter: Transmitter,
        conditions: FaultLog,
    ) -> None:
        self._gateway = gateway
        self._transmitter = transmitter
        self._conditions = conditions
        self._after_s = config.quiet_after_s
        self._condition = f"CAN {config.channel}: quiet"
        self._is_on = False

    @property
    def due(self) -> int:
        """Time of the next check whether the last frames leave the interface.

        Otherwise other work wakes the loop often enough for these checks.
        """
        departures = self._transmitter.departures
        if not self._is_on or self._gateway.is_held or not departures.count:
            return NEVER
        return departures.check_due

    def follow(self, now: int) -> None:
        """Follow a change. It must be called before the gateway's frames are taken."""
        is_quiet = bool(self._gateway.status.is_quiet)
        if is_quiet is self._is_on:
            return
        self._is_on = is_quiet
        if is_quiet:
            self._begin(now)
        else:
            self._end(now)

    def transmit(self, port: CanPort, now: int) -> Sent | None:
        """Send due frames (``Transmitter.transmit``), but nothing in quiet mode during an outage.

        A first frame would keep the bus awake. Instead, a frame that leaves the interface, or a
        request that was received, shows that the bus works. Its answer is sent in the next turn.
        """
        transmitter = self._transmitter
        gateway = self._gateway
        if not (self._is_on and gateway.is_held):
            return transmitter.transmit(port, now)
        departures = transmitter.departures
        has_left = departures.check(port.frames_left(), now, transmitter.check_period_ns)
        if has_left or gateway.output_frames:
            transmitter.release(now)
        else:
            is_empty = departures.waits_since == NEVER
            transmitter.due = NEVER if is_empty else now + LASTING_BUSY_NS
        return None

    def opened(self, fault: str, text: str, now: int) -> None:
        """End the fault of an interface that was opened, because no frame may be sent for days."""
        if self._is_on:
            self._conditions.end(fault, text, now)

    def _begin(self, now: int) -> None:
        self._transmitter.drop_measurements()
        if self._gateway.is_held:
            self._transmitter.hold(now)  # an outage: the last frames of outputs are lost, too
        text = (
            f"{self._condition}: no ESC was heard for {self._after_s} s, "
            "so only requests are answered"
        )
        self._conditions.begin(self._condition, text, now, level=logging.INFO)

    def _end(self, now: int) -> None:
        self._transmitter.begin_outage(now, now)  # the gateway holds its frames
        text = f"{self._condition} mode ends: an ESC is heard"
        self._conditions.end(self._condition, text, now)
