"""The CAN controller: its state from error frames and from rtnetlink, bus-off and its end, the bit rate."""

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.can.can_port import CanPort
from kontronik_can_gw.runtime.can.link_commands import restart
from kontronik_can_gw.runtime.can.link_monitor import LinkFacts, LinkMonitor, link_monitor
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.status import CanState, name_in_words
from kontronik_can_gw.times import MS, NEVER, SECOND

ASK_NS, ASK_OFF_NS = SECOND, 100 * MS
"""How often the kernel is asked for the controller's state: as a rule, and in bus-off."""
ASK_RESTARTING_NS, SETTLING_NS = 20 * MS, 200 * MS
RESTARTED_NS = SECOND
"""A driver may go on reporting bus-off for this long after a restart."""
UNCONFIRMED_OFF_NS = SECOND
"""A bus-off that the kernel cannot confirm ends after this time at the latest.

On a virtual bus any participant can send the error frame, and nothing restarts a controller there.
The kernel knows no controller of a virtual interface, and nothing of the adapters of python-can.
"""


class CanController:
    """What is known of an interface's controller. ``due``: when it is to be asked.

    ``facts``: what the kernel reported last; None where it reports nothing of this interface.
    """

    def __init__(self, config: CanConfig, gateway: Gateway, conditions: FaultLog) -> None:
        self.facts: LinkFacts | None = None
        self.is_off = False
        """In bus-off."""
        self.due = NEVER
        self.condition = f"CAN {config.channel}: controller"
        self._config = config
        self._gateway = gateway
        self._conditions = conditions
        self._runs_since: int | None = None
        self._off_since = 0
        self._restarted_ns = -RESTARTED_NS
        self._monitor: LinkMonitor | None = None
        if config.interface == "socketcan":
            self._monitor = link_monitor(config.channel)
        if self._monitor is not None:
            self.due = 0

    def fileno(self) -> int | None:
        """Readable when the kernel has something to report; None where it reports nothing."""
        return None if self._monitor is None else self._monitor.fileno()

    def close(self) -> None:
        """Ask and hear no more."""
        if self._monitor is not None:
            self._monitor.close()
            self._monitor = None

    def ask(self, now: int) -> None:
        """Ask how the interface is. In bus-off ``due`` is set even if there is nothing to ask."""
        if self._monitor is not None:
            self._monitor.ask()
        if self.is_off:
            self.due = now + ASK_OFF_NS
        else:
            self.due = NEVER if self._monitor is None else now + ASK_NS

    def take(self) -> list[LinkFacts]:
        """What the kernel has reported since the last call, oldest first."""
        return [] if self._monitor is None else self._monitor.take()

    def note(self, facts: LinkFacts, now: int) -> None:
        """Take over what the kernel reports of the interface."""
        self.facts = facts
        self._follow_bitrate(facts.bitrate, now)

    def refresh(self, now: int) -> None:
        """Learn how the interface is now; older reports are ignored."""
        self.ask(now)
        if reports := self.take():
            self.note(reports[-1], now)

    def note_state(self, facts: LinkFacts, port: CanPort, now: int) -> None:
        """Takes over the kernel's state of the controller.

        A driver may learn of a restart later than its error frames report it.
        """
        is_old = facts.state is CanState.BUS_OFF and (
            self.is_off or now - self._restarted_ns < RESTARTED_NS
        )
        if facts.state is not None and facts.state is not port.state and not is_old:
            port.note_state(facts.state)

    def end_unconfirmed_off(self, port: CanPort, now: int) -> None:
        """End a bus-off that has lasted long enough without a confirmation of the kernel."""
        is_confirmed = self.facts is not None and self.facts.state is not None
        if self.is_off and not is_confirmed and now - self._off_since >= UNCONFIRMED_OFF_NS:
            port.note_state(CanState.ERROR_ACTIVE)
            self.follow(port, now)

    def follow(self, port: CanPort, now: int) -> None:
        """The port may have another state than the gateway knows: pass it on, log what it means."""
        status = self._gateway.status
        if port.bus_off_count:
            status.bus_off_count += port.bus_off_count
            port.bus_off_count = 0
        if port.state is status.can_state:
            return
        if self.is_off and port.state is not CanState.BUS_OFF:
            if not self._has_restarted(now):
                return
            self._restarted_ns, self._runs_since = now, None
        self.is_off = port.state is CanState.BUS_OFF
        self._off_since = now
        self._gateway.set_can_state(port.state, now)
        name = f"CAN {self._config.channel}"
        if port.state is CanState.BUS_OFF:
            self._conditions.begin(self.condition, f"{name}: bus-off.{self._restart_hint()}", now)
            self.ask(now)
        elif port.state is CanState.ERROR_PASSIVE:
            text = f"{name}: error-passive: wrong bit rate, a cable or termination fault, or nobody acknowledges."
            self._conditions.begin(self.condition, text, now)
        elif port.state is not CanState.UNKNOWN:
            word = name_in_words(port.state.name)
            self._conditions.end(self.condition, f"{name}: {word}", now)

    def _has_restarted(self, now: int) -> bool:
        """Whether a controller that left bus-off takes frames again; before that they vanish without a word.

        The kernel says "restarted" first, then lets the queue run, then starts the controller; only then its state is another one. There
        are drivers that learn that late: they are not waited for.
        """
        self.refresh(now)
        if self.facts is None:
            return True
        if not self.facts.up or not self.facts.running:
            self._runs_since = None
            return False
        if self.facts.state is CanState.BUS_OFF:
            self._runs_since = now if self._runs_since is None else self._runs_since
            self.due = now + ASK_RESTARTING_NS
            return now - self._runs_since > SETTLING_NS
        return True

    def _follow_bitrate(self, bitrate: int | None, now: int) -> None:
        name, wanted = self._config.channel, self._config.bitrate
        if bitrate and bitrate != wanted:
            text = f"CAN {name} runs at {bitrate} bit/s, can.bitrate says {wanted}: make them the same."
            self._conditions.begin(f"CAN {name}: bit rate", text, now)
        elif bitrate:
            self._conditions.end(
                f"CAN {name}: bit rate", f"CAN {name} runs at {bitrate} bit/s", now
            )

    def _restart_hint(self) -> str:
        if self.facts is None or self.facts.restart_ms != 0:
            return ""
        name = self._config.channel
        return (
            f" restart-ms is 0, so it stays off until somebody restarts it: {restart(name)}. "
            f"To let it restart by itself: {restart(name, 'type can restart-ms 100')}."
        )
