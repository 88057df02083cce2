"""Meanings and remedies of the states of link, CAN controller and gateway. Names and numbers are in telemetry and sources."""

from collections.abc import Mapping
from typing import NamedTuple

from kontronik_can_gw.canopen.emergency_codes import GatewayError
from kontronik_can_gw.esc.telemetry import LinkState
from kontronik_can_gw.gateway_status import CanState, GatewayState


class Text(NamedTuple):
    """Meaning of a state, and remedy."""

    meaning: str
    remedy: str = "Nothing to do."


# fmt: off
LINK_STATES: Mapping[LinkState, Text] = {
    LinkState.NEVER_SEEN: Text(
        "nothing has come since the start",
        "Switch the ESC on. Check the cable and the telemetry setting of the ESC. A KOSMIK sends after one throttle pulse."),
    LinkState.SEARCHING: Text(
        "bytes come, but no good frame yet",
        "If it stays: the ESC may be set to another protocol, or the line is disturbed. The log and decode say what it looks like."),
    LinkState.OK: Text("good frames come"),
    LinkState.DEGRADED: Text("good frames come, and many CRC errors or dropped bytes with them", GatewayError.CRC_RATE.remedy),
    LinkState.LOST: Text("good frames came, and come no more", GatewayError.TELEMETRY_LOST.remedy),
    LinkState.PORT_ERROR: Text("the serial port cannot be opened or read", GatewayError.PORT_GONE.remedy),
}
CAN_STATES: Mapping[CanState, Text] = {
    CanState.UNKNOWN: Text("the CAN interface does not report it"),
    CanState.ERROR_ACTIVE: Text("works"),
    CanState.ERROR_WARNING: Text("works, but there are errors on the bus", GatewayError.CAN_PASSIVE.remedy),
    CanState.ERROR_PASSIVE: Text("works, with many errors on the bus", GatewayError.CAN_PASSIVE.remedy),
    CanState.BUS_OFF: Text(
        "switched off by errors on the bus: no frame can leave",
        f"{GatewayError.BUS_OFF_LEFT.remedy} With restart-ms 0 somebody has to restart the interface."),
    CanState.DOWN: Text(
        "the CAN interface is down or missing: no frame can leave",
        "Plug the adapter in, set the interface up. kontronik-can-gw doctor names the command."),
}
GATEWAY_STATES: Mapping[GatewayState, Text] = {
    GatewayState.STARTING: Text("opens its ports and the CAN interface"),
    GatewayState.RUNNING: Text("at work"),
    GatewayState.STOPPING: Text("about to end"),
    GatewayState.REPLAY: Text("the values come from a recording, not from an ESC"),
}
# fmt: on
