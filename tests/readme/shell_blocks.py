"""The blocks of shell commands and Python in README, CONTRIBUTING, docs and examples, as a reader would run them.

The word after ``sh`` is the place in which a block can be run: any machine without a word, as root on a kernel with
vcan for ``vcan``. ``root``, ``systemd``, ``network`` and ``hardware`` are things that no test has or may change.
Python is run as root on a kernel with vcan.
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
"""Ends a block that hangs, so that what it printed is shown. No block needs a quarter of it."""


class Block(NamedTuple):
    """A block of a page. ``word``: one of WORDS for shell commands, "" for another language."""

    place: str
    word: str
    text: str


def blocks(*words: str, language: str = "sh") -> list[Block]:
    """The blocks of a language that have one of these words."""
    found = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for match in re.finditer(
            rf"^```{language} *(.*)\n([^`]*(?:`[^`]+`[^`]*)*?)^```$", text, re.MULTILINE
        ):
            line = text.count("\n", 0, match.start()) + 1
            place = f"{page.relative_to(PROJECT)}:{line}"
            found.append(Block(place, match[1], match[2]))
    return [block for block in found if not words or block.word in words]


def make_files(folder: Path, channel: str, seconds: float) -> None:
    """Files that blocks name: a configuration, a capture, a CAN log, a DBC, and the examples. ``seconds``: length of the flight."""
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


def run_block(block: Block, folder: Path, before: str = "", *around: str) -> str:
    """What a block prints, run in a folder by bash. A command that fails fails the test, and what it has started is ended."""
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
            with contextlib.suppress(ProcessLookupError):  # nothing was left
                os.killpg(process.pid, signal.SIGKILL)
    said = (folder / "printed").read_text()
    assert (code, "Traceback" in said) == (0, False), f"{block.place}:\n{block.text}\n{said}"
    return said
