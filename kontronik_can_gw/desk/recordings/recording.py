"""What every recording is: CAN frames in order of time, and rows of values by name, many at once."""

from abc import ABC, abstractmethod
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import cached_property
from itertools import chain, groupby, islice, takewhile
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeAlias

from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.desk.recordings.fields import Field, fields_of_values
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.recordings.stream import Stream
from kontronik_can_gw.desk.words import duration
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.signals.unpacker import SignalReader, Value

if TYPE_CHECKING:
    from kontronik_can_gw.native.offline import Frames, Rows

Batch: TypeAlias = "list[TimedFrame] | list[LogFrame] | Frames"
"""Frames in their order; ``Frames`` were all sent."""
ERROR = 0x20000000
"""Marks the id of an error frame, as SocketCAN does. No other id has this bit."""
LATEST_NS = 1 << 62
"""No time of a recording, and no Unix time (2116), is later: it is damaged."""
ROWS = 512
"""Rows that Python makes a block of. More of them need more time, because they leave the cache."""
_LISTED_STEPS = 3
_DISORDER_NS = 1_000_000_000
"""How far frames of several interfaces may stand out of order."""


class LogFrame(NamedTuple):
    """A frame of a CAN log, which may be a remote frame or an error frame, too.

    ``channel``: its name or number; empty for the gateway's own bus. ``received``: None if the log
    does not state a direction. The id of an error frame is ERROR and SocketCAN's class of the
    error, if the log has it.
    """

    time_ns: int
    frame: CanFrame
    received: bool | None = False
    channel: str = ""

    @property
    def kind(self) -> str:
        """What it is, for counts that people read."""
        if self.frame.can_id & ERROR:
            return "error frame"
        return "remote frame" if self.frame.remote else "CAN frame"


class ClockStep(NamedTuple):
    """A jump of the wall clock while the recording was made.

    ``time_ns``: the recording's time of the first frame after it. ``by_ns``: its size, negative if
    the clock was set back. ``is_kept``: the times of the recording jump with it.
    """

    time_ns: int
    by_ns: int
    is_kept: bool = False


class Sample(NamedTuple):
    """A row. ``values``: in the order of the columns."""

    time_ns: int
    values: tuple[Value, ...]


class Block:
    """Rows as columns. ``times``: ns of the recording's clock, which do not decrease; with ``wall_ns`` added they are Unix times."""

    def __init__(
        self, times: Sequence[int], columns: Sequence[Sequence[Any]], wall_ns: int | None
    ) -> None:
        self.times = times
        self.wall_ns = wall_ns
        self._columns = columns

    def __len__(self) -> int:
        return len(self.times)

    @property
    def columns(self) -> Sequence[Sequence[Any]]:
        """Values of each column, None where not available."""
        return self._columns

    def part(self, begin: int, end: int) -> "Block":
        """Some of the rows."""
        if (begin, end) == (0, len(self)):
            return self
        columns = [column[begin:end] for column in self._columns]
        return Block(self.times[begin:end], columns, self.wall_ns)

    def between(self, low_ns: int, high_ns: int) -> Self:
        """The rows from one time to another, both included."""
        found: Self = between(self, low_ns, high_ns)
        return found

    def rows(self) -> Iterator[Sample]:
        """The rows one by one."""
        return map(Sample, self.times, zip(*self.columns, strict=True))


class PlayedBlock(Block):
    """Rows ``begin`` to ``end`` of what the core in C made."""

    def __init__(self, rows: "Rows", begin: int, end: int, wall_ns: int | None) -> None:
        super().__init__(rows.times[begin:end], (), wall_ns)
        self.made, self.begin, self.end = rows, begin, end

    @cached_property
    def columns(self) -> Sequence[Sequence[Any]]:
        found: list[Sequence[Any]] = []
        for number, (value, _) in enumerate(self.made.columns):
            numbers: list[Any] = self.made.numbers(number, self.begin, self.end)
            found.append([*map(value.names.get, numbers)] if value.names else numbers)
        return found

    def part(self, begin: int, end: int) -> "PlayedBlock":
        return PlayedBlock(self.made, self.begin + begin, self.begin + end, self.wall_ns)


class Input(ABC):
    """A recording. Each of ``frames``, ``blocks``, ``esc_bytes`` reads it from its beginning, a stream only once.

    ``damage`` has a line for each part that is not intact. It is complete after the recording was read to its end.
    """

    stream: Stream | None = None
    """The pipe from which it is read as data arrive: blocks and batches are then returned as soon as they are complete."""

    def __init__(self, name: str, bus: BusLayout) -> None:
        self.name = name
        self.bus = bus
        self.provenance: dict[str, str] = {}
        """What is known of where it came from, in words; ``times`` where these are assumed."""
        self.damage: list[str] = []
        self.others = 0
        """CAN frames that the layout does not have; complete when it was read to the end."""
        self.refusal: UserError | None = None
        """The error for a file that turned out to be no recording, once it was read to its end."""
        self.begin_ns = 0
        """Time 0 of the output, from which ``clock_notes`` count. Set by the conversion."""
        self.resources = ExitStack()
        """Closed with the recording."""

    @property
    def clock_steps(self) -> Sequence[ClockStep]:
        """Where the wall clock was set; complete when the recording has been read to its end."""
        return ()

    @property
    def clock_notes(self) -> list[str]:
        """One line for each kind of clock step, with its times and sizes; empty if there is none."""
        return _described(self.clock_steps, self.begin_ns)

    @property
    def without_data(self) -> Mapping[str, int]:
        """Number of error frames and of remote frames by ``LogFrame.kind``, as far as it was read."""
        return {}

    @property
    def left_out(self) -> str:
        """Which frames are not part of tables, pages and screens; empty if all are."""
        parts = []
        if self.others:
            file = Path(self.bus.layout.file).name
            parts.append(
                f"{self.others} CAN frames left out that {file} does not have (-c or --dbc gives another)"
            )
        if counts := [counted(number, kind) for kind, number in self.without_data.items()]:
            parts.append(f"{' and '.join(counts)} left out")
        return "; ".join(parts)

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
        """The columns of the rows: values by name."""
        return fields_of_values(self.bus.escs)

    def select_channel(self, name: str) -> None:
        """Read only one channel of a CAN log. UserError for other recordings."""
        raise UserError(
            f"{self.name}: is no CAN log, so --channel {name} means nothing. Leave it out."
        )

    @abstractmethod
    def frames(self) -> Iterator[TimedFrame]:
        """The CAN frames of one bus that were sent (or would have been) and received."""

    @abstractmethod
    def batches(self) -> "Iterator[Batch]":
        """The frames for a log, many at once: all channels, unless one was selected."""

    def blocks(self, chosen: Sequence[int] | None = None) -> Iterator[Block]:
        """Rows of the values of ``chosen`` fields, in that order; None: of all."""
        samples = self.samples_in_python(range(len(self.fields)) if chosen is None else chosen)
        # with each row, because a clock that was set later must not move the rows before it
        found = ((self.wall_offset_ns(row.time_ns), *row) for row in samples)
        while some := list(islice(found, ROWS if self.stream is None else 1)):
            for wall_ns, rows in groupby(some, itemgetter(0)):
                _, times, values = zip(*rows, strict=True)
                yield Block(times, [*zip(*values, strict=True)], wall_ns)

    def samples(self, chosen: Sequence[int] | None = None) -> Iterator[Sample]:
        """The rows one by one."""
        for block in self.blocks(chosen):
            yield from block.rows()

    @abstractmethod
    def samples_in_python(self, chosen: Sequence[int]) -> Iterator[Sample]:
        """The rows one by one, whatever core there is."""

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
        with self.resources:
            self.close()

    def wall_offset_ns(self, time_ns: int) -> int | None:
        """Unix time minus the recording's own time at ``time_ns``. None if the time of day is unknown."""
        wall_ns = self.wall_ns(time_ns)
        return None if wall_ns is None else wall_ns - time_ns


def counted(count: int, noun: str) -> str:
    """A number with its noun: "1 row", "2 rows"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _described(steps: Sequence[ClockStep], begin_ns: int) -> list[str]:
    kept = [step for step in steps if step.is_kept]
    hidden = [step for step in steps if not step.is_kept]
    notes = []
    if hidden:
        listed = [
            ("back " if step.by_ns < 0 else "ahead ") + _by_and_after(step, step.time_ns - begin_ns)
            for step in hidden
        ]
        notes.append(f"the clock was set {_some_of(listed)}; times continue without the step")
    if kept:
        # the time in front of the jump: the one behind it contains the jump
        listed = [_by_and_after(step, step.time_ns - step.by_ns - begin_ns) for step in kept]
        notes.append(
            f"times jump ahead {_some_of(listed)}: a pause, or the clock was set; the jump is kept"
        )
    return notes


def _by_and_after(step: ClockStep, elapsed_ns: int) -> str:
    """The size of a step, and the time since the beginning of the recording in front of it."""
    return f"by {duration(abs(step.by_ns))} after {duration(elapsed_ns)}"


def _some_of(listed: list[str]) -> str:
    more = len(listed) - _LISTED_STEPS
    return ", ".join(listed[:_LISTED_STEPS]) + (f" and {more} more times" if more > 0 else "")


def timed(frames: "Frames | list[TimedFrame]") -> Iterator[TimedFrame]:
    """The frames one by one."""
    if isinstance(frames, list):
        return iter(frames)
    return (TimedFrame(time_ns, frame) for time_ns, frame in frames)


def time_at(items: Any, index: int) -> int:
    """Time of one of a Block, Frames or a list of TimedFrames."""
    found: int = items[index].time_ns if isinstance(items, list) else items.times[index]
    return found


def between(items: Any, low_ns: int, high_ns: int) -> Any:
    """Those of a Block, Frames or a list of TimedFrames that are from one time to another, both included."""
    if isinstance(items, list):
        return [one for one in items if low_ns <= one.time_ns <= high_ns]
    begin = bisect_left(items.times, low_ns)
    return items.part(begin, max(begin, bisect_right(items.times, high_ns)))


def part_of(
    items: Iterable[Any], start_ns: int | None, end_ns: int | None
) -> tuple[int, Iterator[Any]] | None:
    """What of Blocks, or of batches of frames, is from one time after their begin to another, both included (None: no limit).

    With the time at which they begin. None where there is nothing.
    """
    filled = filter(len, items)
    if (first := next(filled, None)) is None:
        return None
    origin_ns = time_at(first, 0)
    if isinstance(first, list):  # frames of a log, which may be out of order
        origin_ns = min(item.time_ns for item in first)
    low = -LATEST_NS if start_ns is None else origin_ns + start_ns
    high = LATEST_NS if end_ns is None else origin_ns + end_ns
    wanted = takewhile(
        lambda some: time_at(some, 0) <= high + _DISORDER_NS, chain((first,), filled)
    )
    part = filter(len, (between(some, low, high) for some in wanted))
    if (first := next(part, None)) is None:
        return None
    return origin_ns, chain((first,), part)
