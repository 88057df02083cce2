"""The blocks of shell commands and Python in the pages, run as a reader would run them.

The pages are README, CONTRIBUTING, docs and examples. The word after ``sh`` names the place in
which a block can be run. Without a word, it can be run on any machine. A block with ``vcan`` is run
as root on a kernel with vcan, and so are blocks of Python. No test has or may change the things
called ``root``, ``systemd``, ``network`` and ``hardware``.
"""

import contextlib
import gzip
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from capture_bench import Bench, capture, made
from command_line import run, written

PROJECT = Path(__file__).resolve().parents[2]
PAGES = (
    *(PROJECT / "README.md", PROJECT / "CONTRIBUTING.md"),
    *sorted((PROJECT / "docs").glob("*.md")),
    *sorted((PROJECT / "examples").rglob("*.md")),
)
WORDS = ("", "vcan", "root", "systemd", "network", "hardware")
LIMIT_S = 60
"""A block that hangs is ended after this time, so that its output is shown.

No block needs a quarter of it.
"""


class Block(NamedTuple):
    """A block of a page. ``word`` is one of WORDS for a shell block, and "" for other languages."""

    place: str
    word: str
    text: str


def blocks(*words: str, language: str = "sh") -> list[Block]:
    """Return the blocks of a language that have one of these words. No words: all blocks."""
    block = re.compile(
        rf"^```{language} *(.*)\n([^`]*(?:`[^`]+`[^`]*)*?)^```$",
        re.MULTILINE,
    )
    found = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for match in block.finditer(text):
            line = text.count("\n", 0, match.start()) + 1
            place = f"{page.relative_to(PROJECT)}:{line}"
            found.append(Block(place, match[1], match[2]))
    return [block for block in found if not words or block.word in words]


def make_files(folder: Path, channel: str, seconds: float) -> None:
    """Create the files that blocks name.

    These are a configuration, a capture, a CAN log, a DBC and the examples. ``seconds`` is the
    length of the flight.
    """
    example = run("init", "-").out.replace('"can0"', f'"{channel}"')
    written(folder / "gateway.toml", re.sub("(?m)^port = .*", 'port = "esc1"', example))
    setup, layout = made()
    bench = Bench(setup, layout).live(1, seconds, wild=False)
    (folder / "captures").mkdir()
    flight = capture(folder / "captures/flight.kcap", setup, bench.entries)
    shutil.copy(flight, folder / "flight.kcap")
    assert run("convert", flight, folder / "bus.log").code == 0
    (folder / "old.log.gz").write_bytes(gzip.compress((folder / "bus.log").read_bytes()))
    shutil.copy(PROJECT / "dbc/kontronik_esc.dbc", folder / "my_car.dbc")
    (folder / "examples").symlink_to(PROJECT / "examples")


def run_block(
    block: Block,
    folder: Path,
    before: str = "",
    *around: str,
) -> str:
    """Run a block in a folder with bash and return its output.

    A failing command fails the test. All processes that the block has started are ended.
    """
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    with (folder / "printed").open("w+") as printed:
        process = subprocess.Popen(
            [*around, "bash", "-euo", "pipefail", "-c", f"{before}\n{block.text}"],
            cwd=folder,
            env=os.environ | {"PATH": path, "HOME": str(folder)},
            stdin=subprocess.DEVNULL,
            stdout=printed,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        code: int | str
        try:
            code = process.wait(LIMIT_S)
        except subprocess.TimeoutExpired:
            code = f"no end within {LIMIT_S} s"
        finally:
            with contextlib.suppress(ProcessLookupError):  # all its processes have ended
                os.killpg(process.pid, signal.SIGKILL)
    said = (folder / "printed").read_text()
    assert code == 0, f"{block.place}:\n{block.text}\n{said}"
    assert "Traceback" not in said, f"{block.place}:\n{block.text}\n{said}"
    return said
