"""The faults of the emulated machine: real drivers for the UART, for a USB adapter and for the CAN controllers.

ESC 1 is on the 16550A, ESC 2 on the played adapter; the gateway is on can0, the judge on can1. What a CAN bus does to a driver
is in can_faults.py, with the kernel's slcan driver.
"""

import fcntl
import itertools
import os
import signal
import termios
import time
from functools import partial

from beds import fault
from harness import Injection
from qemu_adapter import ESC_LINE, FRESH_LINE, Line
from qemu_bed import MachineBench, machine
from qemu_machine import (
    AS_SET,
    controller_registers,
    driver_back,
    hold,
    line_counts,
    line_setting,
    pci_bind,
    pci_slot,
    receive_overruns,
)
from raw_bus import RawBus

UART, WIRE = 0, 1
PORT_LIMIT_S = 2.0
"""By the issue: after a port's return."""
CAN_LIMIT_S = 1.0 + 0.5
"""By the issue 1 s after an interface's return; half a second more, as this machine is fifteen times slower than a usual one."""
RECEIVE_OVERRUN = 0x8110
on_machine = partial(fault, machine="QEMU", bed=machine)
serial = partial(on_machine, "Serial", limit_s=PORT_LIMIT_S)


@on_machine("Start", "interface missing and port in use at the start", 3.0, rounds=[0])
def hampered_start(bench: MachineBench, injection: Injection, _n: int) -> None:
    """Both come later: the gateway has to wait for each by itself."""
    bench.stop()
    slot = pci_slot("can0")
    pci_bind(slot, False)
    held = hold(bench.uart.path)
    bench.start(wait=False)
    for words in (f"{bench.uart.path}: is in use", "CAN interface can0"):
        bench.wait_log(words, seconds=bench.start_limit_s)
    time.sleep(1)
    os.close(held)
    driver_back(slot)
    injection.cleared()
    injection.wait_recovery()
    injection.wait_boot_up(1)


# --- serial ports


@serial("USB adapter in use by another program at its return", escs=[WIRE])
def busy_at_return(bench: MachineBench, injection: Injection, _n: int) -> None:
    """The first of its port: what comes and goes is summed up later on."""
    wire = bench.wire
    wire.unplug()
    # until echo is off: what that program would echo is not the gateway's doing
    wire.send = wire.silent
    wire.plug()
    held = hold(wire.device)
    try:
        fcntl.ioctl(held, termios.TIOCEXCL)
        wire.send = wire.clean
        time.sleep(1.5)
    finally:
        os.close(held)
    injection.cleared()
    injection.wait_recovery()
    bench.wait_log(f"{wire.device}: is in use")


@serial("USB adapter pulled and put back", escs=[WIRE], rounds=(0.0, 0.3, 1.0, 6.0))
def replug(bench: MachineBench, injection: Injection, pause: float) -> None:
    bench.wire.unplug()
    time.sleep(pause)
    bench.wire.plug()
    injection.cleared()


@serial("USB adapter back under another ttyUSB number", escs=[WIRE])
def renumbered(bench: MachineBench, injection: Injection, _n: int) -> None:
    """And back under its first one: while another program has not let go of the old one, its number stays taken."""
    before = bench.wire.device
    held = hold(before)
    try:
        bench.wire.unplug()
        bench.wire.plug()
        injection.cleared()
        bench.expect(bench.wire.device != before, f"the adapter is {before} again")
        injection.wait_recovery()
    finally:
        os.close(held)


def misread(
    bench: MachineBench, injection: Injection, _n: int, line: Line, counters: tuple[str, ...]
) -> None:
    """An ESC that sends by other settings for a while; the driver has to count it."""
    wire = bench.wire
    before = line_counts(wire.device)
    wire.send = wire.at(line)
    time.sleep(1.5)
    wire.send = wire.clean
    injection.cleared()
    injection.wait_recovery()
    after = line_counts(wire.device)
    counted = any(getattr(after, name) > getattr(before, name) for name in counters)
    bench.expect(counted, f"no {counters} counted: {after}")


for name, line, counters in (
    ("8N1 stream on the 8E1 line", Line(parity="N"), ("framing", "parity")),
    ("9600 baud stream", FRESH_LINE, ("framing", "breaks")),
):
    serial(name, escs=[WIRE])(partial(misread, line=line, counters=counters))


@serial("bit errors on the line, each tenth frame", escs=[], rounds=[0])
def bit_errors(bench: MachineBench, injection: Injection, _n: int) -> None:
    """Only the frames that were hit may be missing."""
    wire = bench.wire
    sent = itertools.count(1)

    def sometimes(data: bytes) -> bool:
        return wire.clean(data) if next(sent) % 10 else wire.flipped(data)

    before = line_counts(wire.device)
    wire.send = sometimes
    time.sleep(6)
    wire.send = wire.clean
    time.sleep(0.3)
    after = line_counts(wire.device)
    errors = after.parity + after.framing - before.parity - before.framing
    bench.expect(errors >= 3, f"no errors counted: {before} {after}")


@serial("break, 0.3 s", escs=[WIRE])
def line_break(bench: MachineBench, injection: Injection, _n: int) -> None:
    wire = bench.wire
    before = line_counts(wire.device).breaks
    wire.send = wire.silent
    wire.adapter.hold_low(0.3)
    time.sleep(0.3)
    wire.send = wire.clean
    injection.cleared()
    injection.wait_recovery()
    bench.expect(line_counts(wire.device).breaks > before, "no break counted")


@on_machine("Serial", "all ports are set to 8E1, without echo", None, escs=[], rounds=[0])
def port_setting(bench: MachineBench, injection: Injection, _n: int) -> None:
    adapter = bench.wire.adapter
    for device in (bench.uart.device, bench.wire.device):
        setting = line_setting(device)
        bench.expect(setting == AS_SET, f"{device}: {setting}")
    bench.expect(adapter.line == ESC_LINE, f"the chip: {adapter.line}")
    bench.expect(adapter.latency_ms == 1, f"the chip's latency timer: {adapter.latency_ms} ms")


@serial("16550A flooded with garbage at the full line rate", escs=[UART], rounds=[0])
def flood(bench: MachineBench, injection: Injection, _n: int) -> None:
    """Three seconds without a gap; the other ESC must not notice."""
    chunk = bytes((i * 37 + i // 251) & 0xFF for i in range(115_200 // 11 // 20))
    bench.uart.on = False
    for _ in range(60):
        bench.uart.put(chunk)
        time.sleep(0.05)
    bench.uart.on = True
    injection.cleared()


@serial("receive overrun while the process is stopped", rounds=[0])
def overrun(bench: MachineBench, injection: Injection, _n: int) -> None:
    """More than the kernel and the chip hold; what is read first afterwards is old and must not be sent."""
    wire = bench.wire
    filler = bytes(range(256)) * 8
    before = line_counts(wire.device).overrun
    bench.gateway.process.send_signal(signal.SIGSTOP)
    try:
        for _ in range(60):
            wire.adapter.put(filler)
            if wire.adapter.waiting() > 300:
                break
            time.sleep(0.02)
        wire.adapter.put(filler)
        time.sleep(0.5)
    finally:
        bench.gateway.process.send_signal(signal.SIGCONT)
    injection.cleared()
    injection.wait_recovery()
    bench.expect(line_counts(wire.device).overrun > before, "no overrun counted")


@on_machine("Serial", "another program sets the port to 9600 8N1", 5.0, rounds=(UART, WIRE))
def reset_by_other(bench: MachineBench, injection: Injection, index: int) -> None:
    """As a getty does that root starts on the gateway's port. QEMU's far end goes on as before: there it is the setting that is judged."""
    injection.escs = [index]
    port = (bench.uart, bench.wire)[index]
    said = len(bench.gateway.lines)
    fd = hold(port.device)
    mode = termios.tcgetattr(fd)
    mode[2] &= ~termios.PARENB
    mode[4] = mode[5] = termios.B9600
    termios.tcsetattr(fd, termios.TCSANOW, mode)
    os.close(fd)
    if index == WIRE:
        line = bench.wire.adapter.line
        bench.expect(line == FRESH_LINE, f"the chip: {line}")
    injection.cleared()
    bench.wait_log(port.device, said)
    bench.wait_until(lambda: line_setting(port.device) == AS_SET, 10, "the settings are restored")
    restored_ns = time.monotonic_ns()
    injection.wait_recovery()
    injection.healed_at(restored_ns)


# --- CAN controllers


@on_machine(
    "CAN", "controller taken from its driver and given back", CAN_LIMIT_S, rounds=(0.1, 1.0, 3.0)
)
def rebound(bench: MachineBench, injection: Injection, pause: float) -> None:
    """The interface is gone, and another one with the same name comes."""
    slot = pci_slot("can0")
    pci_bind(slot, False)
    # else can1 keeps what came last until its next interrupt
    with RawBus("can1") as other:
        other.send(0x7FF)
    time.sleep(pause)
    driver_back(slot)
    injection.cleared()
    injection.wait_recovery()
    injection.wait_boot_up(1)


@on_machine("CAN", "controller's receive FIFO overrun", None, escs=[])
def fifo_overrun(bench: MachineBench, injection: Injection, _n: int) -> None:
    """Its interrupts are masked while the bus sends more than 64 bytes: the driver counts it, the node says EMCY 8110h."""
    time.sleep(1.2)  # the node says it once a second at most
    registers = controller_registers(pci_slot("can0"))
    interrupt_enable = 4
    before = receive_overruns("can0")
    enabled = os.pread(registers, 1, interrupt_enable)
    with RawBus("can1") as sender:
        os.pwrite(registers, b"\0", interrupt_enable)
        for _ in range(10):
            sender.send(0x7FF, bytes(8))
        os.pwrite(registers, enabled, interrupt_enable)
        sender.send(0x7FF, bytes(8))
    os.close(registers)
    injection.wait_emergency(1, RECEIVE_OVERRUN)
    bench.expect(receive_overruns("can0") > before, "the driver has counted no overrun")
