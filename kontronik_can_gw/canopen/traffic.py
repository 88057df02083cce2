"""What CANopen nodes put on the bus, to be expected when all is well."""

from collections.abc import Iterator, Sequence

from kontronik_can_gw.canopen.node import Node
from kontronik_can_gw.node_state import UNCONFIGURED
from kontronik_can_gw.signals.plan import classic_bits


def frames_per_second(nodes: Sequence[Node]) -> float:
    """Frames of PDOs and heartbeats."""
    return sum(rate for _, rate in _traffic(nodes))


def bits_per_second(nodes: Sequence[Node]) -> float:
    """What these need on the bus, with the most stuffing."""
    return sum(classic_bits(size) * rate for size, rate in _traffic(nodes))


def _traffic(nodes: Sequence[Node]) -> Iterator[tuple[int, float]]:
    """Data bytes and frames a second of each message."""
    for node in nodes:
        if node.node_id == UNCONFIGURED:
            continue
        if period := node.dictionary.number(0x1017):
            yield 1, 1000 / period
        for tpdo in node.tpdos:
            yield 8, tpdo.rate_hz
