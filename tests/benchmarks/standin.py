"""Starts a gateway on a bus without a CAN interface, for kernels that have no CAN.

    python standin.py NAME ours run -c FILE      the command line of the real gateway
    python standin.py NAME obvious DBC lo PORT...

Each CAN socket is replaced by a local socket that is connected to the feeder. Only the creation of
the socket and its options are replaced. ``send`` and ``recv`` are still the C methods. Frames have
the bytes of a raw CAN socket, and the local socket keeps them separate.
"""

import math
import os
import socket
import sys
from pathlib import Path
from typing import Any


class BusSocket(socket.socket):
    """A socket that is connected to the feeder by ``bind`` if a CAN socket is requested."""

    name = ""

    def __init__(
        self,
        family: int = -1,
        kind: int = -1,
        *further: Any,
        **named: Any,
    ) -> None:
        self.is_bus = family == socket.AF_CAN
        if self.is_bus:
            super().__init__(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        else:
            super().__init__(family, kind, *further, **named)

    def bind(self, address: Any, /) -> None:
        if self.is_bus:
            self.connect("\0" + self.name)
        else:
            super().bind(address)

    def setsockopt(self, *args: Any) -> None:
        if not self.is_bus:
            # the options are for CAN only, and all programs have a queue of the same length
            super().setsockopt(*args)


def open_count(name: str) -> int:
    """Open a file that begins with a growing number, as the count of sent frames of an interface.

    It is the processor time of this process.
    """
    return os.open("/proc/self/schedstat", os.O_RDONLY)


def use(bus: str) -> None:
    """Connect all further CAN sockets of this process to ``bus``."""
    BusSocket.name = bus
    socket.socket = BusSocket  # type: ignore[assignment, misc]


def main(arguments: list[str]) -> int:
    bus, program, *rest = arguments
    use(bus)
    sys.path[:0] = [
        str(Path(__file__).resolve().parents[2]),
        str(Path(__file__).resolve().parent / "peers"),
    ]
    if program == "obvious":
        # with asammdf, the start of python-can takes seconds
        sys.modules["asammdf"] = None  # type: ignore[assignment]
        import obvious

        obvious.main(rest)
        return 0
    from kontronik_can_gw.cli import main as run
    from kontronik_can_gw.dbc import prepare
    from kontronik_can_gw.runtime.can import socketcan_port
    from kontronik_can_gw.runtime.system import locks

    socketcan_port._open_count = open_count
    prepare.REFUSE_LOAD = math.inf  # 64 ESCs need more than one bus can carry
    # other benchmarks may run at the same time on other buses
    locks.PREFIX += f"bench/{os.getpid()}/"
    return run(rest)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
