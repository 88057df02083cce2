"""Opens the CAN interface that the configuration names: any of python-can's, SocketCAN by a socket of our own."""

from typing import Any

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.errors import RunError, UserError, did_you_mean
from kontronik_can_gw.lean import without_asammdf
from kontronik_can_gw.runtime.can_port import CanPort
from kontronik_can_gw.runtime.socketcan_port import (
    SocketCanPort,
    check_socketcan,
    open_socketcan,
    socketcan_error,
)


def check_interface(config: CanConfig) -> None:
    """UserError for an interface that python-can does not know."""
    if config.interface == "socketcan":
        return
    with without_asammdf():
        import can
    if config.interface not in can.VALID_INTERFACES:
        hint = did_you_mean(config.interface, sorted(can.VALID_INTERFACES), or_known=True)
        raise UserError(f"can.interface: {config.interface!r} is no interface of python-can.{hint}")


def open_can(config: CanConfig) -> CanPort:
    """Open an interface. RunError with one clear line where it cannot be opened, or is down."""
    is_socketcan = config.interface == "socketcan"
    if is_socketcan:
        check_socketcan(config)
        if not config.options:
            return open_socketcan(config)
    bus = _open_bus(config)
    if is_socketcan:
        return SocketCanPort(bus.socket, bus.shutdown)
    from kontronik_can_gw.runtime.driver_port import DriverPort

    return DriverPort(bus)


def _open_bus(config: CanConfig) -> Any:
    """A bus of python-can. RunError where that fails."""
    with without_asammdf():
        import can

    check_interface(config)
    is_socketcan = config.interface == "socketcan"
    options: dict[str, Any] = {} if is_socketcan else {"bitrate": config.bitrate}
    if config.fd:
        options["fd"] = True
        if not is_socketcan:
            options["data_bitrate"] = config.data_bitrate
    options.update(config.options)
    try:
        return can.Bus(interface=config.interface, channel=config.channel, **options)
    except Exception as error:  # each of python-can's drivers fails in its own ways, a missing vendor library as NameError
        if is_socketcan and isinstance(error, OSError):
            raise socketcan_error(config, error.errno or 0, error.strerror or str(error)) from None
        raise RunError(
            f"CAN {config.interface} {config.channel}: cannot be opened: {error}"
        ) from None
