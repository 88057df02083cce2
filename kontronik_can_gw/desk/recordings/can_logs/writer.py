"""Writes CAN frames as candump log, ASC, BLF, TRC or MF4 bus logging.

python-can's writers are used for all formats except candump. The same frames give the same bytes,
except in MF4, which contains the time of writing.
"""

import io
import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime, timedelta
from types import MappingProxyType
from typing import IO, TYPE_CHECKING, Any, cast

from kontronik_can_gw.desk.recordings.recording import ERROR, LogFrame
from kontronik_can_gw.light_imports import without_asammdf
from kontronik_can_gw.times import END_OF_TIME, MS, SECOND

if TYPE_CHECKING:
    from can import Message

    from kontronik_can_gw.desk.recordings.recording import Batch

_DIRECTIONS = {True: " R", False: " T", None: ""}
"""Ends of the lines of candump."""


_LARGEST = 255
"""Largest number that is possible in every format."""
_number_in = re.compile(r"(\d{1,3})$").search


class Channels:
    """Gives each channel a distinct number or name, in the order in which channels appear.

    can0 becomes 1, and 1 becomes can0. A number that is taken, or too large for the format, is
    replaced by the lowest free number. ``own`` is the name of the gateway's own bus, whose number
    is 1.
    """

    def __init__(self, own: str) -> None:
        self._own = own
        self._numbers: dict[str, int] = {}
        """The given numbers by channel."""
        self._names: dict[str, str] = {}
        """The given names by channel."""

    def number_of(self, channel: str) -> int:
        """Return the channel's number, for formats with numbers."""
        if channel not in self._numbers:
            taken = self._numbers.values()
            number = _natural_number(channel)
            if number in taken or not 1 <= number <= _LARGEST:
                number = 1
                while number in taken:
                    number += 1
            self._numbers[channel] = number
        return self._numbers[channel]

    def name_of(self, channel: str) -> str:
        """Return the channel's name, for formats with names."""
        if channel not in self._names:
            name = channel or self._own
            if channel.isdigit():
                name = f"can{self.number_of(channel) - 1}"
            taken = self._names.values()
            if name in taken:
                number = 0
                while f"can{number}" in taken:
                    number += 1
                name = f"can{number}"
            self._names[channel] = name
        return self._names[channel]

    @property
    def changes(self) -> str:
        """The changed channels, for example "can0 is 1, can1 is 2". Empty for can0 alone."""
        given = self._names or self._numbers
        changed = {old: new for old, new in given.items() if old and old != str(new)}
        if list(changed) in (["can0"], ["1"]):
            return ""
        return ", ".join(f"{old} is {new}" for old, new in changed.items())


def _natural_number(channel: str) -> int:
    if not channel:
        return 1
    if channel.isdigit():
        return int(channel)
    found = _number_in(channel)
    if found is None:
        return 0
    return int(found[1]) + 1


class CanLogWriter:
    """Writes one log.

    ``file`` must be open for bytes, and is not closed. ``wall_ns`` is the Unix time at
    ``origin_ns``, the log's time 0, or None if it is unknown. ``provenance`` is written into the
    header of MF4 at the end.
    """

    write: "Callable[[Batch], None]"
    """Add frames."""

    def __init__(
        self,
        file: IO[bytes],
        format_: str,
        wall_ns: int | None,
        origin_ns: int = 0,
        channel: str = "can0",
        provenance: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self.left_out: Counter[str] = Counter()
        """Number of frames that the format does not support, by their kind."""
        self.close: Callable[[], object] = lambda: None
        """Write the buffered data and the end of the log. The file is not closed."""
        self.discard: Callable[[], object] = lambda: None
        """Release all resources of a log that is not kept."""
        self.channels = Channels(channel)
        """The numbers or names of the channels that have been written."""
        self._base_ns = origin_ns
        start_ns = 0
        if wall_ns is not None:
            # the headers of Vector and PEAK have milliseconds, and asammdf reads microseconds
            unit = 1000 if format_ == "mf4" else MS
            start_ns = wall_ns // unit * unit
            self._base_ns = start_ns - wall_ns + origin_ns
        match format_:
            case "candump":
                self._candump(file, (wall_ns or 0) - origin_ns)
            case "asc":
                self._asc(file, None if wall_ns is None else start_ns)
            case "blf":
                self._blf(file, start_ns)
            case "trc":
                self._trc(file, start_ns)
            case _:
                self._mf4(file, start_ns, provenance)

    def _candump(self, file: IO[bytes], offset_ns: int) -> None:
        half = 500 + offset_ns
        name_of = self.channels.name_of

        def write(frames: "Batch") -> None:
            if not isinstance(frames, list) and 0 <= frames.times[0] + half < END_OF_TIME:
                file.write(frames.candump(half, name_of("")))
                return
            for time_ns, frame, received, channel in _logged(frames):
                can_id, data, extended, fd, *_ = frame
                us = (time_ns + half) // 1000
                name = f"{can_id:08X}" if extended or can_id & ERROR else f"{can_id:03X}"
                content = data.hex().upper()
                if frame.remote:
                    content = f"R{len(data) or ''}"
                elif fd:  # the gateway sends such frames with a switched bit rate
                    content = f"#1{content}"
                end = _DIRECTIONS[received]
                stamp = f"({us // 1000000}.{us % 1000000:06d}) {name_of(channel)}"
                file.write(f"{stamp} {name}#{content}{end}\n".encode("ascii"))

        self.write = write

    def _asc(self, file: IO[bytes], start_ns: int | None) -> None:
        with without_asammdf():
            from can import ASCWriter
        # python-can's header is not used, because it has the time of writing and cuts zeros of the
        # milliseconds; times in ASC are local times
        moment = datetime(1970, 1, 1)  # noqa: DTZ001
        if start_ns is not None:
            moment = datetime.fromtimestamp(start_ns // SECOND)  # noqa: DTZ006
        stamp = moment.strftime(f"%a %b %d %H:%M:%S.{(start_ns or 0) // MS % 1000:03d} %Y")
        text = io.TextIOWrapper(
            file,
            encoding="ascii",
            newline="\n",
            write_through=True,
        )
        writer = ASCWriter(io.StringIO())
        writer.file = text
        writer.header_written = True
        head = (
            f"date {stamp}\nbase hex  timestamps absolute\ninternal events logged\n"
            f"Begin Triggerblock {stamp}\n{0.0: 9.6f} Start of measurement\n"
        )
        text.write(head)
        self._through(writer.on_message_received)
        self.close = lambda: (text.write("End TriggerBlock\n"), text.detach())
        self.discard = text.detach

    def _blf(self, file: IO[bytes], start_ns: int) -> None:
        with without_asammdf():
            from can import BLFWriter
        writer = BLFWriter(_Unclosed(file))
        writer.start_timestamp = 0.0
        # half a nanosecond is added, because the writer cuts the fraction instead of rounding
        self._through(writer.on_message_received, 0.5)

        def close() -> None:
            last = writer.stop_timestamp or 0.0
            writer.start_timestamp = start_ns / SECOND
            writer.stop_timestamp = writer.start_timestamp + last
            writer.stop()

        self.close = close

    def _trc(self, file: IO[bytes], start_ns: int) -> None:
        with without_asammdf():
            from can import TRCWriter
        text = io.TextIOWrapper(
            file,
            encoding="utf-8",
            newline="\r\n",
            write_through=True,
        )
        writer = TRCWriter(_Unclosed(text))
        writer.filepath = "kontronik-can-gw"
        writer.first_timestamp = 0.0
        writer.header_written = True
        writer.write_header(start_ns // MS / 1000)

        def take(message: "Message") -> None:
            if message.is_error_frame:
                self.left_out["error frame"] += 1
            elif message.is_fd:
                self.left_out["CAN FD frame"] += 1
            elif message.is_remote_frame:  # python-can does not write remote frames
                number = int(cast(int, message.channel)) + 1
                line = writer._format_message(message, number).replace(" DT ", " RR ", 1)
                writer.msgnr += 1
                writer.log_event(line, message.timestamp)
            else:
                writer.on_message_received(message)

        self._through(take)
        self.close = self.discard = text.detach

    def _mf4(self, file: IO[bytes], start_ns: int, provenance: Mapping[str, str]) -> None:
        from kontronik_can_gw.desk.recordings.can_logs.library import mf4_library

        with warnings.catch_warnings(action="ignore"):
            writer = mf4_library().MF4Writer(file)
        header = writer._mdf.header
        header.start_time = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(
            microseconds=start_ns // 1000
        )
        header.abs_time = start_ns  # asammdf itself would convert it to a float
        writer._start_time = 0.0
        writer.last_timestamp = 0.0

        def take(message: "Message") -> None:
            # the times of a master channel must not decrease
            message.timestamp = max(message.timestamp, writer.last_timestamp)
            writer.on_message_received(message)

        def close() -> None:
            header.comment = "\n".join(f"{key}: {value}" for key, value in provenance.items())
            with warnings.catch_warnings(action="ignore"):
                writer._mdf.save(file, compression=2)  # stop() would close the file
                writer._mdf.close()

        self._through(take, first_channel=1)
        self.close = close
        self.discard = writer._mdf.close

    def _through(
        self,
        take: "Callable[[Message], None]",
        more_ns: float = 0.0,
        first_channel: int = 0,
    ) -> None:
        """Write frames with one of python-can's writers.

        Times are seconds since the start of the log, for which a float is precise enough.
        ``first_channel`` is the number that the writer expects for channel 1.
        """
        from can import Message

        number_of = self.channels.number_of

        def write(frames: "Batch") -> None:
            for time_ns, frame, received, channel in _logged(frames):
                take(
                    Message(
                        (max(time_ns - self._base_ns, 0) + more_ns) / SECOND,
                        frame.can_id & ~ERROR,
                        frame.extended,
                        is_remote_frame=frame.remote,
                        is_error_frame=bool(frame.can_id & ERROR),
                        dlc=len(frame.data),
                        data=None if frame.remote else frame.data,
                        is_fd=frame.fd,
                        bitrate_switch=frame.fd,
                        is_rx=received is True,
                        channel=number_of(channel) - 1 + first_channel,
                    )
                )

        self.write = write


def _logged(frames: "Batch") -> Iterator[LogFrame]:
    """Return an iterator over the frames with their channels."""
    if not isinstance(frames, list):
        return (LogFrame(time_ns, frame) for time_ns, frame in frames)
    return (item if isinstance(item, LogFrame) else LogFrame(*item) for item in frames)


class _Unclosed:
    """A file whose ``close`` has no effect."""

    name = ""

    def __init__(self, file: Any) -> None:
        self._file = file

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def close(self) -> None:
        """Do nothing, because the caller that opened the file closes it."""
