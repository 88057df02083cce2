"""Millions of UART frames through the real ``run`` command: does its memory grow, and does the garbage collector work?

The command runs in its own process (``python run_growth.py --child ...``), with its loop, its pseudo terminals and its CAN socket; only
time is ours: the loop is taken turn by turn by a clock that goes on 10 ms a turn, so that an hour of telemetry takes some minutes. Now
and then things go wrong: damaged bytes, silence, a port that hangs up, error frames, a bus that takes nothing, a master that asks and
stores.
"""

import argparse
import contextlib
import gc
import json
import random
import re
import selectors
import socket
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).resolve().parents[2]), str(Path(__file__).resolve().parent)]

from bench_programs import config_text, end, start
from registry import ROOT, Benchmark, Context, Figure, NotEqual
from standin import use

from kontronik_can_gw.offline.pty import PtyEsc
from kontronik_can_gw.protocol.codec import Layout, encode
from kontronik_can_gw.protocol.fields import InfoData, LiveData
from kontronik_can_gw.telemetry import MS, SECOND

ESCS = 8
STEP_NS = 10 * MS
SAMPLES = 30
WARM_UP = 150_000
"""Frames before the first sample that counts, of a short run half of them: caches and buffers have their size by then."""
_RARELY = 2000
"""A wild thing once in so many turns."""
_CANOPEN = '[canopen]\nenabled = true\nnode_id = 1\nself_start = true\nstore = "{folder}/store"\n'
_RECORD = '[record]\ndirectory = "{folder}/captures"\nkeep_mb = 20\npart_mb = 5\n'


# --- the gateway's process


def resident_kb() -> int:
    """Memory of this process."""
    found = re.search(r"^Rss:\s+(\d+) kB$", Path("/proc/self/smaps_rollup").read_text(), re.MULTILINE)
    assert found is not None
    return int(found[1])


class Escs:
    """Telemetry for the ports: live frames, an info frame a second, and the wild things."""

    def __init__(self, links: Sequence[Path], seed: int) -> None:
        self._links = links
        self._terminals = [PtyEsc(link) for link in links]
        self._random = random.Random(seed)
        self._wires = [encode(self._live(), Layout.V4) for _ in range(500)]
        info = encode(InfoData(device_and_variant=1 << 10, firmware_word=0x0203, selftest_errors=0), Layout.V4)
        self._info = info
        self._silent = [0] * len(links)
        self._turn = 0

    def _live(self) -> LiveData:
        pick = self._random.randrange
        return LiveData(electrical_speed=pick(100_000), battery_voltage=pick(1000, 5000), operating_errors=pick(4) << 3)

    def send(self) -> None:
        """One turn: a frame of each ESC that is not silent."""
        self._turn += 1
        for index, terminal in enumerate(self._terminals):
            if self._silent[index]:
                self._silent[index] -= 1
                continue
            wire = self._wires[(self._turn * 7 + index * 31) % 500]
            if (self._turn + index * 11) % 100 == 0:
                wire = self._info + wire
            if self._random.randrange(_RARELY) == 0:
                wire = self._wild(index, wire)
                terminal = self._terminals[index]
            terminal.write(wire)

    def _wild(self, index: int, wire: bytes) -> bytes:
        """Something that should not be."""
        kind = self._random.randrange(6)
        place = self._random.randrange(1, len(wire))
        if kind == 0:
            return wire[:place]
        if kind == 1:
            return wire[:place] + bytes([wire[place] ^ 1 << self._random.randrange(8)]) + wire[place + 1 :]
        if kind == 2:
            return self._random.randbytes(200) + wire
        if kind == 3:  # the time-out of telemetry passes
            self._silent[index] = self._random.randrange(30, 400)
            return b""
        if kind == 4 and self._random.randrange(10) == 0:  # unplugged, and plugged in again
            self._terminals[index].close()
            self._terminals[index] = PtyEsc(self._links[index])
            return b""
        return wire + wire

    def close(self) -> None:
        for terminal in self._terminals:
            terminal.close()


def child(arguments: list[str]) -> int:
    """The real command, its loop driven by our clock."""
    parser = argparse.ArgumentParser()
    parser.add_argument("bus")
    parser.add_argument("config", type=Path)
    parser.add_argument("frames", type=int)
    parser.add_argument("report", type=Path)
    parser.add_argument("links", type=Path, nargs="+")
    args = parser.parse_args(arguments)
    use(args.bus)
    escs = Escs(args.links, seed=1)

    from kontronik_can_gw.runtime import locks, loop

    locks.PREFIX += f"bench/{uuid.uuid4().hex[:8]}/"

    class Driven(loop.Loop):
        """The loop, but that time goes on by turns."""

        def __init__(self, *arguments: Any, **further: Any) -> None:
            self.virtual = time.monotonic_ns()
            super().__init__(*arguments, **further | {"clock": lambda: self.virtual})

        def run(self) -> None:
            self.begin()
            warm = min(args.frames // 2, WARM_UP)
            marks = [warm + (args.frames - warm) * each // SAMPLES for each in range(SAMPLES + 1)]
            turns = 0
            self._sample(0)  # what looking takes for itself is taken once
            with args.report.open("w") as report:  # nothing is kept here: it would be growth
                for mark in marks:
                    while sum(esc.counters.live for esc in self.gateway.escs) < mark:
                        for _ in range(100):
                            escs.send()
                            self.virtual += STEP_NS
                            self.turn()
                        turns += 100
                        if turns % 5000 == 0:
                            time.sleep(0.02)  # the threads beside the loop have the time they would have
                    if mark == marks[-1]:
                        last = self._sample(turns)
                        last["unreachable"] = gc.collect()
                        last["resident_after_collection_kb"] = resident_kb()
                        report.write(json.dumps(last) + "\n")
                    else:
                        report.write(json.dumps(self._sample(turns)) + "\n")
            self.end()

        def _sample(self, turns: int) -> dict[str, Any]:
            status = self.gateway.status
            states = gc.get_stats()
            return {
                "frames": sum(esc.counters.live for esc in self.gateway.escs),
                "turns": turns,
                "hours": round(turns * STEP_NS / SECOND / 3600, 3),
                "resident_kb": resident_kb(),
                "blocks": sys.getallocatedblocks(),
                "frozen": gc.get_freeze_count(),
                "collections": [state["collections"] for state in states],
                "collected": sum(state["collected"] for state in states),
                "sent": status.sent_frames,
                "received": status.received_frames,
                "failures": status.send_failures,
                "replaced": status.replaced_frames,
                "bad": sum(esc.counters.crc_errors for esc in self.gateway.escs),
                "losses": sum(esc.losses for esc in self.gateway.escs),
                "reopened": sum(max(0, esc.reopened) for esc in self.escs),
            }

    loop.Loop = Driven  # type: ignore[misc]
    from kontronik_can_gw.cli import main

    try:
        return main(["run", "-c", str(args.config)])
    finally:
        escs.close()


# --- the bus's other end


class Master:
    """Receives all frames, asks and commands now and then, and sometimes takes nothing for a while."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self.received = 0
        self.asked = 0

    def serve(self, bus: socket.socket, process: "subprocess.Popen[str]") -> None:
        """Until the gateway closes its end."""
        selector = selectors.DefaultSelector()
        selector.register(bus, selectors.EVENT_READ)
        while True:
            if not selector.select(5.0):
                if process.poll() is not None:
                    return
                continue
            with contextlib.suppress(BlockingIOError, ConnectionError):
                while bus.recv(128):
                    self.received += 1
                    if self.received % 3000 == 0:
                        self._ask(bus)
                return

    def _ask(self, bus: socket.socket) -> None:
        pick = self._random.randrange
        node = 1 + pick(ESCS)
        sdo, nmt, error = 0x600 + node, 0, 0x20000004
        if pick(15) == 0:
            time.sleep(0.01)  # nothing is taken meanwhile: the gateway finds the bus busy
            return
        can_id, data = [
            (sdo, bytes.fromhex("4018100100000000")),  # upload of 1018h:1
            (sdo, bytes.fromhex("4008100000000000")),  # of 1008h: a text, in segments, which nobody fetches
            (sdo, bytes.fromhex("4001300100000000")),
            (sdo, bytes.fromhex("4000400000000000")),  # of what there is not: aborted
            (sdo, bytes.fromhex("2b00210102000000") if pick(2) else bytes.fromhex("2f00210107000000")),
            (sdo, bytes.fromhex("2310100173617665")),  # 1010h:1 "save"
            (sdo, self._random.randbytes(8)),
            (nmt, bytes([pick(2) + 1, node])),
            (nmt, bytes([1, 0])),
            (nmt, bytes([0x82, node])),  # reset communication
            (0x80, b""),  # SYNC
            (0x300 + node, self._random.randbytes(8)),
            (0x680 + 8 * pick(4), self._random.randbytes(8)),  # an id of ours from another sender
            (error, bytes([0, 0x10 if pick(2) else 0x40, 0, 0, 0, 0, 0, 0])),  # error passive, active again
        ][pick(14)]
        with contextlib.suppress(BlockingIOError):
            bus.send(can_id.to_bytes(4, sys.byteorder) + bytes([len(data), 0, 0, 0]) + data.ljust(8, b"\0"))
            self.asked += 1


def run_child(context: Context, frames: int, config: str) -> tuple[list[dict[str, Any]], Master]:
    """Its samples, and what the other end of the bus saw."""
    name = f"kontronik-bench-{uuid.uuid4().hex[:12]}"
    with (
        tempfile.TemporaryDirectory(prefix="kontronik-bench-") as made,
        socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener,
    ):
        listener.bind("\0" + name)
        listener.listen(1)
        listener.settimeout(20)
        folder = Path(made)
        links = [folder / f"esc{index}" for index in range(ESCS)]
        file, report, errors = folder / "gateway.toml", folder / "report.json", folder / "errors"
        text = config_text([str(link) for link in links], "lo", ROOT / "dbc" / "kontronik_esc.dbc", folder, config)
        file.write_text(text.replace("[dbc]", "bitrate = 1000000\n[dbc]", 1).format(folder=folder))
        command = [sys.executable, __file__, "--child", f"unix:{name}", str(file), str(frames), str(report)]
        with errors.open("w") as log:
            process = start([*command, *map(str, links)], stdin=subprocess.DEVNULL, stderr=log)
        try:
            master = Master(seed=2)
            try:
                bus, _ = listener.accept()
            except TimeoutError:
                raise RuntimeError(f"the gateway did not start: {errors.read_text()[-2000:]}") from None
            with bus:
                bus.setblocking(False)
                master.serve(bus, process)
            process.wait(10)
        finally:
            end(process)
        said = errors.read_text()
        if process.returncode or not report.exists():
            raise RuntimeError(f"the gateway ended with {process.returncode}: {said[-2000:]}")
        if "Traceback" in said:
            raise NotEqual(f"growth: the gateway raised something: {said[said.index('Traceback') :][:2000]}")
        rows: list[dict[str, Any]] = [json.loads(line) for line in report.read_text().splitlines()]
        context.say(
            f"{len(said.splitlines())} lines of log, {master.received} CAN frames received, {master.asked} sent"
        )
        return rows, master


def figures_of(context: Context, name: str, frames: int, config: str, target_kb: int | None) -> list[Figure]:
    """One run; its table goes to standard error and into the JSON."""
    begun = time.monotonic()
    rows, master = run_child(context, frames, config)
    took = time.monotonic() - begun
    first, last = rows[0], rows[-1]
    context.data[name] = rows
    context.say(
        f"{'frames':>9} {'hours':>6} {'RSS kB':>7} {'blocks':>8} {'gen 0/1/2':>14} {'losses':>6} {'bad':>5} {'reopened':>8}"
    )
    for row in (*rows[:: max(1, SAMPLES // 10)], last):
        counts = "/".join(map(str, row["collections"]))
        context.say(
            f"{row['frames']:9} {row['hours']:6.2f} {row['resident_kb']:7} {row['blocks']:8} {counts:>14} {row['losses']:6} "
            f"{row['bad']:5} {row['reopened']:8}"
        )
    if last["frames"] < frames:
        raise NotEqual(f"growth: {last['frames']} frames were decoded, not {frames}")
    # what was handed over has arrived, but for what waited at the end; the last status is sent behind the last sample
    if not 0 <= master.received - last["sent"] <= 100:
        raise NotEqual(f"growth: the gateway counts {last['sent']} CAN frames, the other end {master.received}")
    between = last["frames"] - first["frames"]
    grown = last["resident_kb"] - first["resident_kb"]
    blocks = last["blocks"] - first["blocks"]
    young, middle, full = (b - a for a, b in zip(first["collections"], last["collections"], strict=True))
    target, reached = ("", None) if target_kb is None else (f"<= {target_kb / 1000}", grown <= target_kb)
    note = f"{last['hours']:.1f} h of {ESCS} ESCs in {took:.0f} s; {first['resident_kb'] / 1024:.1f} MB at first"
    before = f"by gc.collect(); {last['collected'] - first['collected']} were collected before"
    return [
        Figure(f"{name}: growth over {between} frames", grown / 1024, "MB", target, reached, note),
        Figure(
            f"{name}: growth",
            blocks,
            "blocks",
            note="of Python's allocator; a live frame makes hundreds and gives them back",
        ),
        Figure(f"{name}: full collections", full, "", "<= 0", full == 0, "generation 2"),
        Figure(f"{name}: collections, generation 0", young * 1000 / between, "/1000 frames"),
        Figure(f"{name}: collections, generation 1", middle * 1000 / between, "/1000 frames"),
        Figure(f"{name}: unreachable at the end", last["unreachable"], "objects", note=before),
    ]


def growth(context: Context) -> list[Figure]:
    """Memory and garbage over millions of frames."""
    frames = 60_000 if context.quick else 3_000_000
    figures = figures_of(context, "DBC, statistics", frames, "", 300)
    return figures + figures_of(context, "CANopen, recorder too", frames // 10, _CANOPEN + _RECORD, None)


BENCHMARKS = [Benchmark("growth", "memory and garbage collections over three million UART frames", growth)]

if __name__ == "__main__":
    sys.exit(child(sys.argv[2:]))
