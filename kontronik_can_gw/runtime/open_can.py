"""Opens the CAN interface that the configuration names: any of python-can's, SocketCAN by a socket of our own."""

import logging
from typing import Any

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.errors import RunError, UserError, did_you_mean
from kontronik_can_gw.lean import without_asammdf
from kontronik_can_gw.runtime.can_port import CanPort
from kontronik_can_gw.runtime.socketcan_port import open_socketcan

log = logging.getLogger("kontronik_can_gw")


def check_interface(config: CanConfig) -> None:
    """UserError for an interface that python-can does not know."""
    if config.interface == "socketcan":
        if config.options:
            log.warning("can.options: SocketCAN takes none, they are ignored. Leave them out.")
        return
    with without_asammdf():
        import can
    if config.interface not in can.VALID_INTERFACES:
        hint = did_you_mean(config.interface, sorted(can.VALID_INTERFACES), or_known=True)
        raise UserError(f"can.interface: {config.interface!r} is no interface of python-can.{hint}")


def open_can(config: CanConfig) -> CanPort:
    """Open an interface. RunError with one clear line where it cannot be opened, or is down."""
    if config.interface == "socketcan":
        return open_socketcan(config)
    check_interface(config)
    with without_asammdf():
        import can

        from kontronik_can_gw.runtime.driver_port import DriverPort
    options: dict[str, Any] = {"bitrate": config.bitrate}
    if config.fd:
        options |= {"fd": True, "data_bitrate": config.data_bitrate}
    options.update(config.options)
    try:
        return DriverPort(can.Bus(interface=config.interface, channel=config.channel, **options))
    except Exception as error:  # each of python-can's drivers fails in its own ways, a missing vendor library as NameError
        raise RunError(
            f"CAN {config.interface} {config.channel}: cannot be opened: {error}"
        ) from None
