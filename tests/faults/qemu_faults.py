"""The faults of the emulated machine: real drivers for the USB adapters, the UART and the CAN controllers.

Each function injects its fault a few times, ``times`` as often in a long run. Imported for the names of the faults anywhere; run by
qemu_programme.py in the machine only. ESC 1 is on the 16550A, ESC 2 on QEMU's USB adapter, ESC 3 on the played one.
"""

import fcntl
import os
import signal
import subprocess
import sys
import termios
import time
from pathlib import Path
from typing import TYPE_CHECKING

from fault_report import Fault, fault
from qemu_adapters import Line
from qemu_machine import (
    can_details,
    can_up,
    controller_registers,
    controller_state,
    ip,
    line_counts,
    line_setting,
    pci_bind,
    pci_slot,
    wait_until,
)
from qemu_ports import hold

if TYPE_CHECKING:
    from qemu_programme import AdapterBench, MachineBench

UART, USB, WIRE = 0, 1, 2
BITRATE = 1_000_000
BUS_OFF_OVER, RECEIVE_OVERRUN = 0x8140, 0x8110
PORT_LIMIT_S = 2.0
"""By the issue: after a port's return."""
CAN_LIMIT_S = 1.0 + 0.5
"""By the issue 1 s after an interface's return; half a second more, as this machine is fifteen times slower than a usual one."""


# --- the start


@fault("Start", "interface missing and port in use at the start", 3.0, machine="QEMU", bench="machine")
def hampered_start(bench: "MachineBench", fault: Fault, times: int) -> None:
    """Both come later: the gateway has to wait for each by itself."""
    for _ in range(min(times, 3)):
        if bench.gateway is not None:
            bench.stop()
        slot = pci_slot("can0")
        pci_bind(slot, False)
        held = hold(bench.uart.path)
        bench.leave_out(range(len(bench.ports)), 0, time.monotonic_ns())  # nobody was there to pass it on
        with bench.injection(fault) as injection:
            gateway = bench.start(wait=False)
            for words in (f"{bench.uart.path}: is in use", "CAN interface can0"):
                bench.wait_until(lambda: any(words in said for said in gateway.lines), bench.start_limit_s, words)  # noqa: B023
            time.sleep(1)
            os.close(held)
            pci_bind(slot, True)
            wait_until(Path("/sys/class/net/can0").exists, 3, "can0")
            can_up("can0", BITRATE, restart_ms=100)
            injection.cleared()
            injection.wait_recovery()
            injection.wait_boot_up(1)


# --- serial ports


@fault("Serial", "USB adapter pulled and put back", PORT_LIMIT_S, machine="QEMU", bench="machine")
def replug(bench: "MachineBench", fault: Fault, times: int) -> None:
    for pause in [0.0, 0.3, 1.0] * times + [6.0]:
        with bench.injection(fault, escs=(USB,)) as injection:
            bench.usb.unplug()
            time.sleep(pause)
            bench.usb.plug()
            injection.cleared()
            injection.wait_recovery()


@fault("Serial", "USB adapter back under another ttyUSB number", PORT_LIMIT_S, machine="QEMU", bench="machine")
def renumbered(bench: "MachineBench", fault: Fault, times: int) -> None:
    for _ in range(2 * times):
        with bench.injection(fault, escs=(USB,)) as injection:
            before = bench.usb.device
            held = hold(before)  # another program has not let go of the old one: its number stays taken
            try:
                bench.usb.unplug()
                bench.usb.plug()
                injection.cleared()
                injection.expect(bench.usb.device != before, f"the adapter is {before} again")
                injection.wait_recovery()
            finally:
                os.close(held)
    if bench.usb.device != bench.usb.path:  # and back under its first one, by a plain replug
        with bench.injection(fault, escs=(USB,)) as injection:
            bench.usb.unplug()
            bench.usb.plug()
            injection.cleared()
            injection.wait_recovery()


@fault("Serial", "USB adapter in use by another program at its return", PORT_LIMIT_S, machine="QEMU", bench="machine")
def busy_at_return(bench: "MachineBench", fault: Fault, times: int) -> None:
    for _ in range(2 * times):
        with bench.injection(fault, escs=(WIRE,)) as injection:
            bench.wire.unplug()
            bench.wire.send = lambda data: (
                False
            )  # until echo is off: what that program would echo is not the gateway's doing
            bench.wire.plug()
            held = hold(bench.wire.device)
            try:
                fcntl.ioctl(held, termios.TIOCEXCL)
                bench.wire.send = bench.wire.clean
                time.sleep(1.5)
            finally:
                os.close(held)
            injection.cleared()
            injection.wait_recovery()


@fault("Serial", "USB adapter pulled again and again", PORT_LIMIT_S, machine="QEMU", bench="machine")
def cycles(bench: "MachineBench", fault: Fault, times: int) -> None:
    """By the played adapter, as fast as the port opens again; what the process holds must not grow."""
    assert bench.gateway is not None
    before: dict[str, int] = {}
    for i in range(12 if times == 1 else 100 * times):
        if i == 4:
            before = bench.gateway.figures()
        with bench.injection(fault, escs=(WIRE,), settle_s=0.1) as injection:
            bench.wire.unplug()
            bench.wire.plug()
            injection.cleared()
            injection.wait_recovery()
    after = bench.gateway.figures()
    row = bench.report.row(fault)
    row.figures |= {"RSS growth KiB": after["rss"] - before["rss"]}
    for name in ("descriptors", "threads"):
        row.figures[f"{name} growth"] = after[name] - before[name]
        if after[name] > before[name]:
            row.recovered -= 1
            row.notes.append(f"{name}: {before[name]} before, {after[name]} after")


@fault("Serial", "8N1 stream on the 8E1 line", PORT_LIMIT_S, machine="QEMU", bench="machine")
def wrong_parity(bench: "MachineBench", fault: Fault, times: int) -> None:
    misread(bench, fault, times, Line(115_200, "N"), "framing", "parity")


@fault("Serial", "9600 baud stream", PORT_LIMIT_S, machine="QEMU", bench="machine")
def slow_stream(bench: "MachineBench", fault: Fault, times: int) -> None:
    misread(bench, fault, times, Line(9600, "N"), "framing", "breaks")


def misread(bench: "MachineBench", fault: Fault, times: int, line: Line, *counters: str) -> None:
    for _ in range(2 * times):
        before = line_counts(bench.wire.device)
        with bench.injection(fault, escs=(WIRE,)) as injection:
            bench.wire.send = bench.wire.at(line)
            time.sleep(1.5)
            bench.wire.send = bench.wire.clean
            injection.cleared()
            injection.wait_recovery()
            after = line_counts(bench.wire.device)
            injection.expect(
                any(getattr(after, name) > getattr(before, name) for name in counters),
                f"no {counters} counted: {after}",
            )


@fault("Serial", "bit errors on the line, each tenth frame", PORT_LIMIT_S, machine="QEMU", bench="machine")
def bit_errors(bench: "MachineBench", fault: Fault, times: int) -> None:
    """Only the frames that were hit may be missing: an ESC that is disturbed only by its own lost frames."""
    wire = bench.wire
    count = 0

    def sometimes(data: bytes) -> bool:
        nonlocal count
        count += 1
        return wire.clean(data) if count % 10 else wire.flipped(data)

    before = line_counts(wire.device)
    for _ in range(times):
        with bench.injection(fault, escs=()) as injection:
            wire.send = sometimes
            time.sleep(6)
            wire.send = wire.clean
            time.sleep(0.3)
            after = line_counts(wire.device)
            errors = after.parity + after.framing - before.parity - before.framing
            injection.expect(errors >= 3, f"no errors counted: {before} {after}")
    bench.report.row(fault).figures["line errors counted"] = errors


@fault("Serial", "break, 0.3 s", PORT_LIMIT_S, machine="QEMU", bench="machine")
def line_break(bench: "MachineBench", fault: Fault, times: int) -> None:
    """On the played adapter's wire, and by QEMU on the 16550A."""
    for _ in range(2 * times):
        before = line_counts(bench.wire.device)
        with bench.injection(fault, escs=(WIRE,)) as injection:
            bench.wire.send = lambda data: False
            bench.wire.adapter.hold_low(0.3)
            time.sleep(0.3)
            bench.wire.send = bench.wire.clean
            injection.cleared()
            injection.wait_recovery()
            injection.expect(line_counts(bench.wire.device).breaks > before.breaks, "no break counted")
        before = line_counts(bench.uart.device)
        with bench.injection(fault, escs=(UART,)) as injection:
            for _ in range(10):
                bench.monitor.send_break("com1s")
            injection.cleared()
            injection.wait_recovery()
            injection.expect(line_counts(bench.uart.device).breaks >= before.breaks + 10, "no break counted")


@fault("Serial", "16550A is set to 8E1, without echo", None, machine="QEMU", bench="machine")
def uart_setting(bench: "MachineBench", fault: Fault, times: int) -> None:
    with bench.injection(fault, escs=()) as injection:
        for device in (bench.uart.device, bench.usb.device, bench.wire.device):
            setting = line_setting(device)
            injection.expect(setting == (115_200, 8, "E", 1, False), f"{device}: {setting}")
        injection.expect(bench.wire.adapter.line == Line(115_200, "E"), f"the chip: {bench.wire.adapter.line}")
        injection.expect(bench.wire.adapter.latency_ms == 1, f"latency timer {bench.wire.adapter.latency_ms} ms")


@fault("Serial", "16550A flooded with garbage at the full line rate", PORT_LIMIT_S, machine="QEMU", bench="machine")
def flood(bench: "MachineBench", fault: Fault, times: int) -> None:
    """Three seconds without a gap; the other ESCs must not notice."""
    chunk = bytes((i * 37 + i // 251) & 0xFF for i in range(115_200 // 11 // 20))
    for _ in range(times):
        with bench.injection(fault, escs=(UART,)) as injection:
            bench.uart.fed.on = False
            for _ in range(60):
                bench.uart.far.put(chunk)
                time.sleep(0.05)
            bench.uart.fed.on = True
            injection.cleared()
            injection.wait_recovery()


@fault("Serial", "receive overrun while the process is stopped", PORT_LIMIT_S, machine="QEMU", bench="machine")
def overrun(bench: "MachineBench", fault: Fault, times: int) -> None:
    """More than the kernel and the chip hold; what is read first afterwards is old and must not be sent."""
    assert bench.gateway is not None
    filler = bytes(range(256)) * 8
    for _ in range(times):
        before = line_counts(bench.wire.device)
        with bench.injection(fault) as injection:
            bench.gateway.process.send_signal(signal.SIGSTOP)
            try:
                for _ in range(60):
                    bench.wire.adapter.put(filler)
                    if bench.wire.adapter.waiting(1) > 300:
                        break
                    time.sleep(0.02)
                bench.wire.adapter.put(filler)
                time.sleep(0.5)
            finally:
                bench.gateway.process.send_signal(signal.SIGCONT)
            injection.cleared()
            injection.wait_recovery()
            after = line_counts(bench.wire.device)
            injection.expect(after.overrun > before.overrun, f"no overrun counted: {after}")


@fault("Serial", "another program sets the port to 9600 8N1", 5.0, machine="QEMU", bench="machine")
def reset_by_other(bench: "MachineBench", fault: Fault, times: int) -> None:
    """As a getty or a terminal program does that root starts on the gateway's port."""
    wire = bench.wire
    for _ in range(times):
        with bench.injection(fault, escs=(WIRE,)) as injection:
            fd = hold(wire.device)
            mode = termios.tcgetattr(fd)
            mode[2] &= ~termios.PARENB
            mode[4] = mode[5] = termios.B9600
            termios.tcsetattr(fd, termios.TCSANOW, mode)
            os.close(fd)
            injection.expect(wire.adapter.line == Line(9600, "N"), f"the chip: {wire.adapter.line}")
            injection.cleared()
            injection.wait_recovery()


# --- the CAN controllers


@fault("CAN", "controller's link down and up", CAN_LIMIT_S, machine="QEMU", bench="machine")
def link_down(bench: "MachineBench", fault: Fault, times: int) -> None:
    for pause in [0.05, 0.5, 1.5] * times + [8.0]:
        with bench.injection(fault) as injection:
            ip("link", "set", "can0", "down")
            time.sleep(pause)
            ip("link", "set", "can0", "up")
            injection.cleared()
            injection.wait_recovery()
            injection.wait_boot_up(1)


@fault("CAN", "controller taken from its driver and given back", CAN_LIMIT_S, machine="QEMU", bench="machine")
def rebound(bench: "MachineBench", fault: Fault, times: int) -> None:
    """The interface is gone, and another one with the same name comes."""
    slot = pci_slot("can0")
    for pause in [0.1, 1.0, 3.0] * times:
        with bench.injection(fault) as injection:
            pci_bind(slot, False)
            subprocess.run(
                ["cansend", "can1", "7FF#"], check=True
            )  # else can1 keeps what came last until its next interrupt
            time.sleep(pause)
            pci_bind(slot, True)
            wait_until(Path("/sys/class/net/can0").exists, 3, "can0")
            can_up("can0", BITRATE, restart_ms=100)
            injection.cleared()
            injection.wait_recovery()
            injection.wait_boot_up(1)


@fault("CAN", "controller's receive FIFO overrun", None, machine="QEMU", bench="machine")
def fifo_overrun(bench: "MachineBench", fault: Fault, times: int) -> None:
    """Its interrupts are masked while the bus sends more than 64 bytes: the driver counts it, the node says EMCY 8110h."""
    import socket

    slot = pci_slot("can0")
    registers = controller_registers(slot)
    interrupt_enable = 4
    for _ in range(2 * times):
        time.sleep(1.2)  # the node says it once a second at most
        with bench.injection(fault, escs=()) as injection:
            before = can_details("can0")["stats64"]["rx"]["over_errors"]
            enabled = os.pread(registers, 1, interrupt_enable)
            frame = (0x7FF).to_bytes(4, sys.byteorder) + bytes((8, 0, 0, 0)) + bytes(8)
            with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as sender:
                sender.bind(("can1",))
                os.pwrite(registers, b"\0", interrupt_enable)
                for _ in range(10):
                    sender.send(frame)
                os.pwrite(registers, enabled, interrupt_enable)
                sender.send(frame)
            bench.wait_until(lambda: RECEIVE_OVERRUN in injection.emergency_codes(1), 2, "EMCY 8110h")
            counted = can_details("can0")["stats64"]["rx"]["over_errors"]
            injection.expect(counted > before, "the driver has counted no overrun")
    os.close(registers)


@fault("CAN", "1500 foreign frames in a row", None, machine="QEMU", bench="machine")
def foreign_flood(bench: "MachineBench", fault: Fault, times: int) -> None:
    for _ in range(times):
        with bench.injection(fault, escs=()):
            subprocess.run(
                ["cangen", "can1", "-g", "1", "-n", "1500", "-I", "5A5", "-L", "8", "-D", "i", "-p", "10"], check=True
            )


# --- a CAN adapter whose bus has errors


@fault("CAN", "bus-off, restart-ms 100", CAN_LIMIT_S, machine="QEMU", bench="adapter")
def bus_off(bench: "AdapterBench", fault: Fault, times: int) -> None:
    for _ in range(3 * times):
        with bench.injection(fault) as injection:
            bench.adapter.go_bus_off()
            injection.cleared()
            injection.wait_recovery()
            injection.wait_boot_up(1)
            bench.wait_until(lambda: BUS_OFF_OVER in injection.emergency_codes(1), 2, "EMCY 8140h")


@fault(
    "CAN", "bus-off, restart-ms 0, `ip link set can2 type can restart`", CAN_LIMIT_S, machine="QEMU", bench="adapter"
)
def bus_off_for_good(bench: "AdapterBench", fault: Fault, times: int) -> None:
    begin = time.monotonic_ns()
    ip("link", "set", "can2", "down")
    can_up("can2", BITRATE, restart_ms=0)
    up = time.monotonic_ns()
    bench.leave_out([0], begin, bench.wait_fresh([0], up, 10, up))
    for pause in [0.5, 3.0] * times:
        with bench.injection(fault) as injection:
            bench.adapter.go_bus_off()
            time.sleep(pause)
            injection.expect(controller_state("can2") == "BUS-OFF", "it is not bus-off")
            ip("link", "set", "can2", "type", "can", "restart")
            injection.cleared()
            injection.wait_recovery()
            injection.wait_boot_up(1)
            bench.wait_until(lambda: BUS_OFF_OVER in injection.emergency_codes(1), 2, "EMCY 8140h")
    with bench.injection(fault) as injection:  # the other way out
        bench.adapter.go_bus_off()
        time.sleep(0.5)
        ip("link", "set", "can2", "down")
        can_up("can2", BITRATE, restart_ms=100)
        injection.cleared()
        injection.wait_recovery()
        injection.wait_boot_up(1)


@fault("CAN", "error passive and active again", None, machine="QEMU", bench="adapter")
def error_passive(bench: "AdapterBench", fault: Fault, times: int) -> None:
    def state_is(state: int) -> bool:
        return bench.watch.value("GatewayStatus", "can_state") == state

    for _ in range(2 * times):
        with bench.injection(fault, escs=()):
            bench.adapter.disturb(
                0x24, transmit=250 - bench.adapter.tx_errors
            )  # bit errors; a good frame takes one off
            bench.wait_until(lambda: controller_state("can2") == "ERROR-PASSIVE", 2, "the driver says error passive")
            bench.wait_until(lambda: state_is(3), 2, "CanState ErrorPassive on the bus")
            bench.adapter.heal()
            bench.wait_until(lambda: state_is(1), 3, "CanState ErrorActive on the bus")


@fault("CAN", "no other node acknowledges", CAN_LIMIT_S, machine="QEMU", bench="adapter")
def no_acknowledge(bench: "AdapterBench", fault: Fault, times: int) -> None:
    for pause in [1.0, 4.0] * times:
        with bench.injection(fault) as injection:
            ip("link", "set", "can3", "down")
            time.sleep(pause)
            ip("link", "set", "can3", "up")
            injection.cleared()
            injection.wait_recovery()


@fault("CAN", "gateway's bit rate wrong", CAN_LIMIT_S, machine="QEMU", bench="adapter")
def wrong_bitrate(bench: "AdapterBench", fault: Fault, times: int) -> None:
    for _ in range(times):
        with bench.injection(fault) as injection:
            ip("link", "set", "can2", "down")
            can_up("can2", BITRATE // 2, restart_ms=100)
            time.sleep(2)
            ip("link", "set", "can2", "down")
            can_up("can2", BITRATE, restart_ms=100)
            injection.cleared()
            injection.wait_recovery()
            injection.wait_boot_up(1)


@fault("CAN", "adapter hangs with a full queue, is reset", CAN_LIMIT_S, machine="QEMU", bench="adapter")
def stalled(bench: "AdapterBench", fault: Fault, times: int) -> None:
    """Set down while it hangs: else the frames that the kernel holds for it, five or so, come out late, which nobody can prevent."""
    for pause in [2.0, 5.0] * times:
        with bench.injection(fault) as injection:
            bench.adapter.stall(True)
            time.sleep(pause)
            subprocess.run(["ip", "link", "set", "can2", "down"], check=False)  # the driver says that it gets no answer
            bench.adapter.stall(False)
            can_up("can2", BITRATE, restart_ms=100)
            injection.cleared()
            injection.wait_recovery()
            injection.wait_boot_up(1)
