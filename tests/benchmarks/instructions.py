"""Instructions for each live frame, counted by valgrind: nearly the same in every run, whatever else the machine does.

Each program takes N and 3 N live frames; the difference is divided by 2 N, so that its start does not count. Counted is the way from the
bytes to the frames, without ports and sockets.

    python instructions.py ours|obvious FRAMES      what valgrind runs
"""

import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from programs import FIVE, die_with_us
from registry import HERE, ROOT, VALGRIND_LINE, Context, Figure, LeftOut, benchmark, judged

_SUMMARY = re.compile(r"^(?:summary|totals): (\d+)", re.MULTILINE)
DISTINCT = 200
"""Live frames that are made, however many are sent: making them is not part of what is measured."""
PERIOD_NS = 10_000_000


# --- what valgrind runs


def frames(count: int) -> list[bytes]:
    """Live frames with values that go up and down."""
    from kontronik_can_gw.esc.kontronik.codec import Layout, encode
    from kontronik_can_gw.esc.kontronik.fields import LiveData

    chance = random.Random(1)
    found = []
    for number in range(DISTINCT):
        low = [chance.randrange(100) for _ in range(13)]
        live = LiveData(
            100_000 + low[0], 4800 + low[1], 400 + low[2], 500 + low[3], 600 + low[4], number, 1000 + low[5], 8000 + low[6],
            1500 + low[7], low[8], low[9], low[10], low[11], 0x20000, 21, low[12],
        )  # fmt: skip
        found.append(encode(live, Layout.V4))
    return (found * (count // DISTINCT + 1))[:count]


def ours(all_frames: list[bytes]) -> int:
    """Decode, pack and schedule; 10 ms go by with each frame, with all that is due meanwhile. Returns how many frames came out."""
    from kontronik_can_gw.config.assemble import assemble
    from kontronik_can_gw.config.parse import parse
    from kontronik_can_gw.gateway import Gateway

    loaded = assemble(parse({"dbc": {"file": str(FIVE)}, "esc": [{"port": "/dev/null"}]}, "bench"))
    now, count = 1_000_000_000_000, 0
    gateway = Gateway(loaded.escs, loaded.layout, now)
    gateway.start(now)
    for frame in all_frames:
        now += PERIOD_NS
        gateway.receive_bytes(0, frame, now, now)
        gateway.advance(now)
        count += len(gateway.take_frames(now))
    return count


class Sink:
    """A bus that counts what it is given."""

    count = 0

    def send(self, _frame: object) -> None:
        self.count += 1


def obvious(all_frames: list[bytes]) -> int:
    """Decode and pack. Returns how many frames came out."""
    sys.modules["asammdf"] = None  # type: ignore[assignment]
    import cantools
    from obvious import Esc

    bus = Sink()
    esc = Esc(0, None, cantools.database.load_file(FIVE), bus, threading.Lock())
    for frame in all_frames:
        esc.buffer += frame
        esc.find_frames()
    return bus.count


# --- what runs valgrind


def counted_by(file: Path) -> list[str]:
    """What comes in front of a command."""
    valgrind = shutil.which("valgrind")
    if valgrind is None:
        raise LeftOut(f"no valgrind to count instructions with:  {VALGRIND_LINE}")
    return [valgrind, "-q", "--tool=callgrind", f"--callgrind-out-file={file}"]


def total(file: Path) -> int:
    """Instructions of a whole run."""
    found = _SUMMARY.findall(file.read_text())
    if not found:
        raise RuntimeError(f"valgrind left no total in {file}")
    return max(map(int, found))


def of_python(program: str, count: int) -> int:
    """Instructions of ours or the obvious program with so many frames."""
    with tempfile.TemporaryDirectory(prefix="kontronik-bench-") as folder:
        out = Path(folder) / "callgrind"
        command = [*counted_by(out), sys.executable, __file__, program, str(count)]
        same = os.environ | {"PYTHONHASHSEED": "0"}
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=600, env=same, preexec_fn=die_with_us
        )
        if done.returncode:
            raise RuntimeError(f"{program}: {done.stderr.strip()[-1500:]}")
        return total(out)


def for_each(count: Callable[[int], int], number: int) -> float:
    """Instructions for each live frame, by two runs side by side."""
    with ThreadPoolExecutor(2) as pool:
        short, long = pool.map(count, (number, 3 * number))
    return (long - short) / (2 * number)


@benchmark("instructions", "instructions for each live frame, by valgrind (a minute)")
def instructions(context: Context) -> list[Figure]:
    """Ours and the obvious program."""
    number = 20 if context.quick else 200
    found = {
        program: for_each(lambda n, p=program: of_python(p, n), number)  # type: ignore[misc]
        for program in ("ours", "obvious")
    }
    return [
        judged("ours: decode, pack, schedule", found["ours"], "instructions/frame", "<= 40000"),
        Figure("obvious: decode, pack", found["obvious"], "instructions/frame"),
        Figure("obvious / ours", found["obvious"] / found["ours"], "x"),
    ]


if __name__ == "__main__":
    sys.path[:0] = [str(ROOT), str(HERE / "peers")]
    work = {"ours": ours, "obvious": obvious}[sys.argv[1]]
    wanted = int(sys.argv[2])
    if work(frames(wanted)) < 5 * wanted:
        sys.exit(f"fewer than five CAN frames for each of {wanted} live frames")
