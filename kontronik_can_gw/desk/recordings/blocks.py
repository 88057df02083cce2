"""Recordings by the core in C: rows and frames in blocks (native/offline.py), where there is one.

They are the same as samples.py and capture/replay.py give one by one.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.desk.recordings.columns import Values, values_of_fields
from kontronik_can_gw.desk.recordings.fields import Field
from kontronik_can_gw.esc.telemetry import SECOND, EscSettings
from kontronik_can_gw.gateway import Gateway, MakeOutput
from kontronik_can_gw.native import load
from kontronik_can_gw.signals.plan import Layout

if TYPE_CHECKING:
    from kontronik_can_gw.native.offline import Frames, Rows
    from kontronik_can_gw.native.player import Player

LATEST_NS = 1 << 63
"""Later than any time of a recording."""
DISORDER_NS = SECOND
"""Frames of several interfaces may stand in a log a little out of order."""
NO_MESSAGES = Layout("", "", ())
MakeGateway = Callable[[Sequence[MakeOutput]], Gateway]
"""Outputs besides to a gateway."""


def player_of(
    make: MakeGateway, fields: Sequence[Field] | None, escs: Sequence[EscSettings], now: int
) -> "tuple[Player, Gateway] | None":
    """What plays a recording at once, for rows of ``fields`` or for frames (None), and the gateway that it plays. None: Python must."""
    if load.library()[0] is None:
        return None
    from kontronik_can_gw.native.offline import ColumnOf
    from kontronik_can_gw.native.player import Player
    from kontronik_can_gw.native.rows import NotInCore

    columns = None
    if fields is not None:
        columns = [ColumnOf(value, field.esc) for field, value in values_of_fields(fields, escs)]
    player = Player(columns)
    outputs: Sequence[MakeOutput] = () if fields is None else (lambda *_: player,)
    gateway = make(outputs)
    if gateway.core.language != "C":
        return None
    try:
        player.bind(cast(Any, gateway.core), now)
    except NotInCore:
        return None
    return player, gateway


@dataclass(frozen=True)
class RowBlock:
    """Rows ``begin`` to ``end`` of ``rows``. Their times count from ``origin_ns``; with ``wall_ns`` added they are Unix times."""

    rows: "Rows"
    begin: int
    end: int
    origin_ns: int = 0
    wall_ns: int | None = None

    def __len__(self) -> int:
        return self.end - self.begin

    @property
    def times(self) -> Any:
        """In ns of the recording's clock; they do not decrease."""
        return self.rows.times[self.begin : self.end]

    def between(self, start_ns: int | None, end_ns: int | None) -> "RowBlock":
        """Its rows in a stretch of time; ``end_ns`` included, both count from the origin."""
        begin, end = _between(self.times, start_ns, end_ns, self.origin_ns)
        return replace(self, begin=self.begin + begin, end=self.begin + end)

    def values(self) -> Iterator[tuple[int, Values]]:
        """Time and values of each row."""
        columns: list[Sequence[Any]] = []
        for number, (value, _) in enumerate(self.rows.columns):
            numbers: list[Any] = self.rows.numbers(number, self.begin, self.end)
            columns.append([*map(value.names.get, numbers)] if value.names else numbers)
        return zip(self.times, zip(*columns, strict=True), strict=True)


def _between(
    times: Any, start_ns: int | None, end_ns: int | None, origin_ns: int
) -> tuple[int, int]:
    begin = 0 if start_ns is None else bisect_left(times, start_ns + origin_ns)
    end = len(times) if end_ns is None else bisect_right(times, end_ns + origin_ns)
    return begin, max(begin, end)


def time_at(frames: "Frames | list[TimedFrame]", index: int) -> int:
    """Time of one of the frames, ns."""
    found: int = frames[index].time_ns if isinstance(frames, list) else frames.times[index]
    return found


def cut(
    batches: "Iterator[Frames | list[TimedFrame]]",
    start_ns: int | None,
    end_ns: int | None,
    origin_ns: int,
) -> "Iterator[Frames | list[TimedFrame]]":
    """The frames from one time to another, both after ``origin_ns``; ``end_ns`` included. No batch is empty."""
    low = -LATEST_NS if start_ns is None else start_ns + origin_ns
    high = LATEST_NS if end_ns is None else end_ns + origin_ns
    for frames in batches:
        if time_at(frames, 0) > high + DISORDER_NS:
            return
        if isinstance(frames, list):
            found: Any = [one for one in frames if low <= one.time_ns <= high]
        else:
            found = frames.part(*_between(frames.times, start_ns, end_ns, origin_ns))
        if len(found):
            yield found


def timed(frames: "Frames | list[TimedFrame]") -> Iterator[TimedFrame]:
    """The frames one by one."""
    if isinstance(frames, list):
        return iter(frames)
    return (TimedFrame(time_ns, frame) for time_ns, frame in frames)
