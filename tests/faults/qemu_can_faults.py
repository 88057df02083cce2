"""The faults of the emulated machine's CAN interfaces: real drivers for the controllers and for a USB adapter whose bus has errors.

As in qemu_serial_faults.py. The gateway is on can0, the judge on can1; of the played adapters the gateway is on can2, the judge on can3.
"""

import os
import socket
import subprocess
import sys
import time
from typing import TYPE_CHECKING

from can_faults import ACTIVE, BUS_OFF_LEFT, PASSIVE, wait_can_state
from fault_report import Fault, fault
from harness import Injection
from qemu_adapters import STATUS_BIT
from qemu_machine import (
    BITRATE,
    can_up,
    controller_registers,
    controller_state,
    driver_back,
    ip,
    pci_bind,
    pci_slot,
    receive_overruns,
)

if TYPE_CHECKING:
    from qemu_programme import AdapterBench, MachineBench

RECEIVE_OVERRUN = 0x8110
CAN_LIMIT_S = 1.0 + 0.5
"""By the issue 1 s after an interface's return; half a second more, as this machine is fifteen times slower than a usual one."""


def wait_back(injection: Injection, *, bus_off: bool = False) -> None:
    """The cause is gone: wait until the node is on the bus again."""
    injection.cleared()
    injection.wait_recovery()
    injection.wait_boot_up(1)
    if bus_off:
        injection.wait_emergency(1, BUS_OFF_LEFT)


# --- the controllers


@fault("CAN", "controller's link down and up", CAN_LIMIT_S, machine="QEMU", bench="machine")
def link_down(bench: "MachineBench", fault: Fault, times: int) -> None:
    for pause in [0.05, 0.5, 1.5] * times + [8.0]:
        with bench.injection(fault) as injection:
            ip("link", "set", "can0", "down")
            time.sleep(pause)
            ip("link", "set", "can0", "up")
            wait_back(injection)


@fault(
    "CAN",
    "controller taken from its driver and given back",
    CAN_LIMIT_S,
    machine="QEMU",
    bench="machine",
)
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
            wait_back(injection)


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


@fault("CAN", "1500 foreign frames in a row", None, machine="QEMU", bench="machine")
def foreign_flood(bench: "MachineBench", fault: Fault, times: int) -> None:
    words = "cangen can1 -g 1 -n 1500 -I 5A5 -L 8 -D i -p 10"
    for _ in range(times):
        with bench.injection(fault, escs=()):
            subprocess.run(words.split(), check=True)


# --- a CAN adapter whose bus has errors


@fault("CAN", "bus-off, restart-ms 100", CAN_LIMIT_S, machine="QEMU", bench="adapter")
def bus_off(bench: "AdapterBench", fault: Fault, times: int) -> None:
    for _ in range(3 * times):
        with bench.injection(fault) as injection:
            bench.adapter.go_bus_off()
            wait_back(injection, bus_off=True)


@fault(
    "CAN",
    "bus-off, restart-ms 0, `ip link set can2 type can restart`",
    CAN_LIMIT_S,
    machine="QEMU",
    bench="adapter",
)
def bus_off_for_good(bench: "AdapterBench", fault: Fault, times: int) -> None:
    """In the end the other way out: down and up."""
    begin = time.monotonic_ns()
    can_up("can2", restart_ms=0)
    up = time.monotonic_ns()
    bench.leave_out([0], begin, bench.wait_fresh([0], up, 10, up))
    for pause, restarted in [*[(0.5, True), (3.0, True)] * times, (0.5, False)]:
        with bench.injection(fault) as injection:
            bench.adapter.go_bus_off()
            time.sleep(pause)
            injection.expect(controller_state("can2") == "BUS-OFF", "it is not bus-off")
            if restarted:
                ip("link", "set", "can2", "type", "can", "restart")
            else:
                can_up("can2")
            wait_back(injection, bus_off=restarted)


@fault("CAN", "error passive and active again", None, machine="QEMU", bench="adapter")
def error_passive(bench: "AdapterBench", fault: Fault, times: int) -> None:
    adapter = bench.adapter
    for _ in range(2 * times):
        with bench.injection(fault, escs=()):
            # a good frame takes one off
            adapter.disturb(STATUS_BIT, transmit=250 - adapter.tx_errors)
            bench.wait_until(
                lambda: controller_state("can2") == "ERROR-PASSIVE",
                2,
                "the driver says error passive",
            )
            wait_can_state(bench, PASSIVE)
            adapter.heal()
            wait_can_state(bench, ACTIVE)


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
            can_up("can2", BITRATE // 2)
            time.sleep(2)
            can_up("can2")
            wait_back(injection)


@fault(
    "CAN", "adapter hangs with a full queue, is reset", CAN_LIMIT_S, machine="QEMU", bench="adapter"
)
def stalled(bench: "AdapterBench", fault: Fault, times: int) -> None:
    """Set down while it hangs: else the frames that the kernel holds for it, five or so, come out late, which nobody can prevent."""
    for pause in [2.0, 5.0] * times:
        with bench.injection(fault) as injection:
            bench.adapter.stall(True)
            time.sleep(pause)
            # the driver says that it gets no answer
            subprocess.run(["ip", "link", "set", "can2", "down"], check=False)
            bench.adapter.stall(False)
            can_up("can2")
            wait_back(injection)
