"""Captures of one run, as a recording."""

import re
import tomllib
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.capture.format import (
    Kind,
    entry_at,
)
from kontronik_can_gw.capture.replay import Replay, TimedFrame
from kontronik_can_gw.capture.setup import CaptureSetup
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.recordings.blocks import NO_MESSAGES, RowBlock, player_of, timed
from kontronik_can_gw.desk.recordings.capture_files import CaptureFiles
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc, shown_by
from kontronik_can_gw.desk.recordings.samples import RowMaker, Sample
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.gateway import Gateway, MakeOutput

if TYPE_CHECKING:
    from kontronik_can_gw.native.offline import Frames, Rows
    from kontronik_can_gw.native.player import Player

_PLAYED = frozenset({Kind.BYTES, Kind.ADVANCE, Kind.COUNTERS})
"""What a player plays, and by which frames of the turn before are certain."""


class CaptureInput(CaptureFiles):
    """Captures of one run, in the order of their parts, played through the gateway's core."""

    def __init__(self, paths: Sequence[Path], layout: BusLayout | None = None) -> None:
        size = self._open(paths)
        first = self._paths[0]
        try:
            self.setup = CaptureSetup.of(self.header)
            found = self.setup.database()
            self.setup.gateway(NO_MESSAGES if found is None else found[1], 0)
        except Exception as error:  # a header may hold anything
            problems = error.problems if isinstance(error, UserError) else [str(error)]
            raise UserError(*(f"{first}: {problem[:400]}" for problem in problems)) from None
        name = str(first)
        if len(self._paths) > 1:
            name = f"{first.parent}/{first.stem.rpartition('-')[0]}"
        self.sent_layout = NO_MESSAGES if found is None else found[1]
        """Of the frames; that of the rows, ``bus``, may be another one."""
        if layout is not None:
            layout = shown_by(layout, self.setup.escs)
        elif found is not None:
            layout = BusLayout(found[0], found[1], self.setup.escs)
        else:
            layout = layout_of_dbc(shipped("dbc/kontronik_esc.dbc"), self.setup.escs)
        super().__init__(name, layout, size)
        self._devices = list(self.header.get("devices") or [])
        self._describe()

    def frames(self, marked: bool = False) -> Iterator[TimedFrame]:
        for frames in self.batches(marked):
            yield from timed(frames)

    def batches(self, marked: bool = False) -> "Iterator[list[TimedFrame] | Frames]":
        """``marked``: the gateway's state in the frames is REPLAY."""
        found, player, now = None, None, self._created_ns
        has_frames_of_its_own = self.setup.canopen is not None or self.setup.outputs
        if self.setup.version > 1 and not has_frames_of_its_own:
            found = player_of(lambda _: self.setup.gateway(self.sent_layout, now), None, (), now)
        if found is None:
            gateway = self.setup.gateway(self.sent_layout, now)
        else:
            player, gateway = found
        replay = Replay(gateway, self.header.get("state"), marked)
        for frames in self._steps(replay, player):
            if player is not None and len(sent := player.take_frames()):
                yield sent
            yield frames
        if player is not None:
            yield player.take_frames(final=True)
        yield replay.finish()
        self._add_losses(replay)

    def samples_in_python(self, chosen: Sequence[int] | None = None) -> Iterator[Sample]:
        fields = [self.fields[index] for index in self._chosen(chosen)]
        makers: list[RowMaker] = []

        def make(*of_gateway: Any) -> RowMaker:
            makers.append(RowMaker(fields, *of_gateway))
            return makers[0]

        replay = Replay(self._silent_gateway((make,)), self.header.get("state"))
        for _ in self._steps(replay):
            yield from makers[0].take_rows()
        yield from makers[0].finish()
        self._add_losses(replay)

    def blocks(self, chosen: Sequence[int] | None = None) -> Iterator[RowBlock] | None:
        fields = [self.fields[index] for index in self._chosen(chosen)]
        found = None
        if self.setup.version > 1:
            now = self._created_ns
            found = player_of(self._silent_gateway, fields, self.bus.escs, now)
        return None if found is None else self._blocks_of(*found)

    def _blocks_of(self, player: "Player", gateway: Gateway) -> Iterator[RowBlock]:
        replay = Replay(gateway, self.header.get("state"))
        is_first = True
        for _ in self._steps(replay, player):
            if player.is_full or (is_first and player.has_rows):
                is_first = False
                yield from self._timed(player.take_rows())
        yield from self._timed(player.take_rows(final=True))
        self._add_losses(replay)

    def _timed(self, rows: "Rows") -> Iterator[RowBlock]:
        """Blocks of rows in which the wall clock goes on as it began."""
        times = rows.times
        cuts = {bisect_left(times, since) for since, _ in self._offsets}
        for begin, end in pairwise(sorted({0, rows.count, *cuts})):
            wall_ns = self.wall_ns(times[begin])
            yield RowBlock(rows, begin, end, wall_ns=(wall_ns or 0) - times[begin])

    def _silent_gateway(self, further: Sequence[MakeOutput]) -> Gateway:
        """Without messages; nodes are there, because they may change pole pairs and gear."""
        # the caller shows names, pole pairs and gears
        escs = [
            replace(own, name=shown.name, pole_pairs=shown.pole_pairs, gear=shown.gear)
            for own, shown in zip(self.setup.escs, self.bus.escs, strict=True)
        ]
        return Gateway(
            *(escs, NO_MESSAGES, self._created_ns), canopen=self.setup.canopen, further=further
        )

    def _steps(self, replay: Replay, player: "Player | None" = None) -> Iterator[list[TimedFrame]]:
        """Give all entries to a replay's gateway; the frames that Python made of each, or nothing where ``player`` gave some.

        The player plays what comes all the time. Any other entry, and the rest of its turn, is played here.
        """
        here = True
        for payload, damaged in self._data():
            if player is None or not player.begin(payload):
                if player is not None:
                    here = True
                    yield []
                    replay.go_on(list(timed(player.take_frames(final=True))))
                for entry in self._entries_of(payload, damaged):
                    yield replay.play(entry)
                continue
            while (kind := player.next_kind) is not None:
                if here or (replay.frames_wait and kind not in _PLAYED):  # it may still drop them
                    here = here if kind == Kind.NOT_SENT else kind != Kind.ADVANCE
                    if (found := self._checked(entry_at(payload, *player.skip()))) is not None:
                        yield replay.play(found)
                else:
                    yield replay.finish()
                    here, self._last_ns = player.play(self._last_ns)
                    yield []
                    if here:
                        replay.go_on(list(timed(player.take_frames(final=True))))

    @property
    def channel(self) -> str:
        try:
            channel = str(tomllib.loads(self.setup.configuration)["can"]["channel"])
        except (ValueError, LookupError, TypeError, RecursionError):
            channel = ""
        return channel if re.fullmatch(r"[\w.:@/-]{1,64}", channel, re.ASCII) else "can0"

    def _add_losses(self, replay: Replay) -> None:
        if replay.lost:
            self.damage.append(
                f"{replay.lost} entries could not be recorded: the disk was too slow or full"
            )
        if replay.rejected:
            self.damage.append(f"{replay.rejected} entries make no sense to this version")

    def _describe(self) -> None:
        """Say in ``provenance`` what is known by now."""
        header, setup, program = self.header, self.setup, self.header.get("program", {})
        version, python = program.get("version", "?"), program.get("python", "?")
        layout = f", layout {header['layout']}" if isinstance(header.get("layout"), str) else ""
        self.provenance |= {
            "program": f"kontronik-can-gw {version}, Python {python}",
            "machine": str(program.get("machine", "")),
            "run": f"{header.get('run', '')}, part {int(header.get('part', 0)) + 1}",
            "configuration": setup.file,
            "DBC": setup.dbc[0] + layout if setup.dbc else "",
        }
        for index, (esc, port) in enumerate(zip(setup.escs, setup.ports, strict=False)):
            device = self._devices[index] if index < len(self._devices) else None
            known = "device not known"
            if isinstance(device, dict):
                known = f"{device.get('device')} {device.get('variant')}, firmware {device.get('firmware')}, {device.get('layout')} layout"
            self.provenance[esc.name] = f"{known}, at {port}"
