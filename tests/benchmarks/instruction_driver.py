"""Takes so many live frames through ours or the obvious program, turn by turn, so that valgrind can count the instructions.

    python instruction_driver.py ours|core|obvious FRAMES

Live frames go into a pseudo terminal and come out as CAN frames on a local socket, which another process empties. The clock of ours is
passed in: 10 ms go by with each frame, with all that is due meanwhile.
``core`` is ours without ports, loop and socket: bytes in, frames out.
"""

import os
import pty
import random
import select
import subprocess
import sys
import tempfile
import threading
import tty
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import standin

HERE = Path(__file__).resolve().parent
PERIOD_NS = 10_000_000
# counts what comes, and says so at the end: it is not part of what is measured
_DRAIN = """
import socket, sys
listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
listener.bind("\\0" + sys.argv[1])
listener.listen(1)
listener.settimeout(120)
print("ready", flush=True)
bus, _ = listener.accept()
count = 0
while bus.recv(64):
    count += 1
print(count, flush=True)
"""


DISTINCT = 200
"""Live frames that are made, however many are sent: making them is not part of what is measured."""


def frames(count: int) -> list[bytes]:
    """Live frames with values that go up and down."""
    from kontronik_can_gw.protocol.codec import Layout, encode
    from kontronik_can_gw.protocol.fields import LiveData

    chance = random.Random(1)
    found = []
    for number in range(DISTINCT):
        low = [chance.randrange(100) for _ in range(16)]
        live = LiveData(
            100_000 + low[0], 4800 + low[1], 400 + low[2], 500 + low[3], 600 + low[4], number, 1000 + low[5], 8000 + low[6],
            1500 + low[7], low[8], low[9], low[10], low[11], 0x20000, 21, low[12],
        )  # fmt: skip
        found.append(encode(live, Layout.V4))
    return (found * (count // DISTINCT + 1))[:count]


def feed(
    master: int, slave: int, all_frames: list[bytes], turn: Callable[[], int], tick: Callable[[], None] = lambda: None
) -> None:
    """``turn`` lets the program work and tells how many live frames it has seen; ``tick`` lets 10 ms go by."""
    there = select.poll()
    there.register(slave, select.POLLIN)
    for number, frame in enumerate(all_frames, start=1):
        tick()
        os.write(master, frame)
        there.poll(2000)
        while turn() < number:
            there.poll(2000)


def ours(master: int, slave: int, path: str, folder: Path, all_frames: list[bytes]) -> None:
    """The real loop over the real gateway, as ``run`` assembles them."""
    from bench_programs import FIVE, config_text

    from kontronik_can_gw.cli.common import load_all
    from kontronik_can_gw.gateway import Gateway
    from kontronik_can_gw.runtime import locks
    from kontronik_can_gw.runtime.loop import Loop
    from kontronik_can_gw.runtime.statistics import Statistics
    from kontronik_can_gw.runtime.store import ParameterStore

    locks.PREFIX += f"bench/{os.getpid()}/"
    file = folder / "gateway.toml"
    file.write_text(config_text([path], "lo", FIVE, folder))
    loaded = load_all(file, ParameterStore)
    now = 1_000_000_000_000
    gateway = Gateway(loaded.escs, loaded.layout, now)
    loop = Loop(
        gateway,
        [path],
        loaded.config.can,
        clock=lambda: now,
        statistics=Statistics(folder / "status.json", None),
    )
    loop.open()
    loop.begin()
    counters = gateway.escs[0].counters

    def tick() -> None:
        nonlocal now
        now += PERIOD_NS

    def turn() -> int:
        loop.turn()
        return counters.live

    feed(master, slave, all_frames, turn, tick)
    loop.end()


def core(folder: Path, all_frames: list[bytes]) -> int:
    """Decode, pack and schedule: what of ours knows neither ports nor sockets. Returns how many frames came out."""
    from bench_programs import FIVE, config_text

    from kontronik_can_gw.cli.common import load_all
    from kontronik_can_gw.gateway import Gateway
    from kontronik_can_gw.runtime.store import ParameterStore

    file = folder / "gateway.toml"
    file.write_text(config_text(["/dev/null"], "lo", FIVE, folder))
    loaded = load_all(file, ParameterStore)
    now, count = 1_000_000_000_000, 0
    gateway = Gateway(loaded.escs, loaded.layout, now)
    gateway.start(now)
    for frame in all_frames:
        now += PERIOD_NS
        gateway.receive_bytes(0, frame, now, now)
        gateway.advance(now)
        count += len(gateway.take_frames())
    return count


def obvious(master: int, slave: int, path: str, all_frames: list[bytes]) -> None:
    """One port of the obvious program, in this thread."""
    sys.modules["asammdf"] = None  # type: ignore[assignment]
    import can
    import cantools
    from bench_programs import FIVE
    from obvious import Esc

    bus = can.Bus(interface="socketcan", channel="lo")
    esc = Esc(0, path, cantools.database.load_file(FIVE), bus, threading.Lock())
    esc.send_not_available()

    def turn() -> int:
        esc.step()
        return esc.frames

    feed(master, slave, all_frames, turn)
    bus.shutdown()


def main(program: str, count: int) -> int:
    sys.path[:0] = [str(HERE.parents[1]), str(HERE / "peers")]
    all_frames = frames(count)
    if program == "core":
        with tempfile.TemporaryDirectory() as folder:
            return int(core(Path(folder), all_frames) < 5 * count)
    name = f"kontronik-bench-{uuid.uuid4().hex[:12]}"
    drain: Any = subprocess.Popen([sys.executable, "-c", _DRAIN, name], stdout=subprocess.PIPE, text=True)
    drain.stdout.readline()
    standin.use(f"unix:{name}")
    master, slave = pty.openpty()
    tty.setraw(slave)
    path = os.ttyname(slave)
    with tempfile.TemporaryDirectory() as folder:
        if program == "ours":
            ours(master, slave, path, Path(folder), all_frames)
        else:
            obvious(master, slave, path, all_frames)
    came = int(drain.communicate(timeout=60)[0])
    if came < 5 * count:
        print(f"{program}: {came} CAN frames for {count} live frames", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], int(sys.argv[2])))
