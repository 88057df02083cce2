"""Faults of the serial line and of the ESC behind it. The other ESC's values must not be disturbed by any of them."""

import contextlib
import fcntl
import os
import random
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial

from encoding import Identity
from fault_report import Fault, fault
from harness import Bench, Injection, PtyPort, growth, half, injected

from kontronik_can_gw.esc.kontronik.codec import Layout, encode
from kontronik_can_gw.esc.kontronik.states import Device

LIMIT_S = 2.0
LOST, PORT_ERROR = 4, 5
on_first = partial(injected, "Serial", escs=[0])
"""A fault of the first ESC."""


def port_of(bench: Bench) -> PtyPort:
    port = bench.ports[0]
    assert isinstance(port, PtyPort)
    return port


def lost(bench: Bench) -> None:
    """Wait until the link is said to be lost."""
    bench.wait_until(
        lambda: bench.watch.value("Esc1Link", "link_state") in (LOST, PORT_ERROR),
        5,
        "the link is said to be lost",
    )


@contextlib.contextmanager
def replugged(port: PtyPort) -> Iterator[None]:
    """Unplug and plug in again; the gateway sees the port when the block ends."""
    port.unplug()
    link = port.link
    port.link = link.with_name("hidden")
    port.plug()
    yield
    port.link.rename(link)
    port.link = link


@on_first("port busy at its return", LIMIT_S)
def busy(bench: Bench, injection: Injection, _n: int) -> None:
    port = port_of(bench)
    with replugged(port):
        fd = os.open(port.device, os.O_RDWR | os.O_NOCTTY)
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    time.sleep(1.2)
    os.close(fd)
    injection.cleared()
    bench.wait_log("in use")


@on_first("permission missing at its return", LIMIT_S)
def permission(bench: Bench, injection: Injection, _n: int) -> None:
    port = port_of(bench)
    with replugged(port):
        os.chmod(port.device, 0)
    time.sleep(1.2)
    bench.wait_log("permission denied")
    injection.cleared()
    os.chmod(port.device, 0o620)


@on_first(
    "port gone and back",
    LIMIT_S,
    rounds=lambda times: [0.05, 0.3, 0.7] * max(1, times // 2) + [24 if times > 10 else 4],
)
def gone(bench: Bench, injection: Injection, pause: float) -> None:
    port = port_of(bench)
    port.unplug()
    if pause > 1:
        lost(bench)
    time.sleep(pause)
    injection.cleared()
    port.plug()


@on_first("port back under another name", LIMIT_S)
def other_name(bench: Bench, injection: Injection, _n: int) -> None:
    port = port_of(bench)
    before = port.device
    # keeps the old number taken, as a program does that reads on
    held = os.open(before, os.O_RDWR | os.O_NOCTTY)
    try:
        port.unplug()
        time.sleep(0.3)
        injection.cleared()
        port.plug(other=True)
        injection.expect(port.device != before, "the bench gave the port its old name again")
        injection.wait_recovery()
    finally:
        os.close(held)


# --- what the line makes of the bytes: each takes a frame, and returns what comes and whether the frame is whole in it

Mangle = Callable[[bytes], tuple[bytes, bool]]


def garbage(generator: random.Random, wire: bytes) -> tuple[bytes, bool]:
    """Whatever comes between whole frames, bits of frames included, no frame is lost."""
    kind = generator.randrange(5)
    if kind == 0:
        return generator.randbytes(generator.randrange(1, 400)) + wire, True
    if kind == 1:
        return b"KODL" + generator.randbytes(generator.randrange(20)) + wire, True
    if kind == 2:
        return wire[: generator.randrange(1, len(wire))] + wire, True
    return wire, True


def bit_errors(generator: random.Random, wire: bytes) -> tuple[bytes, bool]:
    """Frames that are hit are lost and nothing else; none of them shows a wrong value."""
    if generator.random() > 0.3:
        return wire, True
    at = generator.randrange(len(wire))
    kind = generator.randrange(3)
    if kind == 0:
        return wire[:at] + wire[at + 1 :], False
    if kind == 1:
        return wire[:at] + bytes([wire[at] ^ 1 << generator.randrange(8)]) + wire[at + 1 :], False
    return wire[:at] + bytes([generator.randrange(256)]) + wire[at:], False


def line_break(_generator: random.Random, _wire: bytes) -> tuple[bytes, bool]:
    return bytes(200), False


def parity(generator: random.Random, wire: bytes) -> tuple[bytes, bool]:
    """8N1 for 8E1 reads the parity bit as the next byte's start: what comes out is different from byte to byte."""
    return bytes(
        x ^ (0x80 if x.bit_count() & 1 else generator.choice((0, 1, 0x80))) for x in wire
    ), False


def slow_stream(generator: random.Random, _wire: bytes) -> tuple[bytes, bool]:
    """Read twelve times too fast, each bit is a run of equal bits."""
    return bytes(generator.choices((0, 0xFF, 0xFE, 0xF0, 0x80, 0xC0, 0xE0), k=12)), False


def mangled(bench: Bench, injection: Injection, n: int, how: Mangle, readable: bool) -> None:
    """Nothing may be disturbed, or nothing is right any more: that a wrong setting is likely is said after a while."""
    bench.fed[0].mangle = how
    try:
        time.sleep(1.5 if readable else 0.8)
        if readable:
            return
        lost(bench)
        if n == 0 and "parity" in injection.fault.name:
            bench.wait_log("parity")
    finally:
        bench.fed[0].mangle = None
    injection.cleared()


for name, how, readable in (
    ("garbage between frames", garbage, True),
    ("bit errors and lost bytes", bit_errors, True),
    ("break: only zero bytes", line_break, False),
    ("every byte hit, as by a wrong parity", parity, False),
    ("a 9600 baud stream", slow_stream, False),
):
    escs, limit_s = ([], None) if readable else ([0], LIMIT_S)
    line = partial(how, random.Random(name))
    injected("Serial", name, limit_s, escs=escs)(partial(mangled, how=line, readable=readable))


@on_first("ESC off and on", LIMIT_S)
def off(bench: Bench, injection: Injection, n: int) -> None:
    bench.fed[0].on = False
    time.sleep((0.5, 1.5, 3)[n % 3])
    lost(bench)
    injection.cleared()
    bench.fed[0].on = True


MODELS = [
    Identity(11, Layout.LEGACY, Device.JIVEPRO, 12),
    Identity(12, Layout.V4, Device.KOLIBRI, 3),
    Identity(13, Layout.V4, Device.KOSMIK, 14),
    Identity(1),
]


@on_first(
    "ESC swapped for another model and layout",
    LIMIT_S,
    settle_s=1,
    rounds=lambda times: [*(MODELS * times)[:times], Identity(1)],
)
def swapped(bench: Bench, injection: Injection, model: Identity) -> None:
    fed = bench.fed[0]
    fed.on = False
    time.sleep(0.6)
    fed.become(model)
    injection.cleared()
    fed.on = True
    injection.wait_recovery()
    bench.wait_until(
        lambda: bench.watch.info_device(0) == model.device.value,
        5,
        "the new ESC's device on the bus",
    )


@on_first("a stream that stutters, bytes seconds apart", LIMIT_S, rounds=half)
def stutter(bench: Bench, injection: Injection, _n: int) -> None:
    """A frame of which the end comes seconds after its beginning is old."""
    fed = bench.fed[0]
    fed.on = False
    time.sleep(0.05)
    wire = encode(fed.live(len(fed.sent) - 1), fed.identity.layout)
    for at in range(0, len(wire), 14):
        fed.write(wire[at : at + 14])
        time.sleep(1.2)
    lost(bench)
    injection.cleared()
    fed.on = True


@on_first("a line that is never silent", LIMIT_S, settle_s=1)
def never_silent(bench: Bench, injection: Injection, _n: int) -> None:
    """Frame behind frame, as many as 115200 baud carry: of one ESC newer values take the place of older ones, of the other none is lost."""
    fed = bench.fed[0]
    before, fed.rate_hz = fed.rate_hz, 260
    time.sleep(1.5)
    fed.rate_hz = before
    injection.cleared()


@injected("Serial", "a port that floods", LIMIT_S, settle_s=1)
def flood(bench: Bench, injection: Injection, _n: int) -> None:
    """Rubbish and frames as fast as a pseudo terminal takes them, many times a UART's pace: the other ESC goes on, perhaps thinned out."""
    rubbish = random.Random(5).randbytes(4096).replace(b"K", b"k")
    bench.watch.reset_silence()
    stop = threading.Event()

    def pour() -> None:
        while not stop.is_set():
            if not bench.fed[0].write(rubbish):
                time.sleep(0.001)

    thread = threading.Thread(target=pour, daemon=True)
    thread.start()
    time.sleep(1.5)
    stop.set()
    thread.join()
    silence = bench.longest_silence_s([1])
    injection.row.peak("ms the other ESC was silent", int(1000 * silence))
    injection.expect(silence < 0.25, f"the other ESC was silent for {silence:.2f} s")
    injection.cleared()


@fault("Serial", "ports gone and back again and again", LIMIT_S, bench="cycles")
def cycles(bench: Bench, fault: Fault, times: int) -> None:
    """Nothing grows: memory, descriptors and threads after the cycles are what they were after the first few."""
    rounds = 500 if times > 10 else 25
    ports = [port for port in bench.ports if isinstance(port, PtyPort)]
    row = bench.report.row(fault)
    assert bench.gateway is not None
    before = bench.gateway.figures()
    for i in range(rounds):
        with bench.injection(fault, settle_s=0) as injection:
            for port in ports:
                port.unplug()
            time.sleep(0.15)
            injection.cleared()
            for port in ports:
                port.plug()
            injection.wait_recovery()
            if i == rounds // 5:
                before = bench.gateway.figures()
    time.sleep(0.5)
    if growth(row, before, bench.gateway.figures(), 1024 + rounds):
        row.recovered -= 1
    row.injected *= len(ports)
    row.recovered *= len(ports)
    bench.watch.reset_silence()
