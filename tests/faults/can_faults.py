"""Faults of the CAN interface and of the bus behind it. Each disturbs all ESCs; the serial side must go on."""

import contextlib
import subprocess
import time
from collections.abc import Iterator
from functools import partial

from beds import ADAPTER_RATE, BUS, adapters, fault, make_pair, run
from bus_watch import SECOND
from harness import Bench, Injection
from raw_bus import ERROR_FLAG, RawBus
from slcan_adapters import Adapter
from traffic_faults import still_answers

ACTIVE, PASSIVE = 1, 3
BUS_OFF_LEFT = 0x8140
MAX_IN_CONTROLLER = 6
"""Frames that the kernel has taken and that nobody can take back: as many as the smallest send buffer that it grants holds."""
SLOW_BITS_PER_S = 24_000
HELD_NS = MAX_IN_CONTROLLER * 16 * 8 * SECOND // SLOW_BITS_PER_S
"""How long a bus that slow takes for them, 16 bytes each: 32 ms."""
FREE = "1gbit"
on_cable = partial(fault, "CAN", limit_s=1.0)
on_adapter = partial(fault, "CAN", bed=adapters, settle_s=1)


def back_up(injection: Injection) -> None:
    """The interface is up again, each node says that it has started anew, and hears."""
    injection.cleared()
    run(f"ip link set {injection.bench.interface} up")
    injection.wait_recovery()
    boot_ups(injection)
    still_answers(injection.bench)


def boot_ups(injection: Injection) -> None:
    for node in range(1, len(injection.bench.escs) + 1):
        injection.wait_boot_up(node)


@on_cable("interface down and up", rounds=(0.05, 0.5, 1.2, 4))
def down(bench: Bench, injection: Injection, pause: float) -> None:
    run(f"ip link set {bench.interface} down")
    time.sleep(pause)
    back_up(injection)


@on_cable("interface deleted and made again", rounds=(0.1, 0.6))
def deleted(bench: Bench, injection: Injection, pause: float) -> None:
    run(f"ip link del {bench.interface}")
    time.sleep(pause)
    make_pair(bench.interface, bench.watched)
    back_up(injection)


@on_cable("interface missing at start", rounds=[0])
def missing(bench: Bench, injection: Injection, _n: int) -> None:
    bench.expect(bench.stop() == 0, "the gateway did not end well")
    run(f"ip link del {bench.interface}")
    bench.start(wait=False)
    bench.wait_log("Trying again", seconds=20)
    time.sleep(0.7)
    make_pair(bench.interface, bench.watched)
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


@contextlib.contextmanager
def slow_bus(injection: Injection, rate: str, held_ns: int) -> Iterator[None]:
    """The bus takes no more than that; the kernel's queue is full soon, and then it says ENOBUFS. Free again, it keeps what waits.

    Values may be late by ``held_ns`` until then: the kernel had them, and nobody can take them back from it.
    """
    interface, watch = injection.bench.interface, injection.bench.watch
    watch.more_ns = held_ns
    run(f"tc qdisc add dev {interface} root tbf rate {rate} burst 160 limit 160")
    yield
    run(f"tc qdisc change dev {interface} root tbf rate {FREE} burst 160 limit 160")
    with RawBus(interface) as near:
        # the limiter only looks at its queue when something comes
        near.send(0x7F0, wait=False)
    injection.cleared()
    injection.wait_recovery()
    watch.catch_up()
    watch.more_ns = 0
    run(f"tc qdisc del dev {interface} root")  # what waits is thrown away: nothing does


@on_cable("ENOBUFS: a bus that takes less than there is to send", settle_s=1, rounds=[6])
def no_buffers(bench: Bench, injection: Injection, seconds: float) -> None:
    """The values that come are as fresh as ever, but for what the kernel holds of such a bus."""
    with slow_bus(injection, f"{SLOW_BITS_PER_S}bit", HELD_NS):
        time.sleep(seconds)


@on_cable("a bus 100 % loaded by others", settle_s=1, rounds=[4])
def loaded(bench: Bench, injection: Injection, seconds: float) -> None:
    """No frame of ours gets through; the others' come in as fast as the machine makes them. What the controller holds then is late."""
    before = bench.watch.by_more
    with slow_bus(injection, "8bit", 3600 * SECOND):
        words = f"cangen {bench.watched} -g 1 -I 010 -L 8 -D i".split()
        others = subprocess.Popen(words, stderr=subprocess.DEVNULL)
        time.sleep(seconds)
        others.terminate()
        others.wait()
    late = bench.watch.by_more - before
    bench.expect(late <= MAX_IN_CONTROLLER, f"{late} values were late")


# --- adapters with controllers


def near() -> Adapter:
    """The gateway's."""
    return BUS[0].adapters[0]


@on_adapter("controller bus-off without restart-ms, down and up", 1.0)
def controller_bus_off(bench: Bench, injection: Injection, _n: int) -> None:
    near().silent = True
    near().tell_state("b", 0, 255)
    time.sleep(0.7)
    near().down()
    back_up(injection)
    injection.wait_emergency(1, BUS_OFF_LEFT)


@on_adapter("controller error passive", None, escs=[])
def passive(bench: Bench, injection: Injection, _n: int) -> None:
    def wait_can_state(state: int) -> None:
        """Wait until GatewayStatus says so."""
        bench.wait_until(
            lambda: bench.watch.value("GatewayStatus", "can_state") == state, 3, f"CanState {state}"
        )

    near().tell_errors("f")
    near().tell_state("p", 10, 130)
    wait_can_state(PASSIVE)
    near().tell_state("a", 0, 0)
    wait_can_state(ACTIVE)


@on_adapter("no other node acknowledges", 1.0)
def no_acknowledge(bench: Bench, injection: Injection, _n: int) -> None:
    far = BUS[0].adapters[1]
    far.down()
    time.sleep(1.5)
    injection.cleared()
    run(f"ip link set {far.name} up")
    near().tell_state("a", 0, 0)


@on_adapter("wrong bit rate", 1.0)
def wrong_rate(bench: Bench, injection: Injection, _n: int) -> None:
    near().down()
    near().up(250_000)
    time.sleep(1.2)
    near().down()
    injection.cleared()
    near().up(ADAPTER_RATE)


@on_adapter("an adapter that hangs", 1.0)
def hanging(bench: Bench, injection: Injection, _n: int) -> None:
    """What it had taken before it hung goes out late, as old as it is: that is inside the adapter. What the gateway sends is fresh."""
    bench.watch.more_ns = 3 * SECOND
    near().stalled = True
    time.sleep(1.5)
    near().stalled = False
    injection.cleared()
    injection.wait_recovery()
    time.sleep(0.2)
    bench.watch.more_ns = 0


@on_adapter("adapter unplugged and plugged in again", 1.0)
def unplugged(bench: Bench, injection: Injection, _n: int) -> None:
    near().close()
    time.sleep(0.6)
    BUS[0].adapters[0] = Adapter(BUS[0], bench.interface)
    injection.cleared()
    near().up(ADAPTER_RATE)
    injection.wait_recovery()
    boot_ups(injection)
