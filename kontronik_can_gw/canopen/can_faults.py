"""Trouble of the CAN controller: emergencies 8110h, 8120h, 8140h and error behaviour 1029h:1 of all nodes (CiA 301, 7.5.2.27)."""

from collections.abc import Sequence

from kontronik_can_gw.canopen.emergency_codes import GatewayError
from kontronik_can_gw.canopen.node import Node
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.gateway_status import CanState


class CanFaults:
    """What became of the bus that the nodes are on."""

    def __init__(self, nodes: Sequence[Node]) -> None:
        self._nodes = nodes
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
            for node in self._nodes:
                is_passive = state is CanState.ERROR_PASSIVE
                node.emergencies.set(GatewayError.CAN_PASSIVE, is_passive, now)
        if state in (CanState.BUS_OFF, CanState.DOWN):
            self._off_bus = self._off_bus or state is CanState.BUS_OFF
            self._outage = True
            for node in self._nodes:
                node.nmt.behave(1, now)
        elif self._outage and state is not CanState.UNKNOWN:
            self.frames_pass(now)

    def frames_pass(self, now: int) -> None:
        """Frames can be sent again after some were lost."""
        for node in self._nodes:
            if self._outage:
                node.returned(now)
            else:
                node.repeat(now)
            if self._off_bus:
                node.emergencies.pulse(GatewayError.BUS_OFF_LEFT, now)
        self._off_bus = self._outage = False

    def overrun(self, now: int) -> None:
        """Received frames were lost in the controller: reported once a second at most."""
        if now >= self._next_overrun:
            self._next_overrun = now + SECOND
            for node in self._nodes:
                node.emergencies.pulse(GatewayError.RECEIVE_OVERRUN, now)
