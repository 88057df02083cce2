"""What a node does for its ESC: settings 2100h, status register 1002h, texts of 2010h, statistics 2102h, emergencies of ESC and link."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.dictionary import Abort, SdoAbort, signature
from kontronik_can_gw.canopen.emergency_codes import GatewayError
from kontronik_can_gw.canopen.node_settings import esc_settings
from kontronik_can_gw.esc.telemetry import EscSettings, Event, LinkState
from kontronik_can_gw.status import GatewayStatus

if TYPE_CHECKING:
    from kontronik_can_gw.canopen.node import Node


class EscObjects:
    """``changed`` is called with other settings of the ESC."""

    def __init__(
        self, node: "Node", gateway: GatewayStatus, changed: Callable[[EscSettings], None]
    ) -> None:
        dictionary, esc = node.dictionary, node.esc
        self._node, self._esc = node, esc
        self._base = esc.settings
        self._errors = esc.protocol.by_name.get("operating_errors")
        self._gateway = gateway
        self._changed = changed
        self._live = False  # for the edge of 1029h:2
        dictionary.bind(0x1002, read=self._status_register)
        dictionary.bind(at.INFO, 6, read=self._device_name)
        dictionary.bind(at.INFO, 7, read=self._firmware)
        for variable in dictionary.subs(at.SETTINGS):
            variable.written = self.apply_settings
        reset = at.RESET_STATISTICS, 1
        dictionary.bind(*reset, check=signature(b"rset"), written=lambda _: esc.reset_statistics())

    def apply_settings(self, now: int) -> None:
        """Take over 2100h."""
        self._node.emergencies.mask = self._node.dictionary.number(at.SETTINGS, 6)
        if self._esc.live is not None and self._errors is not None:
            self._node.emergencies.set_word(self._errors.of(self._esc.live), now, force=True)
        settings = esc_settings(self._node.dictionary, self._base)
        if settings != self._esc.settings:
            self._changed(settings)

    def on_event(self, events: int, now: int) -> None:
        """Something of the ESC changed: bits of telemetry.Event."""
        live = self._esc.live
        if events & Event.STATE and live is not None and self._errors is not None:
            errors = self._errors.of(live)
            self._node.emergencies.set_word(errors, now, at=self._esc.live_ns)
        if events & (Event.LINK | Event.INFO) or self._live is (live is None):
            self._follow_link(events, now)

    def _follow_link(self, events: int, now: int) -> None:
        esc, found, expected = self._esc, self._node.emergencies, self._node.settings.device
        link = esc.link
        if events & Event.LINK:
            if link is LinkState.PORT_ERROR:
                found.set(GatewayError.PORT_GONE, True, now)
            expired_ns = esc.live_bound_ns + esc.settings.timeout_ns
            found.set(GatewayError.TELEMETRY_LOST, link is LinkState.LOST, now, at=expired_ns)
            found.set(GatewayError.CRC_RATE, link is LinkState.DEGRADED, now)
            found.set(GatewayError.PORT_GONE, link is LinkState.PORT_ERROR, now)
        if events & Event.INFO and esc.info is not None and expected is not None:
            device = esc.protocol.value("device_raw", esc.info)
            found.set(GatewayError.OTHER_DEVICE, device != expected, now)
        if self._live and esc.live is None and link in (LinkState.LOST, LinkState.PORT_ERROR):
            self._node.nmt.behave(2, now)
        self._live = esc.live is not None

    # --- objects

    def _status_register(self, now: int) -> int:
        """1002h: bits 7..0 link status as 2020h:1, 15..8 CAN state, 16 telemetry fresh, 17 information fresh."""
        esc, gateway = self._esc, self._gateway
        fresh = (esc.live is not None) | (esc.info is not None) << 1
        return at.link_status(esc, gateway, now) | int(gateway.can_state) << 8 | fresh << 16

    def _device_name(self, _now: int) -> bytes:
        protocol, info = self._esc.protocol, self._esc.last_info
        device = protocol.value("device_raw", info)
        if device is None:
            raise SdoAbort(Abort.NO_DATA)
        return (protocol.device_name(info) or f"device {device}").encode("ascii", "replace")

    def _firmware(self, _now: int) -> bytes:
        text = self._esc.protocol.firmware_text(self._esc.last_info)
        if text is None:
            raise SdoAbort(Abort.NO_DATA)
        return text.encode("ascii")
