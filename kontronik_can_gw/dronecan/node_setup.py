"""The settings from which the DroneCAN nodes are made."""

from typing import Any, NamedTuple


class DronecanNodeSetup(NamedTuple):
    """The settings of one node."""

    node_id: int
    """0 if an allocation server chooses it."""
    name: str
    unique_id: bytes
    escs: tuple[int, ...]
    """The numbers of its ESCs."""


class Given(NamedTuple):
    """The data from which all nodes are made. A capture holds them."""

    table: Any
    """The DronecanConfig."""
    identity: bytes
    """A digest of the numbers that identify this machine. It is empty if there are none."""
    version: tuple[int, int]
    """Major and minor version of the program."""
    seed: int
    """A random number of 64 bits, chosen at each start."""
