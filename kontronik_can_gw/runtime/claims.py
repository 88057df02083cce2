"""What only one gateway on this machine may have: a CANopen node-ID, and the DBC's messages, on one CAN interface.

A claim is an abstract Unix socket that nobody can connect to: it is in the network namespace that the interface is in too, needs no
file and no right, and ends with the process whatever ends it.
"""

import contextlib
import errno
import socket
from collections.abc import Iterable

from kontronik_can_gw.errors import RunError

PREFIX = "kontronik-can-gw/"
_LONGEST_NAME = 107


def node_claim(channel: str, node_id: int) -> str:
    """The name of the claim to a node-ID."""
    return f"{channel}/node/{node_id}"


def messages_claim(channel: str, first_id: int) -> str:
    """The name of the claim to the DBC output whose lowest CAN id this is."""
    return f"{channel}/messages/{first_id:X}"


class Claims:
    """The claims of one process; they end by ``close`` and with the process."""

    def __init__(self) -> None:
        self._held: dict[str, socket.socket] = {}

    def hold(self, names: Iterable[str]) -> list[str]:
        """Have exactly these from now on. Returns those that another gateway has."""
        wanted = dict.fromkeys(names)
        for name in [held for held in self._held if held not in wanted]:
            self._held.pop(name).close()
        taken = []
        for name in wanted:
            if name in self._held:
                continue
            claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            try:
                claim.bind("\0" + PREFIX + _short(name))
            except OSError as error:
                claim.close()
                if error.errno == errno.EADDRINUSE:
                    taken.append(name)
                continue  # a system that allows no Unix sockets gives no protection, and no trouble
            # it is never read: what somebody sends to it must not pile up
            with contextlib.suppress(OSError):
                claim.shutdown(socket.SHUT_RD)
            self._held[name] = claim
        return taken

    def close(self) -> None:
        """Give everything back."""
        for claim in self._held.values():
            claim.close()
        self._held = {}


def _short(name: str) -> str:
    """A name that fits into an address: the channel of a long one in short."""
    if len(PREFIX + name) < _LONGEST_NAME:
        return name
    from hashlib import sha256  # which loads OpenSSL: 4 MB

    channel, what, number = name.rsplit("/", 2)
    return f"{sha256(channel.encode()).hexdigest()[:32]}/{what}/{number}"


def in_use(name: str) -> RunError:
    """What is said of a claim that another gateway has."""
    channel, what, number = name.rsplit("/", 2)
    if what == "node":
        return RunError(
            f"CANopen node {number} on {channel}: another gateway on this machine is this node. End it, or change canopen.node_id."
        )
    return RunError(
        f"CAN {channel}: another gateway on this machine sends the messages from {number}h on. End it, or change dbc.base_id."
    )
