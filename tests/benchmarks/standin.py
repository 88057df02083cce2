"""Starts a gateway on a bus that is no CAN interface, for kernels without one: each CAN socket is a local one that leads to the feeder.

    python standin.py NAME ours run -c FILE      the real gateway's own command line
    python standin.py NAME obvious DBC lo PORT...

Only how the socket is made, and its options, are replaced: ``send`` and ``recv`` are the C methods. Frames have the bytes of a raw CAN
socket, and the local socket keeps them apart.
"""

import math
import os
import socket
import sys
from pathlib import Path
from typing import Any


class BusSocket(socket.socket):
    """A socket that, where a CAN socket is asked for, is connected to the feeder when it is bound."""

    name = ""

    def __init__(self, family: int = -1, kind: int = -1, *further: Any) -> None:
        self.is_bus = family == socket.AF_CAN
        if self.is_bus:
            super().__init__(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        else:
            super().__init__(family, kind, *further)

    def bind(self, address: Any, /) -> None:
        if self.is_bus:
            self.connect("\0" + self.name)
        else:
            super().bind(address)

    def setsockopt(self, *args: Any) -> None:
        if not self.is_bus:
            # the options are of CAN; the queue's length is the same for all programs
            super().setsockopt(*args)


def use(bus: str) -> None:
    """From now on CAN sockets of this process lead to ``bus``."""
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
        sys.modules["asammdf"] = None  # type: ignore[assignment]  # where it is installed python-can takes seconds to start
        import obvious

        obvious.main(rest)
        return 0
    from kontronik_can_gw.cli import main as run
    from kontronik_can_gw.dbc import prepare
    from kontronik_can_gw.runtime.system import locks

    prepare.REFUSE_LOAD = math.inf  # 64 ESCs need several buses' worth
    locks.PREFIX += f"bench/{os.getpid()}/"  # other benchmarks may run beside this one, each on a bus of its own
    return run(rest)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
