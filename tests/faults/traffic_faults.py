"""Hostile or broken bus traffic, and many ESCs of which some are ill. Nobody else is disturbed."""

import random
import subprocess
import time
from collections.abc import Callable

from fault_report import Fault, fault
from harness import Bench, Injection, PtyPort
from raw_bus import RawBus

CONFLICT = 0x8150


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


@fault("Traffic", "random frames", None)
def random_frames(bench: Bench, fault: Fault, times: int) -> None:
    """All identifiers, lengths and contents, remote and 29-bit frames among them; in the long run a million."""
    count = 1_000_000 if times > 10 else 5_000 * times
    with bench.injection(fault, [], settle_s=1) as injection:
        before = bench.watch.foreign
        for number, kind in ((count * 8 // 10, ""), (count // 10, "-R"), (count // 10, "-e")):
            cangen(bench, f"-g 0.3 -n {number} -I r -L r -D r {kind}")
        injection.cleared()
        time.sleep(0.3)
        bench.report.row(fault).count("frames", bench.watch.foreign - before)
        still_answers(injection)


@fault("Traffic", "SDO floods", None)
def sdo_flood(bench: Bench, fault: Fault, times: int) -> None:
    """Requests without waiting for an answer: right ones, wrong ones, beginnings of transfers that nobody goes on with."""
    generator = random.Random(7)
    requests = [
        bytes([0x40, 0, 0x10, 0, 0, 0, 0, 0]),
        bytes([0x40, 0x21, 0x10, 0, 0, 0, 0, 0]),
        bytes([0x21, 0x10, 0x10, 1, 4, 0, 0, 0]),
        bytes([0xA0, 0x21, 0x10, 0, 0x7F, 0, 0, 0]),
        bytes([0x60, 0, 0, 0, 0, 0, 0, 0]),
        bytes([0x80, 0, 0, 0, 0, 0, 0, 0]),
    ]
    for _ in range(times):
        with bench.injection(fault, [], settle_s=1) as injection, RawBus(bench.watched) as vandal:
            end = time.monotonic() + 1.5
            sent = 0
            while time.monotonic() < end:
                request = (
                    generator.choice(requests)
                    if generator.random() < 0.8
                    else generator.randbytes(8)
                )
                vandal.send(0x601 + (sent & 1), request)
                sent += 1
                time.sleep(0.001)
            bench.report.row(fault).count("requests", sent)
            injection.cleared()
            time.sleep(0.3)
            vandal.send(0x601, bytes([0x80, 0, 0, 0, 0, 0, 0, 0]))
            still_answers(injection)


@fault("Traffic", "SYNC at 1 kHz", None)
def sync(bench: Bench, fault: Fault, times: int) -> None:
    for _ in range(times):
        with bench.injection(fault, [], settle_s=1) as injection:
            cangen(bench, "-g 1 -n 1500 -I 080 -L 0")
            injection.cleared()
            still_answers(injection)


def conflicts(
    bench: Bench, fault: Fault, times: int, frames: Callable[[int], list[tuple[int, bytes]]]
) -> None:
    """Another node sends these frames, in turn as if it were node 1 and node 2."""
    gateway = bench.gateway
    assert gateway is not None
    for i in range(max(2, times // 2)):
        node = 1 + i % 2
        if any("somebody else" in text and f"node {node}" in text for text in gateway.lines):
            # the condition of before has to be over, or this is the same one
            begun = gateway.log.count("somebody else")
            bench.wait_until(lambda: gateway.log.count("nobody else") >= begun, 15, "it is over")  # noqa: B023
        with bench.injection(fault, [], settle_s=1) as injection, RawBus(bench.watched) as vandal:
            lines = len(gateway.lines)
            for _ in range(50):
                for can_id, data in frames(node):
                    vandal.send(can_id, data)
                time.sleep(0.01)
            injection.cleared()
            injection.wait_emergency(node, CONFLICT)
            said = len(gateway.lines) - lines
            bench.report.row(fault).peak("lines in the log", said)
            injection.expect(
                1 <= said <= 2 * len(frames(node)), f"{said} lines in the log for one condition"
            )
            still_answers(injection)


@fault("Traffic", "another node sends with our identifiers", None)
def foreign_ids(bench: Bench, fault: Fault, times: int) -> None:
    """Noticed, said once in the log, EMCY 8150h; ours go on."""
    conflicts(
        bench, fault, times, lambda node: [(0x687 + node, bytes(8)), (0x180 + node, bytes(8))]
    )


@fault("Traffic", "a second node with our node-ID", None)
def duplicate_node(bench: Bench, fault: Fault, times: int) -> None:
    """Its boot-up, heartbeat and answers are noticed as a conflict; our node stays as it is."""

    def frames(node: int) -> list[tuple[int, bytes]]:
        return [
            (0x700 + node, b"\0"),
            (0x700 + node, b"\x7f"),
            (0x580 + node, bytes([0x80, 0, 0x10, 0, 0, 0, 4, 5])),
        ]

    conflicts(bench, fault, times, frames)


# --- many ESCs


@fault("Many", "eight ESCs, of which one is noisy, one silent, one unplugged", None, bench="eight")
def eight(bench: Bench, fault: Fault, times: int) -> None:
    """The other five lose nothing, nor do the three what was whole."""
    generator = random.Random(8)
    noisy, silent, unplugged = 0, 3, 6

    def noise(wire: bytes) -> tuple[bytes, bool]:
        if generator.random() < 0.5:
            return generator.randbytes(generator.randrange(1, 200)), False
        return generator.randbytes(generator.randrange(200)) + wire, True

    port = bench.ports[unplugged]
    assert isinstance(port, PtyPort)
    for _ in range(times):
        with bench.injection(fault, [noisy, silent, unplugged], settle_s=1) as injection:
            bench.fed[noisy].mangle = noise
            bench.fed[silent].on = False
            for _ in range(3):
                port.unplug()
                time.sleep(0.7)
                port.plug()
                time.sleep(0.5)
            bench.fed[noisy].mangle = None
            injection.cleared()
            bench.fed[silent].on = True
            injection.wait_recovery()
