"""Recordings of what ESCs sent are played through the gateway's core: the one in C at full speed (native/player.py), else Python's."""

from abc import abstractmethod
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, cast

from kontronik_can_gw.assembly.capture_setup import CaptureSetup
from kontronik_can_gw.capture.format import Entry
from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.core.output import Output, OutputHost
from kontronik_can_gw.core.output_setup import OutputMaker, ReadyOutput
from kontronik_can_gw.desk.recordings.fields import Field
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.recordings.recording import Block, Input, PlayedBlock, Sample, timed
from kontronik_can_gw.desk.recordings.samples import RowMaker
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.native import load
from kontronik_can_gw.signals.plan import Layout

if TYPE_CHECKING:
    from kontronik_can_gw.native.offline import Frames, Rows
    from kontronik_can_gw.native.player import Player

NO_MESSAGES = Layout("", "", ())


class _RowOutput:
    """Makes the output that forms rows of ``fields``, and keeps it as ``maker``."""

    slots = 0

    def __init__(self, fields: Sequence[Field]) -> None:
        self._fields = fields
        self.maker: RowMaker

    def make(self, host: OutputHost, now: int) -> Output:
        self.maker = RowMaker(self._fields, host.escs, host.status, now)
        return self.maker


class PlayedInput(Input):
    """Bytes of ESCs, played through a gateway. ``sent_layout``: of its frames; that of the rows, ``bus``, may be another one."""

    created_ns = 0
    """When the gateway was made: its cycles count from there."""
    marked = False
    """True: the gateway's state in the frames is REPLAY."""

    def __init__(self, name: str, bus: BusLayout, setup: CaptureSetup) -> None:
        super().__init__(name, bus)
        self.setup = setup
        self.sent_layout = bus.layout
        self._offsets: list[tuple[int, int]] = []
        """From when on, in the order of time, Unix time is so much more than the recording's."""

    @abstractmethod
    def entries(self) -> Iterator[Entry]:
        """What was recorded, in its order; of plain bytes these at their times."""

    @abstractmethod
    def _play(
        self, gateway: Gateway, player: "Player | None" = None
    ) -> "Iterator[list[TimedFrame] | Frames]":
        """Give all that was recorded to a gateway, or to the player of its core; the CAN frames that were sent and received."""

    def frames(self) -> Iterator[TimedFrame]:
        for frames in self.batches():
            yield from timed(frames)

    def batches(self) -> "Iterator[list[TimedFrame] | Frames]":
        def make(_: Sequence[OutputMaker] = ()) -> Gateway:
            return self.setup.gateway(self.sent_layout, self.created_ns)

        found = None if self.setup.outputs else self._player_of(make, None)
        return self._play(*(found or (make(),)))

    def samples_in_python(self, chosen: Sequence[int]) -> Iterator[Sample]:
        fields = [self.fields[index] for index in chosen]
        rows = _RowOutput(fields)
        for _ in self._play(self._silent_gateway((rows,))):
            yield from rows.maker.take_rows()
        yield from rows.maker.finish()

    def blocks(self, chosen: Sequence[int] | None = None) -> Iterator[Block]:
        fields = self.fields if chosen is None else [self.fields[index] for index in chosen]
        found = self._player_of(self._silent_gateway, fields)
        return super().blocks(chosen) if found is None else self._played(*found)

    def _played(self, gateway: Gateway, player: "Player") -> Iterator[Block]:
        done = 0
        for _ in self._play(gateway, player):
            if player.is_full:
                yield from self._timed(player.take_rows(), done)
                done = 0
            elif self.stream is not None:
                rows = player.rows_so_far()
                yield from self._timed(rows, done)
                done = rows.count
        yield from self._timed(player.take_rows(final=True), done)

    def _timed(self, rows: "Rows", begin: int) -> Iterator[Block]:
        """The rows from ``begin`` on, in blocks during which the wall clock was not set."""
        times, count = rows.times, rows.count
        cuts = {max(begin, bisect_left(times, since)) for since, _ in self._offsets}
        for first, end in pairwise(sorted({begin, count, *cuts})):
            wall_ns = self.wall_ns(times[first])
            yield PlayedBlock(rows, first, end, None if wall_ns is None else wall_ns - times[first])

    def _silent_gateway(self, readers: Sequence[OutputMaker]) -> Gateway:
        """Return a gateway without messages, whose outputs include ``readers``.

        Recorded outputs are there if they may have changed pole pairs and gear.
        """
        # the caller shows names, pole pairs and gears
        escs = [
            replace(own, name=shown.name, pole_pairs=shown.pole_pairs, gear=shown.gear)
            for own, shown in zip(self.setup.escs, self.bus.escs, strict=True)
        ]
        changing = [setup for setup in self.setup.outputs if setup.changes_escs]
        return Gateway(escs, NO_MESSAGES, self.created_ns, outputs=[*changing, *readers])

    def _player_of(
        self, make: Callable[[Sequence[OutputMaker]], Gateway], fields: Sequence[Field] | None
    ) -> "tuple[Gateway, Player] | None":
        """A gateway, and what plays it at once for rows of ``fields`` or for frames (None). None: Python must."""
        if self.setup.version == 1 or load.library()[0] is None:
            return None
        from kontronik_can_gw.native.offline import ColumnOf
        from kontronik_can_gw.native.player import Player
        from kontronik_can_gw.native.rows import NotInCore

        columns = None
        if fields is not None:
            columns = [ColumnOf(cast(Any, field.value), field.esc) for field in fields]
        player = Player(columns)
        gateway = make(() if fields is None else (ReadyOutput(player),))
        if gateway.core.language != "C":
            return None
        try:
            player.bind(cast(Any, gateway.core), self.created_ns)
        except NotInCore:
            return None
        return gateway, player
