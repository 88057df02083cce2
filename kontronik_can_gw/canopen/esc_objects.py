"""The objects of a node that depend on its ESC, and the emergencies of ESC and link.

The objects are settings 2100h, status register 1002h, texts of 2010h, and statistics 2102h.
"""

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
    """Serves the objects of a node's ESC. ``changed`` is called with new settings of the ESC."""

    def __init__(
        self, node: "Node", gateway: GatewayStatus, changed: Callable[[EscSettings], None]
    ) -> None:
        dictionary = node.dictionary
        esc = node.esc
        self._node = node
        self._esc = esc
        self._base = esc.settings
        self._errors = esc.protocol.by_name.get("operating_errors")
        self._gateway = gateway
        self._changed = changed
        self._live = False
        """True if live data was fresh at the last call. 1029h:02 acts once when it is lost."""
        dictionary.bind(0x1002, read=self._status_register)
        dictionary.bind(at.INFO, 6, read=self._device_name)
        dictionary.bind(at.INFO, 7, read=self._firmware)
        for variable in dictionary.subs(at.SETTINGS):
            variable.written = self.apply_settings
        dictionary.bind(
            at.RESET_STATISTICS,
            1,
            check=signature(b"rset"),
            written=lambda _now: esc.reset_statistics(),
        )

    def apply_settings(self, now: int) -> None:
        """Apply the settings in 2100h."""
        self._node.emergencies.mask = self._node.dictionary.number(at.SETTINGS, 6)
        if self._esc.live is not None and self._errors is not None:
            self._node.emergencies.set_word(self._errors.of(self._esc.live), now, force=True)
        settings = esc_settings(self._node.dictionary, self._base)
        if settings != self._esc.settings:
            self._changed(settings)

    def on_event(self, events: int, now: int) -> None:
        """Follow a change of the ESC. ``events`` are bits of telemetry.Event."""
        live = self._esc.live
        if events & Event.STATE and live is not None and self._errors is not None:
            errors = self._errors.of(live)
            self._node.emergencies.set_word(errors, now, at=self._esc.live_ns)
        if events & (Event.LINK | Event.INFO) or self._live is (live is None):
            self._follow_link(events, now)

    def _follow_link(self, events: int, now: int) -> None:
        esc = self._esc
        emergencies = self._node.emergencies
        expected = self._node.settings.device
        link = esc.link
        if events & Event.LINK:
            # The port's error begins before other errors end, so that no 0000h is sent in between.
            if link is LinkState.PORT_ERROR:
                emergencies.set(GatewayError.PORT_GONE, True, now)
            expired_ns = esc.live_bound_ns + esc.settings.timeout_ns
            is_lost = link is LinkState.LOST
            emergencies.set(GatewayError.TELEMETRY_LOST, is_lost, now, at=expired_ns)
            emergencies.set(GatewayError.CRC_RATE, link is LinkState.DEGRADED, now)
            emergencies.set(GatewayError.PORT_GONE, link is LinkState.PORT_ERROR, now)
        if events & Event.INFO and esc.info is not None and expected is not None:
            device = esc.protocol.value("device_raw", esc.info)
            emergencies.set(GatewayError.OTHER_DEVICE, device != expected, now)
        if self._live and esc.live is None and link in (LinkState.LOST, LinkState.PORT_ERROR):
            self._node.nmt.behave(2, now)
        self._live = esc.live is not None

    # --- objects

    def _status_register(self, now: int) -> int:
        """Return 1002h.

        Bits 7..0: link status as in 2020h:01, 15..8: CAN state, 16: live data is fresh, 17: info
        data is fresh.
        """
        esc = self._esc
        link = at.link_status(esc, self._gateway, now)
        can_state = int(self._gateway.can_state)
        has_live = esc.live is not None
        has_info = esc.info is not None
        return link | can_state << 8 | has_live << 16 | has_info << 17

    def _device_name(self, _now: int) -> bytes:
        protocol = self._esc.protocol
        info = self._esc.last_info
        device = protocol.value("device_raw", info)
        if device is None:
            raise SdoAbort(Abort.NO_DATA)
        name = protocol.device_name(info) or f"device {device}"
        return name.encode("ascii", "replace")

    def _firmware(self, _now: int) -> bytes:
        text = self._esc.protocol.firmware_text(self._esc.last_info)
        if text is None:
            raise SdoAbort(Abort.NO_DATA)
        return text.encode("ascii")
