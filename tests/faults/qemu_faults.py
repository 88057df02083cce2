"""The faults of the emulated machine: real drivers for the UART, the USB serial adapter and the CAN controllers.

Each function injects its fault a few times, ``times`` as often in a long run. Imported for the names of the faults anywhere; run by
qemu_programme.py in the machine only. ESC 1 is on the 16550A, ESC 2 on the USB adapter.
"""

import os
import socket
import subprocess
import sys
import termios
import time
from pathlib import Path
from typing import TYPE_CHECKING

from fault_report import Fault, fault
from qemu_machine import (
    can_up,
    controller_registers,
    hold,
    ip,
    line_breaks,
    line_setting,
    pci_bind,
    pci_slot,
    receive_overruns,
    wait_until,
)
from qemu_ports import AS_SET

if TYPE_CHECKING:
    from qemu_programme import MachineBench

UART, USB = 0, 1
RECEIVE_OVERRUN = 0x8110
PORT_LIMIT_S = 2.0
"""By the issue: after a port's return."""
CAN_LIMIT_S = 1.0 + 0.5
"""By the issue 1 s after an interface's return; half a second more, as this machine is fifteen times slower than a usual one."""


def driver_back(slot: str) -> None:
    """Give the first controller to its driver again, and bring its interface up."""
    pci_bind(slot, True)
    wait_until(Path("/sys/class/net/can0").exists, 3, "can0")
    can_up("can0")


@fault("Start", "interface missing and port in use at the start", 3.0, machine="QEMU", bench="machine")
def hampered_start(bench: "MachineBench", fault: Fault, times: int) -> None:
    """Both come later: the gateway has to wait for each by itself."""
    for _ in range(min(times, 3)):
        bench.stop()
        slot = pci_slot("can0")
        pci_bind(slot, False)
        held = hold(bench.uart.path)
        bench.leave_out(range(len(bench.ports)), 0, time.monotonic_ns())  # nobody was there to pass it on
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
    """And back under its first one: while another program has not let go of the old one, its number stays taken."""
    for _ in range(2 * times):
        with bench.injection(fault, escs=(USB,)) as injection:
            before = bench.usb.device
            held = hold(before)
            try:
                bench.usb.unplug()
                bench.usb.plug()
                injection.cleared()
                injection.expect(bench.usb.device != before, f"the adapter is {before} again")
                injection.wait_recovery()
            finally:
                os.close(held)


@fault("Serial", "break", PORT_LIMIT_S, machine="QEMU", bench="machine")
def line_break(bench: "MachineBench", fault: Fault, times: int) -> None:
    """Ten of them on the 16550A."""
    for _ in range(2 * times):
        before = line_breaks(bench.uart.device)
        with bench.injection(fault, escs=(UART,)) as injection:
            for _ in range(10):
                bench.monitor.must("chardev-send-break", id="com1s")
            injection.cleared()
            injection.wait_recovery()
            injection.expect(line_breaks(bench.uart.device) >= before + 10, "no break counted")


@fault("Serial", "both ports are set to 8E1, without echo", None, machine="QEMU", bench="machine")
def port_setting(bench: "MachineBench", fault: Fault, times: int) -> None:
    with bench.injection(fault, escs=()) as injection:
        for device in (bench.uart.device, bench.usb.device):
            setting = line_setting(device)
            injection.expect(setting == AS_SET, f"{device}: {setting}")
        latency = Path("/sys/bus/usb-serial/devices", Path(bench.usb.device).name, "latency_timer").read_text().strip()
        injection.expect(latency == "1", f"latency timer {latency} ms")


@fault("Serial", "16550A flooded with garbage at the full line rate", PORT_LIMIT_S, machine="QEMU", bench="machine")
def flood(bench: "MachineBench", fault: Fault, times: int) -> None:
    """Three seconds without a gap; the other ESC must not notice."""
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


@fault("Serial", "another program sets the port to 9600 8N1", 5.0, machine="QEMU", bench="machine")
def reset_by_other(bench: "MachineBench", fault: Fault, times: int) -> None:
    """As a getty does that root starts on the gateway's port. The far end goes on as before: it is the setting that is judged."""
    assert bench.gateway is not None
    for index, port in ((UART, bench.uart), (USB, bench.usb)) * times:
        with bench.injection(fault, escs=(index,)) as injection:
            said = len(bench.gateway.lines)
            fd = hold(port.device)
            mode = termios.tcgetattr(fd)
            mode[2] &= ~termios.PARENB
            mode[4] = mode[5] = termios.B9600
            termios.tcsetattr(fd, termios.TCSANOW, mode)
            os.close(fd)
            injection.cleared()
            bench.wait_log(port.device, said)
            bench.wait_until(lambda: line_setting(port.device) == AS_SET, 10, "the settings are restored")  # noqa: B023
            restored_ns = time.monotonic_ns()
            injection.wait_recovery()
            injection.healed_at(restored_ns)


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
            # else can1 keeps what came last until its next interrupt
            subprocess.run(["cansend", "can1", "7FF#"], check=True)
            time.sleep(pause)
            driver_back(slot)
            injection.cleared()
            injection.wait_recovery()
            injection.wait_boot_up(1)


@fault("CAN", "controller's receive FIFO overrun", None, machine="QEMU", bench="machine")
def fifo_overrun(bench: "MachineBench", fault: Fault, times: int) -> None:
    """Its interrupts are masked while the bus sends more than 64 bytes: the driver counts it, the node says EMCY 8110h."""
    registers = controller_registers(pci_slot("can0"))
    interrupt_enable = 4
    for _ in range(2 * times):
        time.sleep(1.2)  # the node says it once a second at most
        with bench.injection(fault, escs=()) as injection:
            before = receive_overruns("can0")
            enabled = os.pread(registers, 1, interrupt_enable)
            frame = (0x7FF).to_bytes(4, sys.byteorder) + bytes((8, 0, 0, 0)) + bytes(8)
            with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as sender:
                sender.bind(("can1",))
                os.pwrite(registers, b"\0", interrupt_enable)
                for _ in range(10):
                    sender.send(frame)
                os.pwrite(registers, enabled, interrupt_enable)
                sender.send(frame)
            injection.wait_emergency(1, RECEIVE_OVERRUN)
            injection.expect(receive_overruns("can0") > before, "the driver has counted no overrun")
    os.close(registers)
