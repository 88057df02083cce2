"""The objects and emergencies of a node that concern its ESC.

They are the settings 2100h, the status register 1002h, the texts of 2010h, the reset of statistics
2102h, and the emergencies of the ESC and its link.
"""

from collections.abc import Callable

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.dictionary import Abort, Dictionary, SdoAbort, signature
from kontronik_can_gw.canopen.emergency import Emergencies
from kontronik_can_gw.canopen.emergency_codes import GatewayError
from kontronik_can_gw.canopen.nmt import Nmt
from kontronik_can_gw.canopen.node_settings import esc_settings
from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry, Event, LinkState
from kontronik_can_gw.status import GatewayStatus


class EscObjects:
    """``device`` is the expected device number, or None for any.

    ``changed`` is called with the new settings of the ESC if a master changes 2100h.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        esc: EscTelemetry,
        gateway: GatewayStatus,
        *,
        emergencies: Emergencies,
        nmt: Nmt,
        device: int | None,
        changed: Callable[[EscSettings], None],
    ) -> None:
        self._dictionary = dictionary
        self._esc = esc
        self._emergencies = emergencies
        self._nmt = nmt
        self._device = device
        self._base = esc.settings
        self._errors = esc.protocol.by_name.get("operating_errors")
        self._gateway = gateway
        self._changed = changed
        self._is_live = False  # to notice a loss, see 1029h:2
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
        """Apply the values of 2100h to the ESC and the emergencies."""
        self._emergencies.mask = self._dictionary.number(at.SETTINGS, 6)
        live = self._esc.live
        if live is not None and self._errors is not None:
            errors = self._errors.of(live)
            self._emergencies.set_word(errors, now)
        settings = esc_settings(self._dictionary, self._base)
        if settings != self._esc.settings:
            self._changed(settings)

    def on_event(self, events: int, now: int) -> None:
        """Follow a change of the ESC. ``events`` are bits of ``telemetry.Event``."""
        live = self._esc.live
        if events & Event.STATE and live is not None and self._errors is not None:
            errors = self._errors.of(live)
            self._emergencies.set_word(errors, now, at=self._esc.live_ns)
        has_changed = self._is_live is (live is None)
        if has_changed or events & (Event.LINK | Event.INFO):
            self._follow_link(events, now)

    def _follow_link(self, events: int, now: int) -> None:
        esc = self._esc
        emergencies = self._emergencies
        link = esc.link
        if events & Event.LINK:
            # The port's error begins before other errors end, so that no 0000h is sent in between.
            if link is LinkState.PORT_ERROR:
                emergencies.set(GatewayError.PORT_GONE, True, now)
            is_silent = link is LinkState.LOST
            emergencies.set(GatewayError.TELEMETRY_LOST, is_silent, now, at=esc.live_until_ns)
            emergencies.set(GatewayError.CRC_RATE, link is LinkState.DEGRADED, now)
            emergencies.set(GatewayError.PORT_GONE, link is LinkState.PORT_ERROR, now)
        info = esc.info
        if events & Event.INFO and info is not None and self._device is not None:
            device = esc.protocol.value("device_raw", info)
            emergencies.set(GatewayError.OTHER_DEVICE, device != self._device, now)
        is_lost = link in (LinkState.LOST, LinkState.PORT_ERROR)
        if self._is_live and esc.live is None and is_lost:
            self._nmt.behave(2, now)
        self._is_live = esc.live is not None

    # --- objects

    def _status_register(self, now: int) -> int:
        """Return 1002h.

        Bits 7..0 are the link status of 2020h:1, bits 15..8 the CAN state. Bit 16 is set while
        telemetry is fresh, bit 17 while the information frame is.
        """
        esc = self._esc
        gateway = self._gateway
        register = at.link_status(esc, gateway, now)
        register |= int(gateway.can_state) << 8
        if esc.live is not None:
            register |= 1 << 16
        if esc.info is not None:
            register |= 1 << 17
        return register

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
