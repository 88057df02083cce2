"""Hostile or broken bus traffic, and many ESCs of which some are ill. Nobody else is disturbed."""

import random
import subprocess
import time
from functools import partial

from harness import Bench, Injection, PtyPort, half, injected
from raw_bus import RawBus

CONFLICT = 0x8150
traffic = partial(injected, "Traffic", limit_s=None, escs=[], settle_s=1)


def still_answers(injection: Injection) -> None:
    """The node's SDO server is as before."""
    with RawBus(injection.bench.watched) as master:
        found = master.read(1, 0x1000, 0)
        injection.expect(found == 0, f"object 1000h is {found}")


def cangen(bench: Bench, words: str) -> None:
    """Frames from the far end, however full its queue is."""
    subprocess.run(
        ["cangen", bench.watched, "-i", *words.split()], check=True, stderr=subprocess.DEVNULL
    )


REQUESTS = [
    bytes.fromhex(text)
    for text in (
        "4000100000000000",
        "4021100000000000",
        "2110100104000000",
        "A02110007F000000",
        "6000000000000000",
        "8000000000000000",
    )
]


@traffic("SDO floods", rounds=lambda times: [random.Random(7 + n) for n in range(times)])
def sdo_flood(bench: Bench, injection: Injection, generator: random.Random) -> None:
    """Requests without waiting for an answer: right ones, wrong ones, beginnings of transfers that nobody goes on with."""
    with RawBus(bench.watched) as vandal:
        end = time.monotonic() + 1.5
        sent = 0
        while time.monotonic() < end:
            known = generator.random() < 0.8
            vandal.send(
                0x601 + (sent & 1), generator.choice(REQUESTS) if known else generator.randbytes(8)
            )
            sent += 1
            time.sleep(0.001)
        injection.row.count("requests", sent)
        time.sleep(0.3)
        vandal.send(0x601, REQUESTS[-1])
    still_answers(injection)


@traffic("SYNC at 1 kHz", rounds=half)
def sync(bench: Bench, injection: Injection, _n: int) -> None:
    cangen(bench, "-g 1 -n 1500 -I 080 -L 0")
    still_answers(injection)


def conflict(
    bench: Bench, injection: Injection, n: int, frames: tuple[tuple[int, str], ...]
) -> None:
    """Another node sends these frames, in turn as if it were node 1 and node 2: said once in the log, EMCY 8150h; ours go on."""
    gateway = bench.gateway
    assert gateway is not None
    node = 1 + n % 2
    if any("somebody else" in text and f"node {node}" in text for text in gateway.lines):
        # the condition of before has to be over, or this is the same one
        begun = gateway.log.count("somebody else")
        bench.wait_until(lambda: gateway.log.count("nobody else") >= begun, 15, "it is over")
    lines = len(gateway.lines)
    with RawBus(bench.watched) as vandal:
        for _ in range(50):
            for can_id, data in frames:
                vandal.send(can_id + node, bytes.fromhex(data))
            time.sleep(0.01)
    injection.wait_emergency(node, CONFLICT)
    bench.wait_log("somebody else", lines)
    said = len(gateway.lines) - lines
    injection.row.peak("lines in the log", said)
    injection.expect(1 <= said <= 2 * len(frames), f"{said} lines in the log for one condition")
    still_answers(injection)


for name, frames in (
    (
        "another node sends with our identifiers",
        ((0x687, "0000000000000000"), (0x180, "0000000000000000")),
    ),
    # its boot-up, heartbeat and answers; our node stays as it is
    (
        "a second node with our node-ID",
        ((0x700, "00"), (0x700, "7F"), (0x580, "8000100000000405")),
    ),
):
    traffic(name, rounds=lambda times: range(max(2, times // 2)))(partial(conflict, frames=frames))


# last: our identifiers are among them, and who has somebody else there waits until he is gone
@traffic("random frames", rounds=lambda times: [1_000_000 if times > 10 else 5_000 * times])
def random_frames(bench: Bench, injection: Injection, count: int) -> None:
    """All identifiers, lengths and contents, remote and 29-bit frames among them; in the long run a million."""
    before = bench.watch.foreign
    for number, kind in ((count * 8 // 10, ""), (count // 10, "-R"), (count // 10, "-e")):
        cangen(bench, f"-g 0.3 -n {number} -I r -L r -D r {kind}")
    time.sleep(0.3)
    injection.row.count("frames", bench.watch.foreign - before)
    still_answers(injection)


# --- many ESCs


NOISY, SILENT, UNPLUGGED = ILL = 0, 3, 6


@injected(
    "Many",
    "eight ESCs, of which one is noisy, one silent, one unplugged",
    None,
    escs=ILL,
    settle_s=1,
    bench="eight",
)
def eight(bench: Bench, injection: Injection, n: int) -> None:
    """The other five lose nothing, nor do the three what was whole."""
    generator = random.Random(8 + n)

    def noise(wire: bytes) -> tuple[bytes, bool]:
        if generator.random() < 0.5:
            return generator.randbytes(generator.randrange(1, 200)), False
        return generator.randbytes(generator.randrange(200)) + wire, True

    port = bench.ports[UNPLUGGED]
    assert isinstance(port, PtyPort)
    bench.fed[NOISY].mangle = noise
    bench.fed[SILENT].on = False
    for _ in range(3):
        port.unplug()
        time.sleep(0.7)
        port.plug()
        time.sleep(0.5)
    bench.fed[NOISY].mangle = None
    injection.cleared()
    bench.fed[SILENT].on = True
