"""Faults of the CAN interface and of the bus behind it. Each disturbs all ESCs; the serial side must go on."""

import subprocess
import time
from functools import partial

import benches
from bus_watch import SECOND
from harness import Bench, Injection, half, injected
from raw_bus import ERROR_FLAG, RawBus
from slcan_adapters import Adapter
from traffic_faults import still_answers

LIMIT_S = 1.0
ACTIVE, PASSIVE = 1, 3
BUS_OFF_LEFT = 0x8140
MAX_IN_CONTROLLER = 6
"""Frames that the kernel has taken and that nobody can take back: as many as the smallest send buffer that it grants holds."""
SLOW_BITS_PER_S = 24_000
HELD_NS = MAX_IN_CONTROLLER * 16 * 8 * SECOND // SLOW_BITS_PER_S
"""How long a bus that slow takes for them, 16 bytes each: 32 ms."""
ip = partial(benches.run, "ip")
on_cable = partial(injected, "CAN", limit_s=LIMIT_S)
on_adapter = partial(injected, "CAN", bench="adapters", settle_s=1)


def wait_can_state(bench: Bench, state: int) -> None:
    """Wait until GatewayStatus says so."""
    bench.wait_until(
        lambda: bench.watch.value("GatewayStatus", "can_state") == state, 3, f"CanState {state}"
    )


def back_up(injection: Injection) -> None:
    """The interface is up again, each node says that it has started anew, and hears."""
    injection.cleared()
    ip("link", "set", injection.bench.interface, "up")
    injection.wait_recovery()
    boot_ups(injection)
    still_answers(injection)


def boot_ups(injection: Injection) -> None:
    for node in range(1, len(injection.bench.ports) + 1):
        injection.wait_boot_up(node)


@on_cable(
    "interface down and up",
    rounds=lambda times: [0.05, 0.5, 1.2] * max(1, times // 2) + [24 if times > 10 else 4],
)
def down(bench: Bench, injection: Injection, pause: float) -> None:
    ip("link", "set", bench.interface, "down")
    time.sleep(pause)
    back_up(injection)


@on_cable("interface deleted and made again")
def deleted(bench: Bench, injection: Injection, n: int) -> None:
    ip("link", "del", bench.interface)
    time.sleep((0.1, 0.6, 2)[n % 3])
    benches.make_pair(bench.interface, bench.watched, up=False)
    back_up(injection)


@on_cable("interface missing at start", rounds=half)
def missing(bench: Bench, injection: Injection, _n: int) -> None:
    injection.expect(bench.stop() == 0, "the gateway did not end well")
    ip("link", "del", bench.interface)
    bench.start(wait=False)
    bench.wait_log("Trying again", seconds=20)
    time.sleep(0.7)
    benches.make_pair(bench.interface, bench.watched, up=False)
    back_up(injection)


@on_cable("bus-off that restart-ms ends (error frames)")
def bus_off(bench: Bench, injection: Injection, _n: int) -> None:
    with RawBus(bench.watched) as far:
        far.send(ERROR_FLAG | 0x40, bytes(8))
        time.sleep(0.5)
        injection.cleared()
        far.send(ERROR_FLAG | 0x100, bytes(8))
    injection.wait_recovery()
    boot_ups(injection)
    injection.wait_emergency(1, BUS_OFF_LEFT)


def limit(interface: str, rate: str) -> None:
    """The bus takes no more than that; the kernel's queue is full soon, and then it says ENOBUFS. A new limit keeps what waits."""
    words = f"dev {interface} root tbf rate {rate} burst 160 limit 160".split()
    for verb in ("change", "add"):
        command = ["tc", "qdisc", verb, *words]
        if subprocess.run(command, capture_output=True, check=False).returncode == 0:
            return
    raise AssertionError("no limit could be set")


FREE = "1gbit"


def unlimit(interface: str) -> None:
    """To be called when nothing waits: what waits is thrown away."""
    benches.run("tc", "qdisc", "del", "dev", interface, "root")


@on_cable(
    "ENOBUFS: a bus that takes less than there is to send",
    settle_s=1,
    rounds=lambda times: [60 if times > 10 else 6] * max(1, times // 3),
)
def no_buffers(bench: Bench, injection: Injection, seconds: float) -> None:
    """The values that come are as fresh as ever, but for what the kernel holds of such a bus."""
    bench.watch.slack_ns += HELD_NS
    limit(bench.interface, f"{SLOW_BITS_PER_S}bit")
    time.sleep(seconds)
    limit(bench.interface, FREE)
    injection.cleared()
    injection.wait_recovery()
    unlimit(bench.interface)
    bench.watch.slack_ns -= HELD_NS


@on_cable("a bus 100 % loaded by others", settle_s=1, rounds=half)
def loaded(bench: Bench, injection: Injection, _n: int) -> None:
    """No frame of ours gets through; the others' come in as fast as the machine makes them. What the controller holds then is late."""
    limit(bench.interface, "8bit")
    words = f"cangen {bench.watched} -g 1 -I 010 -L 8 -D i".split()
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


def adapters_of(bench: Bench) -> list[Adapter]:
    """The gateway's and the judge's."""
    return benches.BUSES[bench.interface].adapters


@on_adapter("controller bus-off without restart-ms, down and up", LIMIT_S)
def controller_bus_off(bench: Bench, injection: Injection, _n: int) -> None:
    near, _ = adapters_of(bench)
    near.silent = True
    near.tell_state("b", 0, 255)
    time.sleep(0.7)
    near.down()
    back_up(injection)
    injection.wait_emergency(1, BUS_OFF_LEFT)


@on_adapter("controller error passive", None, escs=[], settle_s=0.5)
def passive(bench: Bench, injection: Injection, _n: int) -> None:
    near, _ = adapters_of(bench)
    near.tell_errors("f")
    near.tell_state("p", 10, 130)
    wait_can_state(bench, PASSIVE)
    near.tell_state("a", 0, 0)
    wait_can_state(bench, ACTIVE)


@on_adapter("no other node acknowledges", LIMIT_S)
def no_acknowledge(bench: Bench, injection: Injection, _n: int) -> None:
    near, far = adapters_of(bench)
    far.down()
    time.sleep(1.5)
    injection.cleared()
    ip("link", "set", far.name, "up")
    near.tell_state("a", 0, 0)


@on_adapter("wrong bit rate", LIMIT_S)
def wrong_rate(bench: Bench, injection: Injection, _n: int) -> None:
    near, _ = adapters_of(bench)
    near.down()
    near.up(250_000)
    time.sleep(1.2)
    near.down()
    injection.cleared()
    near.up(benches.ADAPTER_RATE)


@on_adapter("an adapter that hangs", LIMIT_S)
def hanging(bench: Bench, injection: Injection, _n: int) -> None:
    """What it had taken before it hung goes out late, as old as it is: that is inside the adapter. What the gateway sends is fresh."""
    near, _ = adapters_of(bench)
    before = bench.watch.slack_ns
    bench.watch.slack_ns = 3 * SECOND
    near.stalled = True
    time.sleep(1.5)
    near.stalled = False
    injection.cleared()
    injection.wait_recovery()
    time.sleep(0.2)
    bench.watch.slack_ns = before


@on_adapter("adapter unplugged and plugged in again", LIMIT_S)
def unplugged(bench: Bench, injection: Injection, _n: int) -> None:
    bus = benches.BUSES[bench.interface]
    bus.adapters[0].close()
    time.sleep(0.6)
    near = bus.adapters[0] = Adapter(bus, bench.interface)
    injection.cleared()
    near.up(benches.ADAPTER_RATE)
    injection.wait_recovery()
    boot_ups(injection)
