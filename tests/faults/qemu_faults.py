"""The faults of the emulated machine: real drivers for the UART, for a USB adapter and for the CAN controllers.

Imported for the names of the faults anywhere; run by qemu_programme.py in the machine only. ESC 1 is on the 16550A, ESC 2 on the played
adapter; the gateway is on can0, the judge on can1. What a CAN bus does to a driver is in can_faults.py, with the kernel's slcan driver.
"""

import fcntl
import itertools
import os
import signal
import subprocess
import termios
import time
from functools import partial
from typing import TYPE_CHECKING

from fault_report import Fault, fault
from harness import Injection, injected
from qemu_adapter import ESC_LINE, Line
from qemu_machine import (
    controller_registers,
    driver_back,
    hold,
    line_counts,
    line_setting,
    pci_bind,
    pci_slot,
    receive_overruns,
)
from qemu_ports import AS_SET
from raw_bus import RawBus

if TYPE_CHECKING:
    from qemu_programme import MachineBench

UART, WIRE = 0, 1
PORT_LIMIT_S = 2.0
"""By the issue: after a port's return."""
CAN_LIMIT_S = 1.0 + 0.5
"""By the issue 1 s after an interface's return; half a second more, as this machine is fifteen times slower than a usual one."""
RECEIVE_OVERRUN = 0x8110
serial = partial(injected, "Serial", machine="QEMU", bench="machine")
on_controller = partial(injected, "CAN", machine="QEMU", bench="machine")


def twice(times: int) -> range:
    return range(2 * times)


@fault(
    "Start", "interface missing and port in use at the start", 3.0, machine="QEMU", bench="machine"
)
def hampered_start(bench: "MachineBench", fault: Fault, times: int) -> None:
    """Both come later: the gateway has to wait for each by itself."""
    for _ in range(min(times, 3)):
        bench.stop()
        slot = pci_slot("can0")
        pci_bind(slot, False)
        held = hold(bench.uart.path)
        # nobody was there to pass it on
        bench.leave_out(range(len(bench.ports)), 0, time.monotonic_ns())
        with bench.injection(fault) as injection:
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


@serial(
    "USB adapter in use by another program at its return", PORT_LIMIT_S, escs=[WIRE], rounds=twice
)
def busy_at_return(bench: "MachineBench", injection: Injection, _n: int) -> None:
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


@serial(
    "USB adapter pulled and put back",
    PORT_LIMIT_S,
    escs=[WIRE],
    rounds=lambda times: [0.0, 0.3, 1.0] * times + [6.0],
)
def replug(bench: "MachineBench", injection: Injection, pause: float) -> None:
    bench.wire.unplug()
    time.sleep(pause)
    bench.wire.plug()
    injection.cleared()


@serial("USB adapter back under another ttyUSB number", PORT_LIMIT_S, escs=[WIRE], rounds=twice)
def renumbered(bench: "MachineBench", injection: Injection, _n: int) -> None:
    """And back under its first one: while another program has not let go of the old one, its number stays taken."""
    before = bench.wire.device
    held = hold(before)
    try:
        bench.wire.unplug()
        bench.wire.plug()
        injection.cleared()
        injection.expect(bench.wire.device != before, f"the adapter is {before} again")
        injection.wait_recovery()
    finally:
        os.close(held)


def misread(
    bench: "MachineBench", injection: Injection, _n: int, line: Line, counters: tuple[str, ...]
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
    injection.expect(counted, f"no {counters} counted: {after}")


for name, line, counters in (
    ("8N1 stream on the 8E1 line", Line(parity="N"), ("framing", "parity")),
    ("9600 baud stream", Line(9600, "N"), ("framing", "breaks")),
):
    played = partial(misread, line=line, counters=counters)
    serial(name, PORT_LIMIT_S, escs=[WIRE], rounds=twice)(played)


@serial("bit errors on the line, each tenth frame", PORT_LIMIT_S, escs=[])
def bit_errors(bench: "MachineBench", injection: Injection, _n: int) -> None:
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
    injection.expect(errors >= 3, f"no errors counted: {before} {after}")
    injection.row.count("line errors counted", errors)


@serial("break, 0.3 s", PORT_LIMIT_S, escs=[WIRE], rounds=twice)
def line_break(bench: "MachineBench", injection: Injection, _n: int) -> None:
    wire = bench.wire
    before = line_counts(wire.device).breaks
    wire.send = wire.silent
    wire.adapter.hold_low(0.3)
    time.sleep(0.3)
    wire.send = wire.clean
    injection.cleared()
    injection.wait_recovery()
    injection.expect(line_counts(wire.device).breaks > before, "no break counted")


@serial("all ports are set to 8E1, without echo", None, escs=[], rounds=lambda _: [0])
def port_setting(bench: "MachineBench", injection: Injection, _n: int) -> None:
    adapter = bench.wire.adapter
    for device in (bench.uart.device, bench.wire.device):
        setting = line_setting(device)
        injection.expect(setting == AS_SET, f"{device}: {setting}")
    injection.expect(adapter.line == ESC_LINE, f"the chip: {adapter.line}")
    injection.expect(adapter.latency_ms == 1, f"the chip's latency timer: {adapter.latency_ms} ms")


@serial("16550A flooded with garbage at the full line rate", PORT_LIMIT_S, escs=[UART])
def flood(bench: "MachineBench", injection: Injection, _n: int) -> None:
    """Three seconds without a gap; the other ESC must not notice."""
    chunk = bytes((i * 37 + i // 251) & 0xFF for i in range(115_200 // 11 // 20))
    bench.uart.fed.on = False
    for _ in range(60):
        bench.uart.far.put(chunk)
        time.sleep(0.05)
    bench.uart.fed.on = True
    injection.cleared()


@serial("receive overrun while the process is stopped", PORT_LIMIT_S)
def overrun(bench: "MachineBench", injection: Injection, _n: int) -> None:
    """More than the kernel and the chip hold; what is read first afterwards is old and must not be sent."""
    assert bench.gateway is not None
    wire = bench.wire
    filler = bytes(range(256)) * 8
    before = line_counts(wire.device).overrun
    bench.gateway.process.send_signal(signal.SIGSTOP)
    try:
        for _ in range(60):
            wire.adapter.put(filler)
            if wire.adapter.waiting(1) > 300:
                break
            time.sleep(0.02)
        wire.adapter.put(filler)
        time.sleep(0.5)
    finally:
        bench.gateway.process.send_signal(signal.SIGCONT)
    injection.cleared()
    injection.wait_recovery()
    injection.expect(line_counts(wire.device).overrun > before, "no overrun counted")


@fault("Serial", "another program sets the port to 9600 8N1", 5.0, machine="QEMU", bench="machine")
def reset_by_other(bench: "MachineBench", fault: Fault, times: int) -> None:
    """As a getty does that root starts on the gateway's port. QEMU's far end goes on as before: there it is the setting that is judged."""
    assert bench.gateway is not None
    for index, port in ((UART, bench.uart), (WIRE, bench.wire)) * times:
        with bench.injection(fault, escs=(index,)) as injection:
            said = len(bench.gateway.lines)
            fd = hold(port.device)
            mode = termios.tcgetattr(fd)
            mode[2] &= ~termios.PARENB
            mode[4] = mode[5] = termios.B9600
            termios.tcsetattr(fd, termios.TCSANOW, mode)
            os.close(fd)
            if index == WIRE:
                injection.expect(
                    bench.wire.adapter.line == Line(9600, "N"),
                    f"the chip: {bench.wire.adapter.line}",
                )
            injection.cleared()
            bench.wait_log(port.device, said)
            bench.wait_until(
                lambda: line_setting(port.device) == AS_SET,  # noqa: B023
                10,
                "the settings are restored",
            )
            restored_ns = time.monotonic_ns()
            injection.wait_recovery()
            injection.healed_at(restored_ns)


# --- CAN controllers


@on_controller(
    "controller taken from its driver and given back",
    CAN_LIMIT_S,
    rounds=lambda times: [0.1, 1.0, 3.0] * times,
)
def rebound(bench: "MachineBench", injection: Injection, pause: float) -> None:
    """The interface is gone, and another one with the same name comes."""
    slot = pci_slot("can0")
    pci_bind(slot, False)
    # else can1 keeps what came last until its next interrupt
    subprocess.run(["cansend", "can1", "7FF#"], check=True)
    time.sleep(pause)
    driver_back(slot)
    injection.cleared()
    injection.wait_recovery()
    injection.wait_boot_up(1)


@on_controller(
    "controller's receive FIFO overrun", None, escs=[], rounds=lambda times: range(2 * times)
)
def fifo_overrun(bench: "MachineBench", injection: Injection, _n: int) -> None:
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
    injection.expect(receive_overruns("can0") > before, "the driver has counted no overrun")
