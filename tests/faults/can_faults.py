"""Faults of the CAN interface and of the bus behind it. Each disturbs all ESCs; the serial side must go on."""

import subprocess
import time

import benches
from bus_watch import SECOND
from fault_report import Fault, fault
from harness import Bench, Injection
from raw_bus import ERROR_FLAG, RawBus
from slcan_adapters import Adapter, Bus

LIMIT_S = 1.0
ACTIVE, PASSIVE = 1, 3
BUS_OFF_LEFT = 0x8140
MAX_IN_CONTROLLER = 6
"""Frames that the kernel has taken and that nobody can take back: as many as the smallest send buffer that it grants holds."""


def ip(*words: str) -> None:
    benches.run("ip", *words)


def wait_can_state(bench: Bench, state: int) -> None:
    """Wait until GatewayStatus says so."""
    bench.wait_until(
        lambda: bench.watch.value("GatewayStatus", "can_state") == state, 3, f"CanState {state}"
    )


def boot_ups(injection: Injection) -> None:
    """Each node says that it has started anew."""
    for node in range(1, len(injection.bench.ports) + 1):
        injection.wait_boot_up(node)


@fault("CAN", "interface down and up", LIMIT_S)
def down(bench: Bench, fault: Fault, times: int) -> None:
    for pause in [0.05, 0.5, 1.2] * times + [24 if times > 10 else 4]:
        with bench.injection(fault) as injection:
            ip("link", "set", bench.interface, "down")
            time.sleep(pause)
            injection.cleared()
            ip("link", "set", bench.interface, "up")
            injection.wait_recovery()
            boot_ups(injection)


@fault("CAN", "interface deleted and made again", LIMIT_S)
def deleted(bench: Bench, fault: Fault, times: int) -> None:
    for i in range(times):
        with bench.injection(fault) as injection:
            ip("link", "del", bench.interface)
            time.sleep((0.1, 0.6, 2)[i % 3])
            benches.make_pair(bench.interface, bench.watched, up=False)
            injection.cleared()
            ip("link", "set", bench.interface, "up")
            injection.wait_recovery()
            boot_ups(injection)


@fault("CAN", "interface missing at start", LIMIT_S)
def missing(bench: Bench, fault: Fault, times: int) -> None:
    for _ in range(max(1, times // 2)):
        with bench.injection(fault) as injection:
            injection.expect(bench.stop() == 0, "the gateway did not end well")
            ip("link", "del", bench.interface)
            bench.start(wait=False)
            bench.wait_log("Trying again", seconds=20)
            time.sleep(0.7)
            benches.make_pair(bench.interface, bench.watched, up=False)
            injection.cleared()
            ip("link", "set", bench.interface, "up")
            injection.wait_recovery()
            boot_ups(injection)


@fault("CAN", "bus-off that restart-ms ends (error frames)", LIMIT_S)
def bus_off(bench: Bench, fault: Fault, times: int) -> None:
    for _ in range(times):
        with bench.injection(fault) as injection, RawBus(bench.watched) as far:
            far.send(ERROR_FLAG | 0x40, bytes(8))
            time.sleep(0.5)
            injection.cleared()
            far.send(ERROR_FLAG | 0x100, bytes(8))
            injection.wait_recovery()
            boot_ups(injection)
            injection.wait_emergency(1, BUS_OFF_LEFT)


def limit(interface: str, rate: str) -> None:
    """The bus takes no more than that; the kernel's queue is full soon, and then it says ENOBUFS. A new limit keeps what waits."""
    words = ["tbf", "rate", rate, "burst", "160", "limit", "160"]
    for verb in ("change", "add"):
        command = ["tc", "qdisc", verb, "dev", interface, "root", *words]
        if subprocess.run(command, capture_output=True, check=False).returncode == 0:
            return
    raise AssertionError("no limit could be set")


FREE = "1gbit"


def unlimit(interface: str) -> None:
    """To be called when nothing waits: what waits is thrown away."""
    benches.run("tc", "qdisc", "del", "dev", interface, "root")


@fault("CAN", "ENOBUFS: a bus that takes less than there is to send", LIMIT_S)
def no_buffers(bench: Bench, fault: Fault, times: int) -> None:
    """In the long run for a minute. The values that come are as fresh as ever."""
    for _ in range(max(1, times // 3)):
        with bench.injection(fault, settle_s=1) as injection:
            limit(bench.interface, "24kbit")
            time.sleep(60 if times > 10 else 6)
            limit(bench.interface, FREE)
            injection.cleared()
            injection.wait_recovery()
            unlimit(bench.interface)


@fault("CAN", "a bus 100 % loaded by others", LIMIT_S)
def loaded(bench: Bench, fault: Fault, times: int) -> None:
    """No frame of ours gets through; the others' come in as fast as the machine makes them. What the controller holds then is late."""
    for _ in range(max(1, times // 2)):
        with bench.injection(fault, settle_s=1) as injection:
            limit(bench.interface, "8bit")
            words = ["cangen", bench.watched, "-g", "1", "-I", "010", "-L", "8", "-D", "i"]
            others = subprocess.Popen(words, stderr=subprocess.DEVNULL)
            time.sleep(4)
            others.terminate()
            others.wait()
            limit(bench.interface, FREE)
            with RawBus(bench.interface) as near:
                # the limiter only looks at its queue when something comes
                near.send(0x7F0, wait=False)
            injection.cleared()
            injection.in_the_controller = MAX_IN_CONTROLLER, time.monotonic_ns() + SECOND
            injection.wait_recovery()
            unlimit(bench.interface)


# --- adapters with controllers


def adapters_of(bench: Bench) -> tuple[Bus, Adapter, Adapter]:
    bus = benches.BUSES[bench.interface]
    near, far = bus.adapters
    return bus, near, far


def restart(adapter: Adapter) -> None:
    """What ends a bus-off where restart-ms is 0."""
    adapter.down()
    ip("link", "set", adapter.name, "up")


@fault("CAN", "controller bus-off without restart-ms, down and up", LIMIT_S, bench="adapters")
def controller_bus_off(bench: Bench, fault: Fault, times: int) -> None:
    _, near, _ = adapters_of(bench)
    for _ in range(times):
        with bench.injection(fault, settle_s=1) as injection:
            near.silent = True
            near.tell_state("b", 0, 255)
            time.sleep(0.7)
            injection.cleared()
            restart(near)
            injection.wait_recovery()
            boot_ups(injection)
            injection.wait_emergency(1, BUS_OFF_LEFT)


@fault("CAN", "controller error passive", None, bench="adapters")
def passive(bench: Bench, fault: Fault, times: int) -> None:
    _, near, _ = adapters_of(bench)
    for _ in range(times):
        with bench.injection(fault, []) as injection:
            near.tell_errors("f")
            near.tell_state("p", 10, 130)
            wait_can_state(bench, PASSIVE)
            injection.cleared()
            near.tell_state("a", 0, 0)
            wait_can_state(bench, ACTIVE)


@fault("CAN", "no other node acknowledges", LIMIT_S, bench="adapters")
def no_acknowledge(bench: Bench, fault: Fault, times: int) -> None:
    _, near, far = adapters_of(bench)
    for _ in range(times):
        with bench.injection(fault, settle_s=1) as injection:
            far.down()
            time.sleep(1.5)
            injection.cleared()
            ip("link", "set", far.name, "up")
            near.tell_state("a", 0, 0)
            injection.wait_recovery()


@fault("CAN", "wrong bit rate", LIMIT_S, bench="adapters")
def wrong_rate(bench: Bench, fault: Fault, times: int) -> None:
    _, near, _ = adapters_of(bench)
    for _ in range(times):
        with bench.injection(fault, settle_s=1) as injection:
            near.down()
            near.up(250_000)
            time.sleep(1.2)
            near.down()
            injection.cleared()
            near.up(benches.ADAPTER_RATE)
            injection.wait_recovery()


@fault("CAN", "an adapter that hangs", LIMIT_S, bench="adapters")
def hanging(bench: Bench, fault: Fault, times: int) -> None:
    """What it had taken before it hung goes out late, as old as it is: that is inside the adapter. What the gateway sends is fresh."""
    _, near, _ = adapters_of(bench)
    for _ in range(times):
        with bench.injection(fault, settle_s=1) as injection:
            before = bench.watch.slack_ns
            bench.watch.slack_ns = 3 * SECOND
            near.stalled = True
            time.sleep(1.5)
            near.stalled = False
            injection.cleared()
            injection.wait_recovery()
            time.sleep(0.2)
            bench.watch.slack_ns = before


@fault("CAN", "adapter unplugged and plugged in again", LIMIT_S, bench="adapters")
def unplugged(bench: Bench, fault: Fault, times: int) -> None:
    bus, near, _ = adapters_of(bench)
    for _ in range(times):
        with bench.injection(fault, settle_s=1) as injection:
            near.close()
            time.sleep(0.6)
            near = bus.adapters[0] = Adapter(bus, bench.interface)
            injection.cleared()
            near.up(benches.ADAPTER_RATE)
            injection.wait_recovery()
            boot_ups(injection)
