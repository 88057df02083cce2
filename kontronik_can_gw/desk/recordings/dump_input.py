"""The UART bytes of one ESC, which have no times: their live frames are taken to come at a fixed rate."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from kontronik_can_gw.capture.replay import TimedFrame, follow_bytes
from kontronik_can_gw.capture.setup import CaptureSetup
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.dbc.settings import DbcSettings
from kontronik_can_gw.desk.recordings.blocks import NO_MESSAGES, RowBlock, player_of
from kontronik_can_gw.desk.recordings.can_logs import UART_MAGIC
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc
from kontronik_can_gw.desk.recordings.recording import CHUNK, Input
from kontronik_can_gw.desk.recordings.samples import RowMaker, Sample
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.esc.decoder import Counters, Reading
from kontronik_can_gw.esc.stream import EscStream
from kontronik_can_gw.esc.telemetry import SECOND, Event
from kontronik_can_gw.gateway import Gateway, MakeOutput
from kontronik_can_gw.gateway_status import GatewayState, GatewayStatus

if TYPE_CHECKING:
    from kontronik_can_gw.native.offline import Frames
    from kontronik_can_gw.native.player import Player

LIVE_RATE = 100.0
"""Live frames a second that plain bytes are taken to have come at."""
MAX_WAITING = 1 << 16
"""Bytes without a frame that are held."""
_LONGEST_FRAME = 64
_UNDECIDED = len(UART_MAGIC) - 1
"""Bytes at the end of a read that may begin a header."""


class DumpInput(Input):
    """The bytes of one ESC, without times."""

    def __init__(
        self, path: Path, layout: BusLayout | None = None, live_rate: float = LIVE_RATE
    ) -> None:
        layout = layout or layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))
        if len(layout.escs) != 1:
            raise UserError(
                f"{path}: holds the bytes of one ESC, {layout.layout.file} describes {len(layout.escs)}"
            )
        super().__init__(str(path), layout, path.stat().st_size)
        self.times_assumed = True
        self._path = path
        self._period_ns = max(1, round(SECOND / live_rate))
        esc = replace(
            layout.escs[0], timeout_ns=max(layout.escs[0].timeout_ns, 3 * self._period_ns)
        )
        self.setup = CaptureSetup((esc,), (str(path),), None, DbcSettings(), False, False, None)
        self.provenance["times"] = f"assumed: {live_rate:g} live frames a second"
        if layout.config is None:
            self.provenance["motor"] = (
                "pole pairs and gear taken as 1 (a configuration, -c, tells them)"
            )

    def batches(self) -> "Iterator[list[TimedFrame] | Frames]":
        found = player_of(lambda _: self.setup.gateway(self.bus.layout, 0), None, (), 0)
        if found is None:
            gateway = self.setup.gateway(self.bus.layout, 0)
            yield from ([frame] for frame in follow_bytes(gateway, self.chunks()))
            return
        player, gateway = found
        gateway.port(0, True, 0)
        gateway.start(0)
        for _ in self._steps(player):
            yield player.take_frames()

    def blocks(self, chosen: Sequence[int] | None = None) -> Iterator[RowBlock] | None:
        fields = [self.fields[index] for index in self._chosen(chosen)]

        def make(further: Sequence[MakeOutput]) -> Gateway:
            return Gateway(self.setup.escs, NO_MESSAGES, 0, further=further)

        found = player_of(make, fields, self.bus.escs, 0)
        return None if found is None else self._blocks_of(*found)

    def _blocks_of(self, player: "Player", gateway: Gateway) -> Iterator[RowBlock]:
        gateway.status.state = GatewayState.RUNNING
        for _ in self._steps(player):
            if player.is_full:
                rows = player.take_rows()
                yield RowBlock(rows, 0, rows.count)
        rows = player.take_rows(final=True)
        yield RowBlock(rows, 0, rows.count)

    def _steps(self, player: "Player") -> Iterator[None]:
        """Give all bytes to the player, which finds the frames and their times as ``_found`` does."""
        self.damage = []
        player.set_bytes(self._period_ns, MAX_WAITING)
        rest = b""
        for data in chain(self.esc_bytes(0), (None,)):
            rest += data or b""
            is_full = True
            while is_full:
                begin = player.position
                is_full = player.play_bytes(rest, ended=data is None)
                rest = rest[player.position - begin :]
                yield
        self._describe_damage(player.counters)

    def samples_in_python(self, chosen: Sequence[int] | None = None) -> Iterator[Sample]:
        """A gateway runs from the first frame on; it knows no more than the telemetry."""
        esc = EscStream(self.setup.escs[0], 0)
        status = GatewayStatus(GatewayState.RUNNING, esc_count=1)
        fields = [self.fields[index] for index in self._chosen(chosen)]
        maker = RowMaker(fields, [esc], status, 0)
        due = 0
        for now, _, reading in self._found(esc):
            if reading is None:
                continue
            while due < now and (due := esc.next_deadline()) < now:
                maker.on_event(0, esc.advance(due), due)
            events = esc.accept(reading, now, now)
            if events & Event.LINK:
                status.escs_ok = int(esc.up)
                due = 0
            maker.on_event(0, events, now)
            yield from maker.take_rows()
        yield from maker.finish()

    def chunks(self) -> Iterator[tuple[int, bytes]]:
        """The bytes up to each frame's end, at its time: a live frame each period, an info frame half a period after it."""
        for time_ns, data, _ in self._found(EscStream(self.setup.escs[0], 0)):
            if data:
                yield time_ns, data

    def esc_bytes(self, esc: int) -> Iterator[bytes]:
        if esc:
            raise UserError(f"{self.name}: holds the bytes of one ESC")
        self.position = 0
        try:
            with self._path.open("rb") as file:
                while data := file.read(CHUNK):
                    self.position += len(data)
                    yield data
        except OSError as error:
            raise RunError(f"{self._path}: cannot be read: {error.strerror}.") from None

    def wall_ns(self, time_ns: int) -> int | None:  # noqa: ARG002  nobody knows when it was
        return None

    def _found(self, esc: EscStream) -> Iterator[tuple[int, bytes, Reading | None]]:
        """Bytes up to the end of a frame, its time, and the frame; without a frame at the time of the one before.

        The decoder of ``esc`` finds them. It is given the bytes up to the next header with each, so that its counters are of that time.
        """
        self.damage = []
        decoder = esc.decoder
        waiting, at, now, lives = bytearray(), 0, 0, 0
        for piece in chain(self._pieces(), (b"",)):
            waiting += piece
            for frame in decoder.feed(piece) if piece else decoder.flush():
                if not frame.form.is_info:
                    now = lives * self._period_ns
                    lives += 1
                else:
                    now = max(now, lives * self._period_ns - self._period_ns // 2)
                end = frame.offset + frame.form.length - at
                yield now, bytes(waiting[:end]), frame
                del waiting[:end]
                at += end
            if len(waiting) > MAX_WAITING:
                # no frame for long: what can belong to none any more goes
                gone = len(waiting) - _LONGEST_FRAME
                yield now, bytes(waiting[:gone]), None
                del waiting[:gone]
                at += gone
        yield now, bytes(waiting), None
        self._describe_damage(decoder.counters)

    def _describe_damage(self, counters: Counters) -> None:
        if counters.dropped_bytes:
            self.damage.append(
                f"{counters.dropped_bytes} bytes belong to no frame, {counters.crc_errors} CRC errors"
            )
        if not counters.live:
            self.damage.append(counters.diagnosis() or "no live frame")

    def _pieces(self) -> Iterator[bytes]:
        """The bytes of the file, each header at the beginning of a piece."""
        rest = b""
        for data in self.esc_bytes(0):
            first, *others = (rest + data).split(UART_MAGIC)
            pieces = [first, *(UART_MAGIC + other for other in others)]
            rest = pieces[-1][-_UNDECIDED:]
            pieces[-1] = pieces[-1][:-_UNDECIDED]
            yield from filter(None, pieces)
        if rest:
            yield rest
