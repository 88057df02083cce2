"""Hostile or broken bus traffic, and many ESCs of which some are ill. Nobody else is disturbed."""

import random
import subprocess
import time
from functools import partial

from beds import eight, fault
from harness import Bench, Injection, PtyPort
from raw_bus import RawBus

CONFLICT = 0x8150
traffic = partial(fault, "Traffic", limit_s=None, escs=[], settle_s=1)


def still_answers(bench: Bench) -> None:
    """The node's SDO server is as before."""
    with RawBus(bench.watched) as master:
        found = master.read(1, 0x1000, 0)
        bench.expect(found == 0, f"object 1000h is {found}")


def cangen(bench: Bench, words: str) -> None:
    """Frames from the far end, however full its queue is."""
    command = ["cangen", bench.watched, "-i", *words.split()]
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)


REQUESTS = [
    *map(bytes.fromhex, ("4000100000000000", "4021100000000000", "2110100104000000")),
    *map(bytes.fromhex, ("A02110007F000000", "6000000000000000", "8000000000000000")),
]


@traffic("SDO floods")
def sdo_flood(bench: Bench, injection: Injection, n: int) -> None:
    """Requests without waiting for an answer: right ones, wrong ones, beginnings of transfers that nobody goes on with."""
    generator = random.Random(7 + n)
    with RawBus(bench.watched) as vandal:
        end = time.monotonic() + 1.5
        while time.monotonic() < end:
            known = generator.random() < 0.8
            request = generator.choice(REQUESTS) if known else generator.randbytes(8)
            vandal.send(0x601 + generator.randrange(2), request)
            time.sleep(0.001)
        time.sleep(0.3)
        vandal.send(0x601, REQUESTS[-1])
    still_answers(bench)


@traffic("SYNC at 1 kHz", rounds=[0])
def sync(bench: Bench, injection: Injection, _n: int) -> None:
    cangen(bench, "-g 1 -n 1500 -I 080 -L 0")
    still_answers(bench)


def conflict(
    bench: Bench, injection: Injection, n: int, frames: tuple[tuple[int, str], ...]
) -> None:
    """Another node sends these frames, in turn as if it were node 1 and node 2: said once in the log, EMCY 8150h; ours go on."""
    gateway = bench.gateway
    node = 1 + n
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
    bench.expect(1 <= said <= 2 * len(frames), f"{said} lines in the log for one condition")
    still_answers(bench)


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
    traffic(name)(partial(conflict, frames=frames))


# last: our identifiers are among them, and who has somebody else there waits until he is gone
@traffic("random frames", rounds=[1000])
def random_frames(bench: Bench, injection: Injection, count: int) -> None:
    """All identifiers, lengths and contents, remote and 29-bit frames among them."""
    for number, kind in ((8 * count, ""), (count, "-R"), (count, "-e")):
        cangen(bench, f"-g 0.3 -n {number} -I r -L r -D r {kind}")
    time.sleep(0.3)
    still_answers(bench)


# --- many ESCs


NOISY, SILENT, UNPLUGGED = ILL = 0, 3, 6


@fault(
    "Many",
    "eight ESCs, of which one is noisy, one silent, one unplugged",
    None,
    escs=ILL,
    settle_s=1,
    bed=eight,
)
def ill_among_well(bench: Bench, injection: Injection, n: int) -> None:
    """The other five lose nothing, nor do the three what was whole."""
    generator = random.Random(8 + n)

    def noise(wire: bytes) -> tuple[bytes, bool]:
        if generator.random() < 0.5:
            return generator.randbytes(generator.randrange(1, 200)), False
        return generator.randbytes(generator.randrange(200)) + wire, True

    port = bench.escs[UNPLUGGED]
    assert isinstance(port, PtyPort)
    bench.escs[NOISY].mangle = noise
    bench.escs[SILENT].on = False
    for _ in range(3):
        port.unplug()
        time.sleep(0.7)
        port.plug()
        time.sleep(0.5)
    bench.escs[NOISY].mangle = None
    injection.cleared()
    bench.escs[SILENT].on = True
