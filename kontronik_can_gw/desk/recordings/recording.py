"""What every recording is: CAN frames in order of time, and rows of values by name."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Self

from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.desk.recordings.blocks import RowBlock, timed
from kontronik_can_gw.desk.recordings.columns import fields_of_values
from kontronik_can_gw.desk.recordings.fields import Field
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.recordings.samples import Sample
from kontronik_can_gw.signals.unpacker import SignalReader

if TYPE_CHECKING:
    from kontronik_can_gw.native.offline import Frames

CHUNK = 1 << 16


class Input(ABC):
    """A recording. Each of ``frames``, ``samples``, ``esc_bytes`` reads it from its beginning.

    ``position``: bytes read so far, of ``size``. ``damage`` (what was not intact) and ``notes`` (what the person should know of how
    it was read) have a line each and are complete when it was read to the end.
    """

    def __init__(self, name: str, bus: BusLayout, size: int) -> None:
        self.name = name
        self.bus = bus
        self.size = size
        self.position = 0
        self.provenance: dict[str, str] = {}
        """What is known of where it came from, in words."""
        self.damage: list[str] = []
        self.notes: list[str] = []
        self.times_assumed = False
        """True where the recording has no times."""

    @property
    def channel(self) -> str:
        """The CAN channel that was sent on, where it is known."""
        return "can0"

    @cached_property
    def reader(self) -> SignalReader:
        """Reads frames of ``bus``."""
        return SignalReader(self.bus.layout)

    @cached_property
    def fields(self) -> Sequence[Field]:
        """The columns of the samples: values by name."""
        return fields_of_values(self.bus.escs)

    def frames(self) -> Iterator[TimedFrame]:
        """The CAN frames that were sent (or would have been) and received."""
        for frames in self.batches():
            yield from timed(frames)

    @abstractmethod
    def batches(self) -> "Iterator[list[TimedFrame] | Frames]":
        """The same frames, many at once; ``Frames`` were all sent."""

    def samples(self, chosen: Sequence[int] | None = None) -> Iterator[Sample]:
        """Rows of the values of ``chosen`` fields, in that order; None: of all."""
        blocks = self.blocks(chosen)
        if blocks is None:
            yield from self.samples_in_python(chosen)
        else:
            for block in blocks:
                yield from map(Sample._make, block.values())

    @abstractmethod
    def samples_in_python(self, chosen: Sequence[int] | None = None) -> Iterator[Sample]:
        """The rows of ``samples``, whatever core there is."""

    def blocks(self, chosen: Sequence[int] | None = None) -> Iterator[RowBlock] | None:  # noqa: ARG002
        """The rows of ``samples``, many at once; None where they can only be had one by one."""
        return None

    @abstractmethod
    def esc_bytes(self, esc: int) -> Iterator[bytes]:
        """The UART bytes of one ESC. UserError where the recording has none."""

    @abstractmethod
    def wall_ns(self, time_ns: int) -> int | None:
        """Unix time, where it is known."""

    def close(self) -> None:  # noqa: B027  only some have any
        """Close the files."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _chosen(self, chosen: Sequence[int] | None) -> Sequence[int]:
        return range(len(self.fields)) if chosen is None else chosen
