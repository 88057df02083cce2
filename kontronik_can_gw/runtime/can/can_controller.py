"""Follows the state of the CAN controller: error states, bus-off and its end, bit rate.

The sources are the port's error frames and the kernel's reports by rtnetlink.
"""

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.gateway.gate import Gate
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.can.can_port import CanPort
from kontronik_can_gw.runtime.can.link_commands import restart
from kontronik_can_gw.runtime.can.link_monitor import LinkFacts, LinkMonitor, link_monitor
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.status import CanState, name_in_words
from kontronik_can_gw.times import MS, NEVER, SECOND

ASK_NS = SECOND
"""Interval at which the kernel is asked for the controller's state, except in bus-off."""
ASK_OFF_NS = 100 * MS
"""The same interval in bus-off."""
ASK_RESTARTING_NS = 20 * MS
"""The same interval after a restart, until the driver reports another state than bus-off."""
RESTARTED_NS = SECOND
"""Time after a restart in which a driver's report of bus-off is ignored, because it may be old."""
UNCONFIRMED_OFF_NS = SECOND
"""Longest duration of a bus-off that the kernel cannot confirm.

On a virtual bus any participant can send the error frame, and nothing restarts a controller there.
The kernel has no controller for a virtual interface, and no information on python-can's adapters.
"""


class CanController:
    """The state of an interface's CAN controller."""

    def __init__(
        self, config: CanConfig, gateway: Gateway, gate: Gate, conditions: FaultLog
    ) -> None:
        self.facts: LinkFacts | None = None
        """The kernel's last report. None if it does not report this interface."""
        self.is_off = False
        """True in bus-off."""
        self.due = NEVER
        """Time at which ``ask`` must be called."""
        self.condition = f"CAN {config.channel}: controller"
        self._config = config
        self._gateway = gateway
        self._gate = gate
        self._conditions = conditions
        self._off_since = 0
        self._restarted_ns = -RESTARTED_NS
        self._monitor: LinkMonitor | None = None
        if config.interface == "socketcan":
            self._monitor = link_monitor(config.channel)
        if self._monitor is not None:
            self.due = 0

    @property
    def stays_off(self) -> bool:
        """True if a bus-off does not end by itself (restart-ms 0)."""
        return self.facts is not None and self.facts.restart_ms == 0

    def fileno(self) -> int | None:
        """Return a descriptor that is readable when the kernel has sent a report.

        None if the kernel does not report this interface.
        """
        return None if self._monitor is None else self._monitor.fileno()

    def close(self) -> None:
        """Stop asking the kernel and receiving its reports."""
        if self._monitor is not None:
            self._monitor.close()
            self._monitor = None

    def ask(self, now: int) -> None:
        """Ask the kernel for the state of the interface.

        In bus-off, ``due`` is set even if the kernel cannot be asked.
        """
        if self._monitor is not None:
            self._monitor.ask()
        if self.is_off:
            self.due = now + ASK_OFF_NS
        else:
            self.due = NEVER if self._monitor is None else now + ASK_NS

    def take(self) -> list[LinkFacts]:
        """Return the kernel's reports since the last call, oldest first."""
        return [] if self._monitor is None else self._monitor.take()

    def note(self, facts: LinkFacts, now: int) -> None:
        """Store a report of the kernel, and log a wrong bit rate."""
        self.facts = facts
        self._follow_bitrate(facts.bitrate, now)

    def refresh(self, now: int) -> None:
        """Ask the kernel and store its answer. Older reports are ignored."""
        self.ask(now)
        reports = self.take()
        if reports:
            self.note(reports[-1], now)

    def note_state(self, facts: LinkFacts, port: CanPort, now: int) -> None:
        """Give the kernel's state of the controller to the port.

        Some drivers still report bus-off to the kernel after their error frames reported a
        restart. Such an old state is ignored.
        """
        state = facts.state
        if state is None or state is port.state:
            return
        was_restarted = now - self._restarted_ns < RESTARTED_NS
        is_old = state is CanState.BUS_OFF and (self.is_off or was_restarted)
        if not is_old:
            port.note_state(state)

    def end_unconfirmed_off(self, port: CanPort, now: int) -> None:
        """End a bus-off that has lasted UNCONFIRMED_OFF_NS without a confirmation by the kernel."""
        is_confirmed = self.facts is not None and self.facts.state is not None
        if self.is_off and not is_confirmed and now - self._off_since >= UNCONFIRMED_OFF_NS:
            port.note_state(CanState.ERROR_ACTIVE)
            self.follow(port, now)

    def follow(self, port: CanPort, now: int) -> None:
        """Report a new state of the port to the gateway, and log it."""
        status = self._gateway.status
        if port.bus_off_count:
            status.bus_off_count += port.bus_off_count
            port.bus_off_count = 0
        if port.state is status.can_state:
            return
        if self.is_off and port.state is not CanState.BUS_OFF:
            if not self._has_restarted(port.frames_left(), now):
                return
            self._restarted_ns = now
        self.is_off = port.state is CanState.BUS_OFF
        self._off_since = now
        self._gateway.set_can_state(port.state, now)
        name = f"CAN {self._config.channel}"
        if port.state is CanState.BUS_OFF:
            self._conditions.begin(self.condition, f"{name}: bus-off.{self._restart_hint()}", now)
            self.ask(now)
        elif port.state is CanState.ERROR_PASSIVE:
            text = (
                f"{name}: error-passive. The bit rate is wrong, a cable or the termination is "
                "faulty, or no other node acknowledges."
            )
            self._conditions.begin(self.condition, text, now)
        elif port.state is not CanState.UNKNOWN:
            word = name_in_words(port.state.name)
            self._conditions.end(self.condition, f"{name}: {word}", now)

    def _has_restarted(self, count: int, now: int) -> bool:
        """Return True if a controller that left bus-off accepts frames again.

        Frames that are sent earlier are lost without an error. The kernel first reports
        "restarted", then starts the queue and then the controller, and changes its state last.
        Some drivers change it late. The gate waits for them only for a short time.
        """
        self.refresh(now)
        facts = self.facts
        if facts is None:
            return self._gate.left_bus_off(count, is_running=True, is_reported=False, now=now)
        is_running = facts.up and facts.running
        is_reported = facts.state is CanState.BUS_OFF
        if is_running and is_reported:
            self.due = now + ASK_RESTARTING_NS
        return self._gate.left_bus_off(count, is_running, is_reported, now)

    def _follow_bitrate(self, bitrate: int | None, now: int) -> None:
        if not bitrate:
            return
        wanted = self._config.bitrate
        name = f"CAN {self._config.channel}"
        condition = f"{name}: bit rate"
        text = f"{name} runs at {bitrate} bit/s"
        if bitrate == wanted:
            self._conditions.end(condition, text, now)
        else:
            text = f"{text}, but can.bitrate is {wanted}. Set both to the same bit rate."
            self._conditions.begin(condition, text, now)

    def _restart_hint(self) -> str:
        if not self.stays_off:
            return ""
        name = self._config.channel
        return (
            f" restart-ms is 0, so it stays off until it is restarted: {restart(name)}. "
            f"To let it restart by itself: {restart(name, 'type can restart-ms 100')}."
        )
