"""Instructions for each live frame, counted by valgrind: nearly the same in every run, whatever else the machine does.

Each program takes N and 3 N live frames; the difference is divided by 2 N, so that its start does not count. Counted is the way from the
bytes to the frames, of the Python programs without ports and sockets, and of ours also whole turns of the loop; not the kernel's part.

    python instructions.py ours|turns|obvious FRAMES      what valgrind runs
"""

import contextlib
import os
import pty
import random
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import tty
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from programs import FIVE, config_text, die_with_us, running
from registry import HERE, ROOT, VALGRIND_LINE, Context, Figure, LeftOut, benchmark, judged

if TYPE_CHECKING:
    from kontronik_can_gw.config.assemble import Loaded
    from kontronik_can_gw.gateway import Gateway

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


def gateway_at(now: int, port: str) -> "tuple[Loaded, Gateway]":
    """A gateway of one ESC."""
    from kontronik_can_gw.cli.common import load_all
    from kontronik_can_gw.gateway import Gateway
    from kontronik_can_gw.runtime.store import ParameterStore

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "gateway.toml")
        file.write_text(config_text([port], "lo", FIVE, Path(folder)))
        loaded = load_all(file, ParameterStore)
    return loaded, Gateway(loaded.escs, loaded.layout, now)


def ours(all_frames: list[bytes]) -> int:
    """Decode, pack and schedule; 10 ms go by with each frame, with all that is due meanwhile. Returns how many frames came out."""
    now, count = 1_000_000_000_000, 0
    _, gateway = gateway_at(now, "/dev/null")
    gateway.start(now)
    for frame in all_frames:
        now += PERIOD_NS
        gateway.receive_bytes(0, frame, now, now)
        gateway.advance(now)
        count += len(gateway.take_frames(now))
    return count


def turns(all_frames: list[bytes]) -> int:
    """The same by whole turns, from a pseudo terminal to a local socket. What writes and receives here counts too, some 9 000."""
    import standin

    from kontronik_can_gw.runtime import locks
    from kontronik_can_gw.runtime.loop import Loop

    name = f"kontronik-turns-{os.getpid()}"
    standin.use(f"unix:{name}")
    locks.PREFIX += f"turns/{os.getpid()}/"
    now, count = 1_000_000_000_000, 0
    master, slave = pty.openpty()
    tty.setraw(slave)
    loaded, gateway = gateway_at(now, path := os.ttyname(slave))
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind("\0" + name)
        listener.listen(1)
        loop = Loop(gateway, [path], loaded.config.can, clock=lambda: now)
        loop.open()
        bus, _ = listener.accept()
    bus.setblocking(False)
    loop.begin()
    for frame in all_frames:
        now += PERIOD_NS
        os.write(master, frame)
        loop.turn()
        with contextlib.suppress(BlockingIOError):
            while bus.recv(64):
                count += 1
    loop.close()
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


def of_c(context: Context, count: int) -> int:
    """Instructions of the C gateway with so many frames."""
    with tempfile.TemporaryDirectory(prefix="kontronik-bench-") as folder:
        out = Path(folder) / "callgrind"
        words = ("--warmup", "0", "--period", "5000")
        with running(
            context,
            "c",
            1,
            *words,
            seconds=count * 0.005,
            wrap=lambda command: [*counted_by(out), *command],
        ) as (feeder, gateway):
            sent = feeder.measure(gateway).sent
        return round(total(out) * count / sent)


def for_each(count: Callable[[int], int], number: int) -> float:
    """Instructions for each live frame, by two runs side by side."""
    with ThreadPoolExecutor(2) as pool:
        short, long = pool.map(count, (number, 3 * number))
    return (long - short) / (2 * number)


@benchmark("instructions", "instructions for each live frame, by valgrind (a minute)")
def instructions(context: Context) -> list[Figure]:
    """The three programs."""
    number = 20 if context.quick else 200
    found = {
        program: for_each(lambda n, p=program: of_python(p, n), number)  # type: ignore[misc]
        for program in ("ours", "turns", "obvious")
    }
    found["c"] = for_each(lambda n: of_c(context, n), number)
    return [
        judged("ours: decode, pack, schedule", found["ours"], "instructions/frame", "<= 40000"),
        Figure("ours: whole turns, read and send too", found["turns"], "instructions/frame"),
        Figure("obvious: decode, pack", found["obvious"], "instructions/frame"),
        Figure("c: read and send too", found["c"], "instructions/frame"),
        Figure("obvious / ours", found["obvious"] / found["ours"], "x"),
    ]


if __name__ == "__main__":
    sys.path[:0] = [str(ROOT), str(HERE / "peers")]
    work = {"ours": ours, "turns": turns, "obvious": obvious}[sys.argv[1]]
    wanted = int(sys.argv[2])
    if work(frames(wanted)) < 5 * wanted:
        sys.exit(f"fewer than five CAN frames for each of {wanted} live frames")
