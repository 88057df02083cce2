"""Opens the bus of the slave under test."""

from collections.abc import Iterator
from contextlib import contextmanager

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.desk.conformance.eds_file import EdsFile
from kontronik_can_gw.desk.conformance.slave import NoAnswer, Slave
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.light_imports import without_asammdf
from kontronik_can_gw.runtime.can.open_can import open_can


@contextmanager
def slave_on_bus(
    interface: str, channel: str, node_id: int, eds: EdsFile, limit_s: float
) -> Iterator[Slave]:
    """Open the bus. Raises RunError if it cannot be opened or the slave does not answer."""
    open_can(CanConfig(interface=interface, channel=channel)).close()  # raises with a remedy
    with without_asammdf():
        import can
    try:
        bus = can.Bus(interface=interface, channel=channel)
    except Exception as error:  # the drivers raise exceptions of any kind
        raise RunError(f"CAN {channel}: cannot be opened: {error}.") from None
    with bus:
        slave = Slave(bus, node_id, eds, limit_s)
        try:
            slave.read(0x1000)
        except NoAnswer:
            raise RunError(
                f"node {node_id} on {channel}: does not answer. Is it on this bus, and is "
                "the bit rate right?"
            ) from None
        yield slave
