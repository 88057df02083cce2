"""Opens the bus of the slave under test, and reads its EDS."""

import io
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.desk.conformance.slave import NoAnswer, Slave
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.light_imports import without_asammdf
from kontronik_can_gw.runtime.can.open_can import open_can


@contextmanager
def slave_on_bus(
    interface: str, channel: str, node_id: int, eds: Path, limit_s: float
) -> Iterator[Slave]:
    """Open the bus and read the EDS.

    Raises UserError for an EDS that cannot be read, and RunError if the bus cannot be opened or the
    slave does not answer.
    """
    try:
        text = eds.read_text(encoding="latin-1")
    except OSError as error:
        raise UserError(f"{eds}: cannot be read: {error.strerror}.") from None
    with without_asammdf():
        import can
        import canopen
    # the items judge the values of the EDS themselves
    logging.getLogger("canopen").addHandler(logging.NullHandler())
    try:
        named = io.StringIO(text)
        named.name = eds.name
        dictionary = canopen.import_od(named, node_id)
    except Exception as error:  # the library raises exceptions of any kind
        raise UserError(f"{eds}: is not a valid EDS: {error}.") from None
    if 0x1000 not in dictionary:
        raise UserError(f"{eds}: does not have the object 1000h, so it is not an EDS.")
    open_can(CanConfig(interface=interface, channel=channel)).close()  # raises with a remedy
    try:
        bus = can.Bus(interface=interface, channel=channel)
    except Exception as error:  # the drivers raise exceptions of any kind
        raise RunError(f"CAN {channel}: cannot be opened: {error}.") from None
    with bus:
        slave = Slave(bus, node_id, dictionary, text, limit_s)
        try:
            slave.read(0x1000)
        except NoAnswer:
            raise RunError(
                f"node {node_id} on {channel}: does not answer. Is it on this bus, and is "
                "the bit rate right?"
            ) from None
        yield slave
