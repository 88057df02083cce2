"""The faults of the emulated machine's CAN interfaces: real drivers for the controllers and for a USB adapter whose bus has errors.

As in qemu_serial_faults.py. The gateway is on can0, the judge on can1; of the played adapters the gateway is on can2, the judge on can3.
"""

import os
import subprocess
import time
from functools import partial
from typing import TYPE_CHECKING

from can_faults import ACTIVE, BUS_OFF_LEFT, PASSIVE, wait_can_state
from fault_report import Fault, fault
from harness import Injection, injected
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
from raw_bus import RawBus

if TYPE_CHECKING:
    from qemu_programme import AdapterBench, MachineBench

RECEIVE_OVERRUN = 0x8110
CAN_LIMIT_S = 1.0 + 0.5
"""By the issue 1 s after an interface's return; half a second more, as this machine is fifteen times slower than a usual one."""
on_controller = partial(injected, "CAN", machine="QEMU", bench="machine")
on_adapter = partial(injected, "CAN", machine="QEMU", bench="adapter")


def back(injection: Injection, *, bus_off: bool = False) -> None:
    """The cause is gone: wait until the node is on the bus again."""
    injection.cleared()
    injection.wait_recovery()
    injection.wait_boot_up(1)
    if bus_off:
        injection.wait_emergency(1, BUS_OFF_LEFT)


# --- the controllers


@on_controller(
    "controller's link down and up",
    CAN_LIMIT_S,
    rounds=lambda times: [0.05, 0.5, 1.5] * times + [8.0],
)
def link_down(bench: "MachineBench", injection: Injection, pause: float) -> None:
    ip("link", "set", "can0", "down")
    time.sleep(pause)
    ip("link", "set", "can0", "up")
    back(injection)


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
    back(injection)


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


@on_controller("1500 foreign frames in a row", None, escs=[])
def foreign_flood(bench: "MachineBench", injection: Injection, _n: int) -> None:
    words = "cangen can1 -g 1 -n 1500 -I 5A5 -L 8 -D i -p 10"
    subprocess.run(words.split(), check=True)


# --- a CAN adapter whose bus has errors


@on_adapter("bus-off, restart-ms 100", CAN_LIMIT_S, rounds=lambda times: range(3 * times))
def bus_off(bench: "AdapterBench", injection: Injection, _n: int) -> None:
    bench.adapter.go_bus_off()
    back(injection, bus_off=True)


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
            back(injection, bus_off=restarted)


@on_adapter("error passive and active again", None, escs=[], rounds=lambda times: range(2 * times))
def error_passive(bench: "AdapterBench", injection: Injection, _n: int) -> None:
    adapter = bench.adapter
    # a good frame takes one off
    adapter.disturb(STATUS_BIT, transmit=250 - adapter.tx_errors)
    bench.wait_until(
        lambda: controller_state("can2") == "ERROR-PASSIVE", 2, "the driver says error passive"
    )
    wait_can_state(bench, PASSIVE)
    adapter.heal()
    wait_can_state(bench, ACTIVE)


@on_adapter("no other node acknowledges", CAN_LIMIT_S, rounds=lambda times: [1.0, 4.0] * times)
def no_acknowledge(bench: "AdapterBench", injection: Injection, pause: float) -> None:
    ip("link", "set", "can3", "down")
    time.sleep(pause)
    ip("link", "set", "can3", "up")
    injection.cleared()


@on_adapter("gateway's bit rate wrong", CAN_LIMIT_S)
def wrong_bitrate(bench: "AdapterBench", injection: Injection, _n: int) -> None:
    can_up("can2", BITRATE // 2)
    time.sleep(2)
    can_up("can2")
    back(injection)


@on_adapter(
    "adapter hangs with a full queue, is reset",
    CAN_LIMIT_S,
    rounds=lambda times: [2.0, 5.0] * times,
)
def stalled(bench: "AdapterBench", injection: Injection, pause: float) -> None:
    """Set down while it hangs: else the frames that the kernel holds for it, five or so, come out late, which nobody can prevent."""
    bench.adapter.stall(True)
    time.sleep(pause)
    # the driver says that it gets no answer
    subprocess.run(["ip", "link", "set", "can2", "down"], check=False)
    bench.adapter.stall(False)
    can_up("can2")
    back(injection)
