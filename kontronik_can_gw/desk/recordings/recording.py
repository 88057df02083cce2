"""The interface of every recording: CAN frames in order of time, and rows of values by name."""

from abc import ABC, abstractmethod
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import cached_property
from itertools import chain, takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeAlias

from kontronik_can_gw.desk.receiver.unpacker import SignalReader, Value
from kontronik_can_gw.desk.recordings.fields import TableColumn, fields_of_values
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.recordings.replay import TimedFrame
from kontronik_can_gw.desk.recordings.stream import Stream
from kontronik_can_gw.desk.recordings.trusted_times import TrustedTimes
from kontronik_can_gw.desk.words import duration
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.printable import counted
from kontronik_can_gw.times import SECOND

if TYPE_CHECKING:
    from kontronik_can_gw.desk.recordings.offline import Frames, Rows

Batch: TypeAlias = "list[TimedFrame] | list[LogFrame] | Frames"
"""Frames in their order. The gateway sent all those of a ``Frames``."""
ERROR = 0x20000000
"""Marks the id of an error frame, as SocketCAN does. No other id has this bit."""
LATEST_NS = 1 << 62
"""Latest possible time of a recording, and latest Unix time (2116). Later times are damaged."""
ROWS = 512
"""Number of rows in a block that Python makes. Longer blocks are slower: they exceed the cache."""
_LISTED_STEPS = 3
"""Number of clock steps that are listed."""
_DISORDER_NS = SECOND
"""Frames of several interfaces may be this far out of order."""


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
        """The type of the frame, for counts that people read."""
        if self.frame.can_id & ERROR:
            return "error frame"
        if self.frame.remote:
            return "remote frame"
        return "CAN frame"


class ClockStep(NamedTuple):
    """A jump of the wall clock while the recording was made.

    ``time_ns``: the recording's time of the first frame after it. ``by_ns``: its size, negative if
    the clock was set back. ``is_kept``: the times of the recording jump with it.
    """

    time_ns: int
    by_ns: int
    is_kept: bool = False


class Sample(NamedTuple):
    """A row. ``values`` have the order of the columns."""

    time_ns: int
    values: tuple[Value, ...]


class RowBlock:
    """Rows, stored as columns.

    ``times`` are ns of the recording's clock and do not decrease. A time plus ``wall_ns`` is Unix
    time. ``wall_ns`` is None if the time of day is unknown. ``is_trusted`` is true while
    the clock was synchronised, and None if that is unknown.
    """

    def __init__(
        self,
        times: Sequence[int],
        columns: Sequence[Sequence[Any]],
        wall_ns: int | None,
        is_trusted: bool | None = None,
    ) -> None:
        self.times = times
        self.wall_ns = wall_ns
        self.is_trusted = is_trusted
        self._columns = columns

    def __len__(self) -> int:
        return len(self.times)

    @property
    def columns(self) -> Sequence[Sequence[Any]]:
        """Values of each column, None where not available."""
        return self._columns

    def part(self, begin: int, end: int) -> "RowBlock":
        """Return the rows from index ``begin`` up to ``end``, which is not included."""
        if (begin, end) == (0, len(self)):
            return self
        columns = [column[begin:end] for column in self._columns]
        return RowBlock(self.times[begin:end], columns, self.wall_ns, self.is_trusted)

    def between(self, low_ns: int, high_ns: int) -> Self:
        """Return the rows from one time to another, both included."""
        found: Self = between(self, low_ns, high_ns)
        return found


class PlayedBlock(RowBlock):
    """Rows ``begin`` to ``end`` of the ``Rows`` that the C core made."""

    def __init__(
        self,
        rows: "Rows",
        begin: int,
        end: int,
        wall_ns: int | None,
        is_trusted: bool | None = None,
    ) -> None:
        super().__init__(rows.times[begin:end], (), wall_ns, is_trusted)
        self.made = rows
        self.begin = begin
        self.end = end

    @cached_property
    def columns(self) -> Sequence[Sequence[Any]]:
        found: list[Sequence[Any]] = []
        for number, (value, _) in enumerate(self.made.columns):
            numbers: list[Any] = self.made.numbers(number, self.begin, self.end)
            if value.names:
                numbers = [*map(value.names.get, numbers)]
            found.append(numbers)
        return found

    def part(self, begin: int, end: int) -> "PlayedBlock":
        first = self.begin
        return PlayedBlock(
            self.made,
            first + begin,
            first + end,
            self.wall_ns,
            self.is_trusted,
        )


class Input(ABC):
    """A recording.

    1. ``frames``, ``blocks`` and ``esc_bytes`` each read it from its beginning.
    2. A recording that is a pipe can be read only once.
    3. ``damage`` has a line for each part that is not intact. It is complete after the recording
       was read to its end.
    """

    stream: Stream | None = None
    """The pipe from which the recording is read as data arrive.

    Blocks and batches of a pipe are returned as soon as they are complete.
    """

    def __init__(self, name: str, bus: BusLayout) -> None:
        self.name = name
        self.bus = bus
        self.provenance: dict[str, str] = {}
        """The known facts about its origin, as texts. ``times``: how times were assumed, if so."""
        self.damage: list[str] = []
        self.others = 0
        """Number of CAN frames that are not in the layout. Complete after the end was read."""
        self.refusal: UserError | None = None
        """The error for a file that proved to be no recording. Set after its end was read."""
        self.begin_ns = 0
        """Time 0 of the output, from which ``clock_notes`` count. Set by the conversion."""
        self.trust = TrustedTimes()
        """When the wall clock was synchronised. Complete after the end was read."""
        self.resources = ExitStack()
        """Resources that are closed with the recording."""

    @property
    def clock_steps(self) -> Sequence[ClockStep]:
        """The steps of the wall clock. Complete after the recording was read to its end."""
        return ()

    @property
    def clock_notes(self) -> list[str]:
        """A line for each kind of clock step, and one for times without synchronisation.

        Empty if the clock is not known to be wrong.
        """
        notes = _described(self.clock_steps, self.begin_ns)
        untrusted = list(self.trust.untrusted())
        if untrusted:
            notes.append(_described_trust(untrusted, self.begin_ns))
        return notes

    @property
    def notes(self) -> list[str]:
        """Lines about the recording that are no damage. Complete after the end was read."""
        return self.clock_notes

    @property
    def without_data(self) -> Mapping[str, int]:
        """Numbers of error frames and remote frames by ``LogFrame.kind``, of the part read."""
        return {}

    @property
    def left_out(self) -> str:
        """The frames that tables, pages and screens do not show, as a text. Empty without any."""
        parts = []
        if self.others:
            file = Path(self.bus.layout.file).name
            parts.append(
                f"{self.others} CAN frames left out that are not in {file} "
                "(for another DBC give -c or --dbc)"
            )
        counts = [counted(number, kind) for kind, number in self.without_data.items()]
        if counts:
            parts.append(f"{' and '.join(counts)} left out")
        return "; ".join(parts)

    @property
    def channel(self) -> str:
        """The CAN channel on which frames were sent. ``can0`` if it is unknown."""
        return "can0"

    @cached_property
    def reader(self) -> SignalReader:
        """The reader of the frames of ``bus``."""
        return SignalReader(self.bus.layout)

    @cached_property
    def fields(self) -> Sequence[TableColumn]:
        """The columns of the rows: values by name."""
        return fields_of_values(self.bus.escs)

    def select_channel(self, name: str) -> None:
        """Read only one channel of a CAN log. Raises UserError for other recordings."""
        raise UserError(
            f"{self.name}: is not a CAN log, so --channel {name} has no effect. Leave it out."
        )

    @abstractmethod
    def frames(self) -> Iterator[TimedFrame]:
        """Yield the CAN frames of one bus that were sent or received.

        They are the frames that would have been sent if only the ESCs' bytes were recorded.
        """

    @abstractmethod
    def batches(self) -> "Iterator[Batch]":
        """Yield the frames for a log in batches, of all channels unless one was selected."""

    @abstractmethod
    def blocks(self, chosen: Sequence[int] | None = None) -> Iterator[RowBlock]:
        """Yield rows of the values of the ``chosen`` fields, in that order. None: of all fields."""

    @abstractmethod
    def esc_bytes(self, esc: int) -> Iterator[bytes]:
        """Yield the UART bytes of one ESC. Raises UserError if the recording has no such bytes."""

    @abstractmethod
    def wall_ns(self, time_ns: int) -> int | None:
        """Return the Unix time at ``time_ns``. None if the time of day is unknown."""

    def close(self) -> None:  # noqa: B027  some recordings have no files
        """Close the files."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with self.resources:
            self.close()

    def wall_offset_ns(self, time_ns: int) -> int | None:
        """Return Unix time minus the recording's time at ``time_ns``. None if it is unknown."""
        wall_ns = self.wall_ns(time_ns)
        if wall_ns is None:
            return None
        return wall_ns - time_ns


def _described(steps: Sequence[ClockStep], begin_ns: int) -> list[str]:
    hidden = []
    kept = []
    for step in steps:
        elapsed_ns = step.time_ns - begin_ns
        if step.is_kept:
            elapsed_ns -= step.by_ns  # the time after the jump contains the jump
        about = f"by {duration(abs(step.by_ns))} after {duration(elapsed_ns)}"
        if step.is_kept:
            kept.append(about)
        else:
            hidden.append(f"{'back' if step.by_ns < 0 else 'ahead'} {about}")
    notes = []
    if hidden:
        notes.append(f"the clock was set {_some_of(hidden)}; times continue without the step")
    if kept:
        notes.append(
            f"times jump ahead {_some_of(kept)}: a pause, or the clock was set; the jump is kept"
        )
    return notes


def _described_trust(untrusted: Sequence[tuple[int, int | None]], begin_ns: int) -> str:
    """Describe the times in which the wall clock was not synchronised."""
    listed = []
    for since_ns, until_ns in untrusted:
        parts = []
        if since_ns > begin_ns:
            parts.append(f"from {duration(since_ns - begin_ns)}")
        if until_ns is not None:
            parts.append(f"until {duration(max(0, until_ns - begin_ns))}")
        listed.append(" ".join(parts))
    some = _some_of([text for text in listed if text])
    when = f" {some}" if some else ""
    return f"the clock was not synchronised{when}: dates and times of day are not reliable then"


def _some_of(listed: list[str]) -> str:
    text = ", ".join(listed[:_LISTED_STEPS])
    more = len(listed) - _LISTED_STEPS
    if more > 0:
        text += f" and {more} more times"
    return text


def timed(frames: "Frames | list[TimedFrame]") -> Iterator[TimedFrame]:
    """Return an iterator over the frames."""
    if isinstance(frames, list):
        return iter(frames)
    return (TimedFrame(time_ns, frame) for time_ns, frame in frames)


def time_at(items: Any, index: int) -> int:
    """Return the time of an item of a Block, Frames or list of TimedFrames."""
    found: int = items[index].time_ns if isinstance(items, list) else items.times[index]
    return found


def between(items: Any, low_ns: int, high_ns: int) -> Any:
    """Return the items from one time to another, both included.

    ``items`` are a Block, Frames or a list of TimedFrames. The result has the same type.
    """
    if isinstance(items, list):
        return [one for one in items if low_ns <= one.time_ns <= high_ns]
    begin = bisect_left(items.times, low_ns)
    end = bisect_right(items.times, high_ns)
    return items.part(begin, max(begin, end))


def part_of(
    items: Iterable[Any],
    start_ns: int | None,
    end_ns: int | None,
) -> tuple[int, Iterator[Any]] | None:
    """Return the part of a recording between two times after its beginning, both included.

    ``items`` are Blocks or batches of frames. None as a time means no limit. Returns the time of
    the recording's beginning and the items that are not empty, or None if the part is empty.
    """
    filled = filter(len, items)
    first = next(filled, None)
    if first is None:
        return None
    origin_ns = time_at(first, 0)
    if isinstance(first, list):  # frames of a log, which may be out of order
        origin_ns = min(item.time_ns for item in first)
    low_ns = -LATEST_NS if start_ns is None else origin_ns + start_ns
    high_ns = LATEST_NS if end_ns is None else origin_ns + end_ns

    def is_near(some: Any) -> bool:
        return time_at(some, 0) <= high_ns + _DISORDER_NS

    wanted = takewhile(is_near, chain((first,), filled))
    part = filter(len, (between(some, low_ns, high_ns) for some in wanted))
    first = next(part, None)
    if first is None:
        return None
    return origin_ns, chain((first,), part)
