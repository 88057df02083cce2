"""Logs the faults that the gate to the bus reports."""

import logging

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.gateway.gate import Gate
from kontronik_can_gw.runtime.can.interface_restart import remedy
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.status import GatewayStatus


class GateReports:
    """The lines of the log about the way to the bus."""

    def __init__(
        self, config: CanConfig, gate: Gate, status: GatewayStatus, conditions: FaultLog
    ) -> None:
        channel = config.channel
        self.stalled = f"CAN {channel}: sending"
        """The name of the fault that no frame leaves."""
        self.slow = f"CAN {channel}: slow"
        """The name of the fault that the bus is slow."""
        self._quiet_condition = f"CAN {channel}: quiet"
        self._restart_condition = f"CAN {channel}: restart"
        self._quiet_after_s = config.quiet_after_s
        self._channel = channel
        self._gate = gate
        self._status = status
        self._conditions = conditions

    def end_faults(self, now: int) -> None:
        """Log the end of faults that are over. In quiet mode they are forgotten."""
        gate = self._gate
        for name, lasts, text in (
            (self.slow, gate.is_slow, "the bus takes all frames in time"),
            (self.stalled, gate.is_stalled, "frames are sent again"),
        ):
            if gate.is_quiet and not lasts:
                self._conditions.forget(name)
            elif not lasts:
                self._conditions.end(name, f"CAN {self._channel}: {text}", now)

    def report_quiet(self, is_quiet: bool, now: int) -> None:
        """Log the begin or the end of quiet mode."""
        condition = self._quiet_condition
        if is_quiet:
            text = (
                f"{condition}: no ESC was heard for {self._quiet_after_s} s, "
                "so only requests are answered"
            )
            self._conditions.begin(condition, text, now, level=logging.INFO)
        else:
            self._conditions.end(condition, f"{condition} mode ends: an ESC is heard", now)

    def count_restart(self, now: int) -> None:
        """Count a restart, and log the first one."""
        self._status.can_restarts += 1
        if self._gate.restart.count == 1:
            text = f"CAN {self._channel}: no frame left it, so it is restarted"
            self._conditions.event(f"{self._restart_condition}s", text, now)
        self._conditions.forget(self._restart_condition)

    def report_missing_unit(self, now: int) -> None:
        """Log that a request was not answered."""
        text = f"CAN {self._channel}: the interface was not restarted. {remedy(self._channel)}"
        self._conditions.begin(self._restart_condition, text, now)

    def report_restarts(self, now: int) -> None:
        """Log how many restarts it took until the interface works."""
        restarts = self._gate.restart.count
        self._gate.restart.count = 0
        if restarts:
            count = "one restart" if restarts == 1 else f"{restarts} restarts"
            text = f"CAN {self._channel}: works again after {count}"
            self._conditions.event(f"{self._restart_condition}s", text, now)
        self._conditions.forget(self._restart_condition)

    def report_stall(self, now: int) -> None:
        """Log that no frame leaves the interface."""
        text = (
            f"CAN {self._channel}: no frame can be sent. No other node acknowledges, "
            "or the bus is full. Trying again."
        )
        self._conditions.begin(self.stalled, text, now)

    def report_slow(self, now: int) -> None:
        """Log that the bus takes too few frames."""
        text = (
            f"CAN {self._channel}: the bus is slow. Fewer values are sent, so that none is old. "
            "Check the bus load and error frames, or send less."
        )
        self._conditions.begin(self.slow, text, now)
