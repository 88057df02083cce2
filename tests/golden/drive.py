"""The adapter between the golden set and the product.

Only this file of the folder imports the product. If the product is restructured, the other files
stay as they are. README.md describes the formats of the files, which scenario.py and commands.py
read and write.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import kontronik_can_gw
from kontronik_can_gw.assembly.assemble import assemble
from kontronik_can_gw.cli import main
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.desk.recordings.inputs import CaptureInput, open_input
from kontronik_can_gw.desk.recordings.replay import in_order
from kontronik_can_gw.frames import CanFrame as CanFrame
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.gateway.transmit_queue import TransmitQueue
from kontronik_can_gw.status import CanState

VERSION = kontronik_can_gw.__version__
FOLDERS = {str(shipped("dbc").parent): "SHIPPED"}
"""Folders of this machine that texts may contain, and the words that replace them."""


def frame(
    can_id: int,
    data: bytes,
    extended: bool = False,
    fd: bool = False,
    remote: bool = False,
) -> CanFrame:
    """Return a frame on the bus."""
    return CanFrame(can_id, data, extended, fd, remote=remote)


def command(words: Sequence[str]) -> int:
    """Run a command line in this process and return its exit code.

    The command reads and writes the standard streams of ``sys``.
    """
    try:
        return main(words)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 1


def shipped_eds() -> str:
    """Return the text of the EDS in the package."""
    return shipped("eds/kontronik_esc.eds").read_bytes().decode("latin-1")


def replayed(path: Path) -> Iterator[tuple[int, CanFrame, bool]]:
    """Yield the frames that a capture's gateway received (True) or sent (False).

    Times are ns of the recorded clock.
    """
    with open_input(path) as recording:
        assert isinstance(recording, CaptureInput)
        for item in recording.frames():
            yield item.time_ns, item.frame, item.received


class Drive:
    """A gateway on an interface that accepts every frame at once.

    Callers set its clock, in ns since power-on. ``tables`` is the configuration as read from the
    TOML file ``file``. Other files are searched for in the folder of ``file``.
    """

    def __init__(self, tables: Mapping[str, Any], file: Path) -> None:
        loaded = assemble(parse(dict(tables), str(file)))
        folder = f"{file.parent}/"
        warnings = [*loaded.layout.warnings, *loaded.warnings]
        self.warnings = [line.replace(folder, "") for line in warnings]
        self._gateway = Gateway(
            loaded.core_settings,
            0,
            outputs=loaded.outputs,
        )
        self._waiting = TransmitQueue()
        self._open = True
        self._now = 0
        self._looked = 0
        """Time at which the gateway last read its clock and ports."""

    @property
    def deadline(self) -> int:
        """Latest time of the next call of ``advance``."""
        return self._gateway.next_deadline()

    def advance(self, now: int) -> None:
        self._looked = now
        self._now = now
        self._gateway.advance(now)

    def uart(self, esc: int, data: bytes, now: int) -> None:
        """Read bytes from the port of an ESC, which is counted from 0.

        The bytes arrived at ``now``. If a deadline was missed, they may be as old as the last call.
        """
        self._now = now
        if self.deadline >= now:
            self._looked = now
        self._gateway.receive_bytes(esc, data, now, self._looked)

    def put(self, frame: CanFrame, now: int) -> None:
        """Receive a frame from the bus, unless the gateway's filters reject it."""
        self._now = now
        if frame.key in self._gateway.receive_ids:
            self._gateway.status.received_frames += 1
            self._gateway.receive_frame(frame, now, now)

    def happen(self, verb: str, words: Sequence[str], now: int) -> None:
        """Cause any other event. README.md lists the verbs."""
        gateway = self._gateway
        self._now = now
        esc = 0
        if words and words[0].isdecimal():
            esc = int(words[0]) - 1
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
        """Return the frames sent since the last call."""
        frames = in_order(self._gateway.take_frames(self._now), self._waiting)
        if not self._open:
            return []
        self._gateway.status.sent_frames += len(frames)
        return frames

    def news(self) -> list[str]:
        """Return the gateway's requests to store parameters and its reports since the last call."""
        gateway = self._gateway
        found = []
        for esc, stored in gateway.take_saves():
            content = json.loads(stored.split(b"\n")[1])
            found.append(f"store {esc + 1} {json.dumps(content, sort_keys=True)}")
        for esc, key in gateway.take_rejected_parameters():
            found.append(f"rejected {esc + 1} {key >> 8:04X}:{key & 255:02X}")
        for conflict in gateway.conflicts.take():
            can_id = conflict.key & 0x1FFFFFFF
            end = " is over" if conflict.is_over else ""
            found.append(f"conflict {can_id:03X} {conflict.whose}{end}")
        gateway.take_link_changes()
        return found
