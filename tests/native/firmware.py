"""Runs the example of an exported folder with bytes, and compares it with the Python core."""

import random
import subprocess
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import equality
from built import STRICT

from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.core.python_core import PythonCore
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.desk.export_c import exported
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.native.rows import NotInCore
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.status import CanState, GatewayState
from kontronik_can_gw.times import MS, SECOND

BYTE_NS = 11 * SECOND // 115200
SILENCE = 3 * SECOND
SOURCES = ("core.c", "tables.c", "example_main.c")


class Case:
    """A folder with the export of a given or random layout, and random bytes of its ESCs."""

    def __init__(
        self,
        folder: Path,
        seed: int,
        layout: MessageLayout | None = None,
        escs: Sequence[EscSettings] | None = None,
    ) -> None:
        chance = random.Random(seed)
        self.folder = folder
        self.silent_on_loss = chance.random() < 0.3
        self.quiet_after_ns = random.Random(seed + 1).choice((0, 300 * MS, SECOND))
        while True:
            self.escs = escs or equality.some_escs(chance)
            self.layout = layout or equality.layout(chance, self.escs)
            try:
                licence = shipped("LICENSE").read_text(encoding="utf-8")
                files = exported(
                    CoreSettings(
                        self.escs,
                        self.layout,
                        silent_on_loss=self.silent_on_loss,
                        quiet_after_ns=self.quiet_after_ns,
                    ),
                    licence,
                )
                break
            except NotInCore:
                assert layout is None
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8")
        self.lines = [_line(chance) for _ in self.escs]
        for number, data in enumerate(self.lines):
            (folder / f"uart{number}.bin").write_bytes(data)

    @property
    def inputs(self) -> list[str]:
        return [f"uart{number}.bin" for number in range(len(self.lines))]

    def output(self, *command: str) -> str:
        """Run a program in the folder and return its output.

        Raise AssertionError with its error output if it failed.
        """
        nothing = subprocess.DEVNULL
        run = partial(
            subprocess.run,
            stdin=nothing,
            capture_output=True,
            text=True,
            timeout=300,
        )
        done = run(command, cwd=self.folder, check=False)
        assert done.returncode == 0, done.stderr[:3000]
        return done.stdout

    def build(self, compiler: str, *options: str) -> Path:
        """Compile the example in the folder. Return its path."""
        target = self.folder / f"example-{Path(compiler).name}"
        self.output(
            compiler,
            "-std=c99",
            *STRICT,
            *options,
            "-o",
            str(target),
            *SOURCES,
        )
        return target

    def run(self, *command: str) -> str:
        """Run the example and return its output."""
        return self.output(*command, *self.inputs)

    def expected(self) -> str:
        """Return the frames of the Python core with the same clock, in the format of candump."""
        core = PythonCore(
            CoreSettings(
                self.escs,
                self.layout,
                silent_on_loss=self.silent_on_loss,
                quiet_after_ns=self.quiet_after_ns,
            ),
            0,
        )
        core.status.state = GatewayState.RUNNING
        core.status.can_state = CanState.ERROR_ACTIVE
        core.repeat(0)
        taken = [0] * len(self.lines)
        empty = [0] * len(self.lines)
        last = max(-(-len(line) * BYTE_NS // MS) * MS for line in self.lines)
        text = []
        for now in range(0, last + SILENCE + 1, MS):
            for esc, line in enumerate(self.lines):
                end = min(len(line), now // BYTE_NS + 1)
                if end > taken[esc]:
                    core.receive(esc, line[taken[esc] : end], now, empty[esc])
                    taken[esc] = end
                empty[esc] = now
            core.advance(now)
            frames = core.take(now)
            core.status.sent_frames += len(frames)
            seconds, ns = divmod(now, SECOND)
            for frame in frames:
                name = f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:03X}"
                data = ("#0" if frame.fd else "") + frame.data.hex().upper()
                text.append(f"({seconds}.{ns // 1000:06d}) can0 {name}#{data}\n")
        return "".join(text)


def _line(chance: random.Random) -> bytes:
    """Return telemetry with faults, and long noise in which values become stale."""
    data = b""
    for _ in range(chance.randint(60, 120)):
        data += equality.stream(chance)
        if chance.random() < 0.05:
            data += chance.randbytes(chance.choice((300, 3_000, 12_000)))
    return data
