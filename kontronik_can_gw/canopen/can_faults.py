"""Trouble of the CAN controller: emergencies 8110h, 8120h, 8140h and error behaviour 1029h:1 (CiA 301, 7.5.2.27)."""

from collections.abc import Callable

from kontronik_can_gw.canopen.emergency import Emergencies
from kontronik_can_gw.canopen.emergency_codes import GatewayError
from kontronik_can_gw.canopen.nmt import Nmt
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.gateway_status import CanState


class CanFaults:
    """``returned`` is called with the time at the end of an outage, ``repeat`` where frames were lost without one."""

    def __init__(
        self,
        emergencies: Emergencies,
        nmt: Nmt,
        returned: Callable[[int], None],
        repeat: Callable[[int], None],
    ) -> None:
        self._emergencies = emergencies
        self._nmt = nmt
        self._returned = returned
        self._repeat = repeat
        self._next_overrun = 0
        self._off_bus = False
        self._outage = False

    def power_on(self) -> None:
        """What was before the start counts no more."""
        self._off_bus = self._outage = False

    def on_state(self, state: CanState, now: int) -> None:
        """The CAN controller's state changed."""
        # bus-off is worse than passive, not its end
        if state in (CanState.ERROR_PASSIVE, CanState.ERROR_ACTIVE, CanState.ERROR_WARNING):
            self._emergencies.set(GatewayError.CAN_PASSIVE, state is CanState.ERROR_PASSIVE, now)
        if state in (CanState.BUS_OFF, CanState.DOWN):
            self._off_bus = self._off_bus or state is CanState.BUS_OFF
            self._outage = True
            self._nmt.communication_error(now)
        elif self._outage and state is not CanState.UNKNOWN:
            self._end_outage(now)

    def frames_pass(self, now: int) -> None:
        """Frames can be sent again after some were lost."""
        if self._outage:
            self._end_outage(now)
        else:
            self._repeat(now)

    def overrun(self, now: int) -> None:
        """Received frames were lost in the controller: reported once a second at most."""
        if now >= self._next_overrun:
            self._next_overrun = now + SECOND
            self._emergencies.pulse(GatewayError.RECEIVE_OVERRUN, now)

    def _end_outage(self, now: int) -> None:
        off_bus, self._off_bus, self._outage = self._off_bus, False, False
        self._returned(now)
        if off_bus:
            self._emergencies.pulse(GatewayError.BUS_OFF_LEFT, now)
