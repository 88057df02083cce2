"""The adapter: all that the golden set imports or calls of the product. A rebuilding changes this file and no other of this folder.

The formats of the files are described in README.md; scenario.py and commands.py read and write them.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import kontronik_can_gw
from kontronik_can_gw.assembly.assemble import assemble
from kontronik_can_gw.capture.replay import in_order
from kontronik_can_gw.cli import main
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.desk.recordings.inputs import CaptureInput, open_input
from kontronik_can_gw.frames import CanFrame as CanFrame
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.gateway.transmit_queue import TransmitQueue
from kontronik_can_gw.status import CanState

VERSION = kontronik_can_gw.__version__
FOLDERS = {str(shipped("dbc").parent): "SHIPPED"}
"""Folders of this machine that may be named in texts, and what is written instead."""


def frame(
    can_id: int, data: bytes, extended: bool = False, fd: bool = False, remote: bool = False
) -> CanFrame:
    """One on the bus."""
    return CanFrame(can_id, data, extended, fd, remote=remote)


def command(words: Sequence[str]) -> int:
    """Run one command line in this process; its exit code. It reads and writes the standard streams of ``sys``."""
    try:
        return main(words)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 1


def shipped_eds() -> str:
    """The EDS in the package."""
    return shipped("eds/kontronik_esc.eds").read_bytes().decode("latin-1")


def replayed(path: Path) -> Iterator[tuple[int, CanFrame, bool]]:
    """The frames that a capture's gateway received (True) and sent, with the recorded clock in ns."""
    with open_input(path) as recording:
        assert isinstance(recording, CaptureInput)
        for item in recording.frames():
            yield item.time_ns, item.frame, item.received


class Drive:
    """A gateway on an interface that takes every frame at once, with a clock turned by hand (ns from power-on).

    ``tables``: its configuration, as of a TOML file; ``file``: where that stands, other files are looked for beside it.
    """

    def __init__(self, tables: Mapping[str, Any], file: Path) -> None:
        loaded = assemble(parse(dict(tables), str(file)))
        self.warnings = [
            line.replace(f"{file.parent}/", "")
            for line in (*loaded.layout.warnings, *loaded.warnings)
        ]
        silent = loaded.config.dbc.silent_on_loss
        self._gateway = Gateway(loaded.escs, loaded.layout, 0, silent, loaded.outputs)
        self._waiting = TransmitQueue()
        self._open = True
        self._looked = self._now = 0

    @property
    def deadline(self) -> int:
        """When ``advance`` is to be called at the latest."""
        return self._gateway.next_deadline()

    def advance(self, now: int) -> None:
        self._looked = self._now = now
        self._gateway.advance(now)

    def uart(self, esc: int, data: bytes, now: int) -> None:
        """Bytes that are read from the port of an ESC (0 ...). They came just now, but where a deadline was missed."""
        self._now = now
        if self.deadline >= now:
            self._looked = now
        self._gateway.receive_bytes(esc, data, now, self._looked)

    def put(self, frame: CanFrame, now: int) -> None:
        """A frame from the bus. What no filter lets pass the gateway is never given."""
        self._now = now
        if frame.key in self._gateway.receive_ids:
            self._gateway.status.received_frames += 1
            self._gateway.receive_frame(frame, now, now)

    def happen(self, verb: str, words: Sequence[str], now: int) -> None:
        """Anything else: see README.md."""
        gateway, self._now = self._gateway, now
        esc = int(words[0]) - 1 if words and words[0].isdecimal() else 0
        match verb:
            case "start":
                gateway.start(now, words != ["closed"])
            case "stop":
                gateway.stop(now)
            case "port_opened":
                gateway.port(esc, True, now)
            case "port_lost":
                gateway.port(esc, False, now)
            case "line_errors":
                gateway.escs[esc].line_errors = int(words[1])
            case "can_state":
                self._open = words[0] != "DOWN"
                gateway.set_can_state(CanState[words[0]], now)
            case "can_opened":
                self._open = True
                gateway.can_opened(now)
                gateway.can_returned(now)
            case "overrun":
                gateway.receive_overrun(now)
            case "saved":
                gateway.saved(esc, " ".join(words[1:]) or None, now)
            case "damaged":
                gateway.parameters_damaged(esc, now)
            case _:
                raise ValueError(f"what is {verb!r}?")

    def take(self) -> list[CanFrame]:
        """What was sent since the last call."""
        frames = in_order(self._gateway.take_frames(self._now), self._waiting)
        if not self._open:
            return []
        self._gateway.status.sent_frames += len(frames)
        return frames

    def news(self) -> list[str]:
        """What the gateway wants stored, or reports beside its frames, since the last call."""
        gateway = self._gateway
        found = []
        for esc, stored in gateway.take_saves():
            content = json.loads(stored.split(b"\n")[1])
            found.append(f"store {esc + 1} {json.dumps(content, sort_keys=True)}")
        found += [
            f"rejected {esc + 1} {key >> 8:04X}:{key & 255:02X}"
            for esc, key in gateway.take_rejected_parameters()
        ]
        for conflict in gateway.conflicts.take():
            found.append(
                f"conflict {conflict.key & 0x1FFFFFFF:03X} {conflict.whose}{' is over' if conflict.over else ''}"
            )
        gateway.take_link_changes()
        return found
