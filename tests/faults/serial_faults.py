"""Faults of the serial line and of the ESC behind it. They must not disturb the other ESC."""

import contextlib
import fcntl
import os
import random
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from beds import fault
from feeder import Identity
from harness import Bench, Injection, PtyPort

from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.states import Device

LOST = 4
PORT_ERROR = 5
on_first = partial(fault, "Serial", limit_s=2.0, escs=[0])
"""A fault of the first ESC."""


def port_of(bench: Bench, esc: int = 0) -> PtyPort:
    port = bench.escs[esc]
    assert isinstance(port, PtyPort)
    return port


def lost(bench: Bench) -> None:
    """Wait until the link is reported as lost."""

    def is_lost() -> bool:
        return bench.watch.value("Esc1Link", "link_state") in (LOST, PORT_ERROR)

    bench.wait_until(is_lost, 5, "the link is said to be lost")


@contextlib.contextmanager
def replugged(port: PtyPort) -> Iterator[None]:
    """Unplug a port and plug it in again. It is visible for the gateway after the block."""
    port.unplug()
    link = port.link
    port.link = link.with_name("hidden")
    port.plug()
    yield
    port.link.rename(link)
    port.link = link


@on_first("port busy at its return")
def busy(bench: Bench, injection: Injection, _n: int) -> None:
    port = port_of(bench)
    with replugged(port):
        fd = os.open(port.device, os.O_RDWR | os.O_NOCTTY)
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    time.sleep(1.2)
    os.close(fd)
    injection.cleared()
    bench.wait_log("in use")


@on_first("permission missing at its return")
def permission(bench: Bench, injection: Injection, _n: int) -> None:
    port = port_of(bench)
    with replugged(port):
        os.chmod(port.device, 0)
    try:
        time.sleep(1.2)
        bench.wait_log("permission denied")
    finally:
        os.chmod(port.device, 0o620)
        injection.cleared()


@on_first("port gone and back", rounds=(0.05, 0.3, 0.7, 4))
def gone(bench: Bench, injection: Injection, pause: float) -> None:
    port: Any = bench.escs[0]
    port.unplug()
    if pause > 1:
        lost(bench)
    time.sleep(pause)
    injection.cleared()
    port.plug()


@on_first("port back under another name")
def other_name(bench: Bench, injection: Injection, _n: int) -> None:
    port = port_of(bench)
    before = port.device
    # keeps the old number in use, like a program that still reads
    held = os.open(before, os.O_RDWR | os.O_NOCTTY)
    try:
        port.unplug()
        time.sleep(0.3)
        injection.cleared()
        port.plug(other=True)
        bench.expect(port.device != before, "the bench gave the port its old name again")
        injection.wait_recovery()
    finally:
        os.close(held)


# --- effects of the line: each function gets a frame, and returns the bytes that arrive and whether
# they contain the complete frame

Mangle = Callable[[bytes], tuple[bytes, bool]]


def garbage(generator: random.Random, wire: bytes) -> tuple[bytes, bool]:
    """Insert garbage or parts of frames between complete frames. No frame may be lost."""
    between = (
        generator.randbytes(generator.randrange(1, 400)),
        b"KODL" + generator.randbytes(generator.randrange(20)),
        wire[: generator.randrange(1, len(wire))],
        b"",
        b"",
    )
    return generator.choice(between) + wire, True


def bit_errors(generator: random.Random, wire: bytes) -> tuple[bytes, bool]:
    """Damage some frames. Only these may be lost, and no value of them may be sent.

    Bytes that the legacy layout's CRC does not cover are spared: such damage cannot be detected.
    """
    at = generator.randrange(len(wire))
    crc = len(wire) - 4
    if generator.random() > 0.3 or crc // 4 * 4 <= at < crc:
        return wire, True
    rest = wire[at + 1 :]
    flipped = wire[at] ^ 1 << generator.randrange(8)
    inserted = generator.randrange(256)
    hit = (rest, bytes([flipped]) + rest, bytes([inserted]) + wire[at:])
    return wire[:at] + generator.choice(hit), False


def line_break(_generator: random.Random, _wire: bytes) -> tuple[bytes, bool]:
    return bytes(200), False


def parity(generator: random.Random, wire: bytes) -> tuple[bytes, bool]:
    """Change the bytes as if 8N1 is used for 8E1.

    The parity bit is taken for the next byte's start bit, so the result differs between bytes.
    """
    received = bytearray()
    for byte in wire:
        has_odd_parity = byte.bit_count() & 1
        change = 0x80 if has_odd_parity else generator.choice((0, 1, 0x80))
        received.append(byte ^ change)
    return bytes(received), False


def slow_stream(generator: random.Random, _wire: bytes) -> tuple[bytes, bool]:
    """Return bytes of a slow stream that is read twelve times too fast: runs of equal bits."""
    return bytes(generator.choices((0, 0xFF, 0xFE, 0xF0, 0x80, 0xC0, 0xE0), k=12)), False


def mangled(
    bench: Bench,
    injection: Injection,
    n: int,
    how: Mangle,
    readable: bool,
) -> None:
    """Change the bytes of the first ESC for a while.

    If they are ``readable``, no value may be disturbed. Otherwise the link is lost, and the log
    reports a probably wrong parity.
    """
    bench.escs[0].mangle = how
    try:
        time.sleep(1.5 if readable else 0.8)
        if readable:
            return
        lost(bench)
        if n == 0 and "parity" in injection.fault.name:
            bench.wait_log("parity")
    finally:
        bench.escs[0].mangle = None
    injection.cleared()


for name, how, readable in (
    ("garbage between frames", garbage, True),
    ("bit errors and lost bytes", bit_errors, True),
    ("break: only zero bytes", line_break, False),
    ("every byte hit, as by a wrong parity", parity, False),
    ("a 9600 baud stream", slow_stream, False),
):
    escs, limit_s = ([], None) if readable else ([0], 2.0)
    line = partial(how, random.Random(name))
    fault("Serial", name, limit_s, escs=escs)(partial(mangled, how=line, readable=readable))


@on_first("ESC off and on", rounds=(0.5, 1.5))
def off(bench: Bench, injection: Injection, seconds: float) -> None:
    bench.escs[0].on = False
    time.sleep(seconds)
    lost(bench)
    injection.cleared()
    bench.escs[0].on = True


MODELS = (
    Identity(11, WireLayout.LEGACY, Device.JIVEPRO, 12),
    Identity(12, WireLayout.V4, Device.KOLIBRI, 3),
    Identity(1),
)


@on_first("ESC swapped for another model and layout", settle_s=1, rounds=MODELS)
def swapped(bench: Bench, injection: Injection, model: Identity) -> None:
    fed = bench.escs[0]
    fed.on = False
    time.sleep(0.6)
    fed.identity = model
    injection.cleared()
    fed.on = True
    injection.wait_recovery()
    bench.wait_until(
        lambda: bench.watch.info_device(0) == model.device.value,
        5,
        "the new ESC's device on the bus",
    )


@on_first("a stream that stutters, bytes seconds apart", rounds=[0])
def stutter(bench: Bench, injection: Injection, _n: int) -> None:
    """Send a frame in parts over several seconds. Its values are old when it is complete."""
    fed = bench.escs[0]
    fed.on = False
    time.sleep(0.05)
    wire = encode(fed.live(len(fed.sent) - 1), fed.identity.layout)
    for at in range(0, len(wire), 14):
        fed.write(wire[at : at + 14])
        time.sleep(1.2)
    lost(bench)
    injection.cleared()
    fed.on = True


@on_first("a line that is never silent", settle_s=1)
def never_silent(bench: Bench, injection: Injection, _n: int) -> None:
    """Send as many frames as 115200 baud allow.

    Newer values of this ESC may replace older ones. No value of the other ESC may be lost.
    """
    fed = bench.escs[0]
    before = fed.rate_hz
    fed.rate_hz = 260
    time.sleep(1.5)
    fed.rate_hz = before
    injection.cleared()


@on_first("a port that floods", settle_s=1)
def flood(bench: Bench, injection: Injection, _n: int) -> None:
    """Send garbage between frames, a hundred times as much as 115200 baud allow.

    The other ESC must not be disturbed.
    """
    rubbish = random.Random(5).randbytes(4096).replace(b"K", b"k")
    end = time.monotonic() + 1.5
    while time.monotonic() < end:
        bench.escs[0].write(rubbish)
        time.sleep(0.004)
    injection.cleared()


def cycles(bench: Bench, injection: Injection, times: int) -> None:
    """Check that memory, descriptors and threads do not grow after the first few cycles."""
    ports = [port_of(bench, esc) for esc in range(len(bench.escs))]
    before = bench.gateway.figures()
    for i in range(times):
        for port in ports:
            port.unplug()
        time.sleep(0.15)
        injection.cleared()
        for port in ports:
            port.plug()
        injection.wait_recovery()
        if i == times // 5:
            before = bench.gateway.figures()
    time.sleep(0.5)
    grown = bench.gateway.growth(before, 1024)
    bench.expect(not grown, f"the gateway has more than before: {grown}")


fault("Serial", "ports gone and back 25 times", 2.0, rounds=[25])(cycles)
