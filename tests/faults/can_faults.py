"""Faults of the CAN interface and its bus, hostile or broken traffic, and many ESCs with faults.

A fault of the interface disturbs all ESCs, but the serial side must continue. Traffic of other
devices must not disturb any ESC.
"""

import contextlib
import random
import subprocess
import time
from collections.abc import Iterator
from functools import partial

from beds import ADAPTER_RATE, BUS, adapters, eight, fault, make_pair, parked, run
from bus_watch import SECOND, TIMEOUT_NS
from harness import Bench, Injection, PtyPort
from raw_bus import ERROR_FLAG, RawBus
from slcan_adapters import Adapter

from kontronik_can_gw.status import GatewayState

CONFLICT = 0x8150
traffic = partial(
    fault,
    "Traffic",
    limit_s=None,
    escs=[],
    settle_s=1,
)
ACTIVE = 1
PASSIVE = 3
BUS_OFF_LEFT = 0x8140
MAX_IN_CONTROLLER = 6
"""Frames in the kernel that cannot be taken back: the capacity of its smallest send buffer."""
SLOW_BITS_PER_S = 24_000
BITS_OF_FRAME = 16 * 8
"""Bits of a frame in the kernel, which limits the rate of these."""
HELD_NS = MAX_IN_CONTROLLER * BITS_OF_FRAME * SECOND // SLOW_BITS_PER_S
"""Duration of these frames of 16 bytes on such a slow bus: 32 ms."""
FREE = "1gbit"
on_cable = partial(fault, "CAN", limit_s=1.0)
on_adapter = partial(fault, "CAN", bed=adapters, settle_s=1)


def still_answers(bench: Bench) -> None:
    """Check that the node's SDO server still answers."""
    with RawBus(bench.watched) as master:
        found = master.read(1, 0x1000, 0)
        bench.expect(found == 0, f"object 1000h is {found}")


def back_up(injection: Injection) -> None:
    """Set the interface up, and check that each node boots and answers."""
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


@on_cable("parked: all ESCs off and on, no frame in between", bed=parked, rounds=(3, 60))
def park(bench: Bench, injection: Injection, seconds: float) -> None:
    for esc in bench.escs:
        esc.on = False
    bench.wait_log("quiet: no ESC was heard", len(bench.gateway.lines))
    with RawBus(bench.watched) as far:
        while far.receive(0.2):
            pass
        found = far.receive(seconds)
        bench.expect(found is None, f"{found} was sent in quiet mode")
    state = bench.watch.value("GatewayStatus", "gateway_state")
    bench.expect(state == GatewayState.QUIET, f"the last state is {state}")
    still_answers(bench)
    injection.cleared()
    for esc in bench.escs:
        esc.on = True
    injection.wait_recovery()
    boot_ups(injection)


@contextlib.contextmanager
def slow_bus(
    injection: Injection, rate: str, held_ns: int, burst_and_limit: str = "burst 160 limit 160"
) -> Iterator[None]:
    """Limit the bus to a rate within the block.

    With this limit, the kernel's queue is full soon, and sending fails with ENOBUFS. When the bus
    is free again, the kernel still sends the frames in its queue. Until then values may be late by
    ``held_ns``, because frames in the kernel cannot be taken back.
    """
    interface = injection.bench.interface
    watch = injection.bench.watch
    watch.more_ns = held_ns
    run(f"tc qdisc add dev {interface} root tbf rate {rate} {burst_and_limit}")
    yield
    run(f"tc qdisc change dev {interface} root tbf rate {FREE} burst 160 limit 160")
    with RawBus(interface) as near:
        # The limiter checks its queue only when it gets a frame.
        near.send(0x7F0, wait=False)
    injection.cleared()
    injection.wait_recovery()
    watch.catch_up()
    watch.more_ns = 0
    run(f"tc qdisc del dev {interface} root")  # discards waiting frames, but the queue is empty


@on_cable("ENOBUFS: a bus that takes less than there is to send", settle_s=1, rounds=[6])
def no_buffers(bench: Bench, injection: Injection, seconds: float) -> None:
    """The values on the bus are fresh, except for frames that were in the kernel."""
    with slow_bus(injection, f"{SLOW_BITS_PER_S}bit", HELD_NS):
        time.sleep(seconds)


@on_cable("a slow bus: 40 and 10 frames/s leave", settle_s=1, rounds=(40, 10))
def slow(bench: Bench, injection: Injection, rate: int) -> None:
    """No value is older than its timeout, a quarter of it and the time of one frame.

    Only the frames that were under way at the slow-down may be older. Nothing is restarted.
    """
    frame_ns = SECOND // rate
    first_ns = (MAX_IN_CONTROLLER + 1) * frame_ns
    watch = bench.watch
    lines = len(bench.gateway.lines)
    booted = len(watch.boot_ups)
    with slow_bus(injection, f"{BITS_OF_FRAME * rate}bit", first_ns, "burst 16 limit 16000"):
        bench.wait_log("the bus is slow", lines)
        time.sleep(first_ns / SECOND)
        watch.catch_up()
        watch.more_ns = TIMEOUT_NS // 4 + frame_ns
        right = watch.values
        time.sleep(6)
        bench.expect(watch.values > right, "no values arrived while the bus was slow")
    bench.wait_log("the bus takes all frames in time", lines)
    injection.leave_out_until(time.monotonic_ns())  # more frames are allowed only step by step
    said = "\n".join(bench.gateway.lines[lines:])
    bench.expect(said.count("the bus is slow") == 1, "the log does not say once that it is slow")
    bench.expect("restart" not in said, "the interface was restarted")
    bench.expect(len(watch.boot_ups) == booted, "a node booted")


@on_cable("a bus 100 % loaded by others", settle_s=1, rounds=[4])
def loaded(bench: Bench, injection: Injection, seconds: float) -> None:
    """The gateway cannot send, while others send as fast as the machine can.

    The frames in the controller are late then.
    """
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
    """Return the gateway's adapter."""
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
        """Wait until GatewayStatus shows this state."""

        def is_shown() -> bool:
            return bench.watch.value("GatewayStatus", "can_state") == state

        bench.wait_until(is_shown, 3, f"CanState {state}")

    near().tell_errors("f")
    near().tell_state("p", 10, 130)
    wait_can_state(PASSIVE)
    near().tell_state("a", 0, 0)
    wait_can_state(ACTIVE)


@on_adapter("wrong bit rate", 1.0)
def wrong_rate(bench: Bench, injection: Injection, _n: int) -> None:
    near().down()
    near().up(250_000)
    time.sleep(1.2)
    near().down()
    injection.cleared()
    near().up(ADAPTER_RATE)


@on_adapter("adapter unplugged and plugged in again", 1.0)
def unplugged(bench: Bench, injection: Injection, _n: int) -> None:
    near().close()
    time.sleep(0.6)
    BUS[0].adapters[0] = Adapter(BUS[0], bench.interface)
    injection.cleared()
    near().up(ADAPTER_RATE)
    injection.wait_recovery()
    boot_ups(injection)


# --- traffic


def cangen(bench: Bench, words: str) -> None:
    """Send frames from the far end, even if its queue is full."""
    command = ["cangen", bench.watched, "-i", *words.split()]
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)


REQUESTS = [
    bytes.fromhex("4000100000000000"),
    bytes.fromhex("4021100000000000"),
    bytes.fromhex("2110100104000000"),
    bytes.fromhex("A02110007F000000"),
    bytes.fromhex("6000000000000000"),
    bytes.fromhex("8000000000000000"),
]


@traffic("SDO floods")
def sdo_flood(bench: Bench, injection: Injection, n: int) -> None:
    """Send requests without waiting for an answer.

    Some are right, some are wrong, and some begin transfers that are never continued.
    """
    generator = random.Random(7 + n)
    with RawBus(bench.watched) as vandal:
        end = time.monotonic() + 1.5
        while time.monotonic() < end:
            known = generator.random() < 0.8
            request = generator.choice(REQUESTS) if known else generator.randbytes(8)
            vandal.send(0x601 + generator.randrange(2), request)
            time.sleep(0.001)
        time.sleep(0.3)
        vandal.send(0x601, REQUESTS[-1])
    still_answers(bench)


@traffic("SYNC at 1 kHz", rounds=[0])
def sync(bench: Bench, injection: Injection, _n: int) -> None:
    cangen(bench, "-g 1 -n 1500 -I 080 -L 0")
    still_answers(bench)


def conflict(
    bench: Bench,
    injection: Injection,
    n: int,
    frames: tuple[tuple[int, str], ...],
) -> None:
    """Send these frames as if another node were node 1, and then node 2.

    The log reports it once, the node sends EMCY 8150h, and our nodes continue.
    """
    gateway = bench.gateway
    node = 1 + n
    if any("another device" in text and f"node {node}" in text for text in gateway.lines):
        # The earlier conflict has to end first. Otherwise this is the same condition.
        begun = gateway.log.count("another device")
        bench.wait_until(lambda: gateway.log.count("no other device") >= begun, 15, "it is over")
    lines = len(gateway.lines)
    with RawBus(bench.watched) as vandal:
        for _ in range(50):
            for can_id, data in frames:
                vandal.send(can_id + node, bytes.fromhex(data))
            time.sleep(0.01)
    injection.wait_emergency(node, CONFLICT)
    bench.wait_log("another device", lines)
    said = len(gateway.lines) - lines
    bench.expect(1 <= said <= 2 * len(frames), f"{said} lines in the log for one condition")
    still_answers(bench)


for name, frames in (
    (
        "another node sends with our identifiers",
        ((0x687, "0000000000000000"), (0x180, "0000000000000000")),
    ),
    # boot-up, heartbeat and answers of that node; our node keeps its state
    (
        "a second node with our node-ID",
        ((0x700, "00"), (0x700, "7F"), (0x580, "8000100000000405")),
    ),
):
    traffic(name)(partial(conflict, frames=frames))


# This is the last one: the frames include our identifiers, and a conflict has to end before others.
@traffic("random frames", rounds=[1000])
def random_frames(bench: Bench, injection: Injection, count: int) -> None:
    """Send all identifiers, lengths and contents, including remote and 29-bit frames."""
    for number, kind in ((8 * count, ""), (count, "-R"), (count, "-e")):
        cangen(bench, f"-g 0.3 -n {number} -I r -L r -D r {kind}")
    time.sleep(0.3)
    still_answers(bench)


# --- many ESCs


NOISY, SILENT, UNPLUGGED = ILL = 0, 3, 6


@fault(
    "Many",
    "eight ESCs, of which one is noisy, one silent, one unplugged",
    None,
    escs=ILL,
    settle_s=1,
    bed=eight,
)
def ill_among_well(bench: Bench, injection: Injection, n: int) -> None:
    """The other five ESCs lose no value, and the three lose no value of a complete frame."""
    generator = random.Random(8 + n)

    def noise(wire: bytes) -> tuple[bytes, bool]:
        if generator.random() < 0.5:
            return generator.randbytes(generator.randrange(1, 200)), False
        return generator.randbytes(generator.randrange(200)) + wire, True

    port = bench.escs[UNPLUGGED]
    assert isinstance(port, PtyPort)
    bench.escs[NOISY].mangle = noise
    bench.escs[SILENT].on = False
    for _ in range(3):
        port.unplug()
        time.sleep(0.7)
        port.plug()
        time.sleep(0.5)
    bench.escs[NOISY].mangle = None
    injection.cleared()
    bench.escs[SILENT].on = True
