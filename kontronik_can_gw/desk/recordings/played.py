"""Plays recorded bytes of ESCs through the gateway's core.

The C core plays them at full speed (player.py). The Python core is used if the C core is not
available.
"""

from abc import abstractmethod
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import groupby, islice, pairwise
from operator import itemgetter
from typing import TYPE_CHECKING, Any, cast

from kontronik_can_gw.assembly.capture_setup import CaptureSetup
from kontronik_can_gw.capture.format import Entry
from kontronik_can_gw.core.output import Output, OutputHost
from kontronik_can_gw.core.output_setup import OutputMaker, ReadyOutput
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.desk.recordings.fields import TableColumn
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.recordings.recording import (
    ROWS,
    Input,
    PlayedBlock,
    RowBlock,
    Sample,
    timed,
)
from kontronik_can_gw.desk.recordings.replay import TimedFrame
from kontronik_can_gw.desk.recordings.samples import RowMaker
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.native import load
from kontronik_can_gw.signals.plan import MessageLayout

if TYPE_CHECKING:
    from kontronik_can_gw.desk.recordings.offline import Frames, Rows
    from kontronik_can_gw.desk.recordings.player import Player

NO_MESSAGES = MessageLayout("", "", ())


class _RowOutput:
    """Makes the output that forms rows of ``fields``, and keeps it as ``maker``."""

    slots = 0

    def __init__(self, fields: Sequence[TableColumn]) -> None:
        self._fields = fields
        self.maker: RowMaker

    def make(self, host: OutputHost, now: int) -> Output:
        self.maker = RowMaker(self._fields, host.escs, host.status, now)
        return self.maker


class PlayedInput(Input):
    """Bytes of ESCs that are played through a gateway.

    ``sent_layout`` is the layout of the gateway's frames. The layout of the rows, ``bus``, may
    differ from it.
    """

    created_ns = 0
    """Time at which the gateway was made. Its cycles count from this time."""
    is_marked = False
    """True if the gateway's state in the frames is REPLAY."""

    def __init__(self, name: str, bus: BusLayout, setup: CaptureSetup) -> None:
        super().__init__(name, bus)
        self.setup = setup
        self.sent_layout = bus.layout
        self._offsets: list[tuple[int, int]] = []
        """Time since which an offset applies, and the offset, in the order of time.

        The offset is Unix time minus the recording's time.
        """

    @abstractmethod
    def entries(self) -> Iterator[Entry]:
        """Yield the recorded entries in their order. Plain bytes are entries at assumed times."""

    @abstractmethod
    def _play(
        self, gateway: Gateway, player: "Player | None" = None
    ) -> "Iterator[list[TimedFrame] | Frames]":
        """Play the recording on a gateway, or on the player of its core.

        Yields the CAN frames that were sent and received.
        """

    def frames(self) -> Iterator[TimedFrame]:
        for frames in self.batches():
            yield from timed(frames)

    def batches(self) -> "Iterator[list[TimedFrame] | Frames]":
        def make(_: Sequence[OutputMaker] = ()) -> Gateway:
            return self.setup.gateway(self.sent_layout, self.created_ns)

        if not self.setup.outputs:
            played = self._player_of(make, None)
            if played is not None:
                return self._play(*played)
        return self._play(make())

    def blocks(self, chosen: Sequence[int] | None = None) -> Iterator[RowBlock]:
        fields = self.fields
        if chosen is not None:
            fields = [self.fields[index] for index in chosen]
        found = self._player_of(self._silent_gateway, fields)
        if found is None:
            return self._blocks_in_python(fields)
        return self._played(*found)

    def _blocks_in_python(self, fields: Sequence[TableColumn]) -> Iterator[RowBlock]:
        """Yield the rows that the core in Python makes."""
        # the offset is taken with each row, so that a later clock step does not move earlier rows
        rows = (
            ((self.wall_offset_ns(row.time_ns), self.trust.at(row.time_ns)), *row)
            for row in self._samples_in_python(fields)
        )
        size = ROWS if self.stream is None else 1
        while some := list(islice(rows, size)):
            for (wall_ns, is_trusted), group in groupby(some, itemgetter(0)):
                _, times, values = zip(*group, strict=True)
                columns = [*zip(*values, strict=True)]
                yield RowBlock(times, columns, wall_ns, is_trusted)

    def _samples_in_python(self, fields: Sequence[TableColumn]) -> Iterator[Sample]:
        rows = _RowOutput(fields)
        for _ in self._play(self._silent_gateway((rows,))):
            yield from rows.maker.take_rows()
        yield from rows.maker.finish()

    def _played(self, gateway: Gateway, player: "Player") -> Iterator[RowBlock]:
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

    def _timed(self, rows: "Rows", begin: int) -> Iterator[RowBlock]:
        """Yield the rows from ``begin`` in blocks during which the wall clock was not set."""
        edges = {begin, rows.count}
        for since_ns, _ in self._offsets:
            edges.add(max(begin, bisect_left(rows.times, since_ns)))
        for first, end in pairwise(sorted(edges)):
            time_ns = rows.times[first]
            is_trusted = self.trust.at(time_ns)
            yield PlayedBlock(rows, first, end, self.wall_offset_ns(time_ns), is_trusted)

    def _silent_gateway(self, readers: Sequence[OutputMaker]) -> Gateway:
        """Return a gateway without messages, whose outputs include ``readers``.

        Recorded outputs are there if they may have changed pole pairs and gear.
        """
        # Names, pole pairs and gears at the start are those of the layout that is shown.
        escs = [
            replace(own, name=shown.name, pole_pairs=shown.pole_pairs, gear=shown.gear)
            for own, shown in zip(self.setup.escs, self.bus.escs, strict=True)
        ]
        changing = [setup for setup in self.setup.outputs if setup.changes_escs]
        return Gateway(
            CoreSettings(escs, NO_MESSAGES), self.created_ns, outputs=[*changing, *readers]
        )

    def _player_of(
        self, make: Callable[[Sequence[OutputMaker]], Gateway], fields: Sequence[TableColumn] | None
    ) -> "tuple[Gateway, Player] | None":
        """Return a gateway and the player of its C core. None if only the Python core can play it.

        The player makes rows of ``fields``, or frames if ``fields`` is None.
        """
        if self.setup.version == 1 or load.library()[0] is None:
            return None
        from kontronik_can_gw.desk.recordings.offline import ColumnOf
        from kontronik_can_gw.desk.recordings.player import Player
        from kontronik_can_gw.native.rows import NotInCore

        if fields is None:
            player = Player(None)
            gateway = make(())
        else:
            columns = [ColumnOf(cast(Any, field.value), field.esc) for field in fields]
            player = Player(columns)
            gateway = make((ReadyOutput(player),))
        if gateway.core.language != "C":
            return None
        try:
            player.bind(cast(Any, gateway.core), self.created_ns)
        except NotInCore:
            return None
        return gateway, player
