"""Reads the plain UART bytes of one ESC.

The bytes have no times, so 100 telemetry frames a second are assumed.
"""

from collections.abc import Iterator
from dataclasses import replace
from io import BufferedReader
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from kontronik_can_gw.assembly.capture_setup import CaptureSetup
from kontronik_can_gw.capture.format import Entry, EntryKind
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.core.python_core import PythonCore
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc
from kontronik_can_gw.desk.recordings.log_input import BYTES, UART_MAGIC, format_of
from kontronik_can_gw.desk.recordings.played import PlayedInput
from kontronik_can_gw.desk.recordings.replay import TimedFrame, in_order
from kontronik_can_gw.desk.recordings.stream import HEAD, Stream, StreamReader, name_of
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.decoder import Counters, Reading
from kontronik_can_gw.esc.protocols import PROTOCOLS
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.gateway.transmit_queue import TransmitQueue
from kontronik_can_gw.printable import counted
from kontronik_can_gw.status import GatewayState
from kontronik_can_gw.times import MS

if TYPE_CHECKING:
    from kontronik_can_gw.desk.recordings.offline import Frames
    from kontronik_can_gw.desk.recordings.player import Player

CHUNK = 1 << 16
"""Number of bytes that are read at once."""
PERIOD_NS = 10 * MS
"""Assumed period of the telemetry frames."""
_BEGINS_OF_HEADER = (b"KO", b"K")
"""Incomplete headers, the longest first."""


class BytesInput(PlayedInput):
    """The bytes of one ESC, without times."""

    def __init__(
        self,
        path: Path,
        layout: BusLayout | None = None,
        stream: Stream | None = None,
    ) -> None:
        layout = layout or layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))
        if len(layout.escs) != 1:
            raise UserError(
                f"{path}: contains the bytes of one ESC, "
                f"but {layout.layout.file} describes {len(layout.escs)}"
            )
        self._path = path
        timeout_ns = max(layout.escs[0].timeout_ns, 3 * PERIOD_NS)
        esc = replace(layout.escs[0], timeout_ns=timeout_ns)
        setup = CaptureSetup(
            (esc,),
            (str(path),),
            None,
            DbcConfig(),
            False,
        )
        super().__init__(str(path), layout, setup)
        self.stream = stream
        self._head = b""
        """The first bytes of the recording, at most ``HEAD``."""
        self.provenance["times"] = "assumed: 100 live frames a second"
        if layout.config is None:
            self.provenance["motor"] = (
                "pole pairs and gear assumed to be 1 (a configuration, -c, sets them)"
            )

    def entries(self) -> Iterator[Entry]:
        """Yield the bytes up to each frame's end as an entry at the frame's time."""
        now = 0
        given = 0
        held = bytearray()
        """Bytes that the decoder has received and that are not part of an entry yet."""

        def note_bytes(pieces: Iterator[bytes]) -> Iterator[bytes]:
            for data in pieces:
                held.extend(data)
                yield data

        decoder = PROTOCOLS[0].make()
        for now, reading in self._read_frames(decoder, note_bytes(self.esc_bytes(0))):
            size = reading.offset + reading.form.length - given
            yield Entry(now, EntryKind.BYTES, data=bytes(held[:size]))
            del held[:size]
            given += size
        if held:
            yield Entry(now, EntryKind.BYTES, data=bytes(held))

    def esc_bytes(self, esc: int) -> Iterator[bytes]:  # noqa: ARG002  there is only one ESC
        self._head = b""
        try:
            with self._open() as file:
                while data := file.read1(CHUNK):
                    if len(self._head) < HEAD:
                        self._head += data[: HEAD - len(self._head)]
                    yield data
        except OSError as error:
            raise UserError(f"{self._path}: cannot be opened: {error.strerror}.") from None

    def _open(self) -> BufferedReader:
        return self._path.open("rb") if self.stream is None else StreamReader(self.stream)

    def close(self) -> None:
        if self.stream is not None:
            self.stream.close()

    def wall_ns(self, time_ns: int) -> int | None:  # noqa: ARG002  it is unknown at any time
        return None

    def _play(
        self, gateway: Gateway, player: "Player | None" = None
    ) -> "Iterator[list[TimedFrame] | Frames]":
        # the gateway is started before it receives the first byte
        gateway.port(0, True, 0)
        gateway.start(0)
        if self.is_marked:
            gateway.status.state = GatewayState.REPLAY
        if player is not None:
            yield from self._play_in_c(player)
            return
        core = cast(PythonCore, gateway.core)
        waiting = TransmitQueue()
        now = 0

        def advance(now: int) -> list[TimedFrame]:
            gateway.advance(now)
            frames = in_order(gateway.take_frames(now), waiting)
            return [TimedFrame(now, frame) for frame in frames]

        for now, reading in self._read_frames(core.escs[0].decoder):
            while (due := gateway.next_deadline()) < now:
                yield advance(due)
            core.accept(0, reading, now)
            gateway.take_link_changes()
            yield advance(now)
        yield advance(now)

    def _play_in_c(self, player: "Player") -> "Iterator[Frames]":
        """Do the work of ``_play`` and ``_read_frames`` in C."""
        player.set_bytes(PERIOD_NS)
        rest = b""
        begin = 0
        for data in chain(self.esc_bytes(0), (None,)):
            rest = rest[player.position - begin :] + (data or b"")
            begin = player.position
            while player.play_bytes(rest, begin, ended=data is None):
                yield player.take_frames()
            yield player.take_frames()
        self._describe_damage(player.counters)

    def _read_frames(
        self, decoder: Any, read: Iterator[bytes] | None = None
    ) -> Iterator[tuple[int, Reading]]:
        """Yield each frame with its time.

        Live frames have a distance of one period. An info frame follows a live frame after half a
        period. When a frame is yielded, the decoder has received the bytes up to the next header,
        so its counters have the values of that time.
        """
        now = 0
        lives = 0
        for piece in chain(_pieces(read or self.esc_bytes(0)), (b"",)):
            frames = decoder.feed(piece) if piece else decoder.flush()
            for frame in frames:
                if not frame.form.is_info:
                    now = lives * PERIOD_NS
                    lives += 1
                else:
                    now = max(now, lives * PERIOD_NS - PERIOD_NS // 2)
                yield now, frame
        self._describe_damage(decoder.counters)

    def _describe_damage(self, counters: Counters) -> None:
        self.damage = []
        if not counters.live + counters.info:
            self.refusal = self._refusal(counters)
        if counters.dropped_bytes:
            self.damage.append(
                f"{counted(counters.dropped_bytes, 'byte')} outside of frames, "
                f"{counted(counters.crc_errors, 'CRC error')}"
            )
        if not counters.live:
            self.damage.append(counters.diagnosis() or "no live frame")

    def _refusal(self, counters: Counters) -> UserError | None:
        """Return the error for a recording of another format, and for a file that is no recording.

        None if the bytes are an ESC's.
        """
        name = name_of(self._path)
        try:
            found = format_of(self._head, name, diagnosis=counters.diagnosis())
        except UserError as error:
            return error
        if found == BYTES:
            return None
        return UserError(
            f"{name}: is a {found} recording, not the bytes of an ESC. "
            "Use kontronik-can-gw convert."
        )


def _pieces(read: Iterator[bytes]) -> Iterator[bytes]:
    """Yield the bytes of a file, cut before each header. Only an incomplete header is held back."""
    rest = b""
    for data in read:
        first, *others = (rest + data).split(UART_MAGIC)
        pieces = [first]
        pieces += [UART_MAGIC + other for other in others]
        rest = b""
        for begin in _BEGINS_OF_HEADER:
            if pieces[-1].endswith(begin):
                rest = begin
                pieces[-1] = pieces[-1].removesuffix(begin)
                break
        yield from filter(None, pieces)
    if rest:
        yield rest
