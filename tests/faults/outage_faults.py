"""Outages of the bus, from one second to ten minutes, with and without the restart unit.

A frame that the kernel or the controller holds when the bus stops cannot be taken back, unless the
interface is restarted. Two kinds of adapter are simulated: one discards its frames when it is
restarted, the other keeps and sends them.
"""

import contextlib
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import beds
from beds import BUS, fault
from bus_watch import SECOND
from can_faults import near, still_answers
from harness import Bench, Injection
from raw_bus import RawBus
from restart_unit import RestartUnit

RESTART_AFTER_S = 0.5
WORKED_S = 3
"""Time after which the last restart counts as successful, so that the next pause is short."""
CALM_S = 70
"""After this time without a fault, the log does not summarise further ones."""
QUIET_AFTER_S = 2
JAMMED_S = 30
RATE_HZ = 10
"""Frames of the ESC in a second: few, because an outage may last ten minutes."""
SHORTEST_S = 1
LONGEST_S = 600
IN_KERNEL = 6
"""Frames of the gateway in the socket queue: the capacity of the smallest send buffer."""
IN_DRIVER = 1
"""Frames that the slcan driver has written to the adapter, which has not read them."""
HELD = IN_KERNEL + IN_DRIVER
RECOVERY_S = 2.0
"""Longest recovery with the unit: setting an slcan interface up takes some commands."""


class Outage(NamedTuple):
    """A round: the length of the outage, and the kind of adapter."""

    seconds: float
    keeps: bool


OUTAGES: list[Outage] = []
"""The rounds of each outage. ``choose`` fills the list."""
HANGS: list[int] = []
"""The rounds of the adapter that hangs until it is restarted."""


def choose(lengths: int, hangs: int) -> None:
    """Choose how often the faults of this module are injected.

    ``lengths`` are spread logarithmically, for both kinds of adapter.
    """
    OUTAGES.clear()
    for number in range(lengths):
        part = (number + 0.5) / lengths
        seconds = SHORTEST_S * (LONGEST_S / SHORTEST_S) ** part
        OUTAGES.extend(Outage(seconds, keeps) for keeps in (False, True))
    HANGS[:] = range(hangs)


choose(2, 4)
UNITS: list[RestartUnit] = []
"""The restart unit of the bed ``with_unit`` while that bed exists."""


def without_unit(_: Path) -> contextlib.AbstractContextManager[Bench]:
    return beds.adapters_with(RATE_HZ)


@contextlib.contextmanager
def with_unit(_: Path) -> Iterator[Bench]:
    """Yield the bench of ``adapters`` with a gateway that requests restarts, and the unit.

    The file of the requests is on a file system of the virtual machine, whose times are virtual.
    """
    run = Path(tempfile.mkdtemp(prefix="run."))
    can = f"restart_after_s = {RESTART_AFTER_S}\n"
    environment = {"KONTRONIK_RUN": str(run)}
    made = beds.adapters_with(RATE_HZ, can=can, environment=environment)
    with made as bench, RestartUnit(bench.interface, run) as unit:
        UNITS[:] = [unit]
        yield bench


@contextlib.contextmanager
def outage(injection: Injection, given: Outage, may_be_restarted: bool) -> Iterator[None]:
    """Let the block last, and judge the values that arrive after it."""
    bench = injection.bench
    watch = bench.watch
    near().keeps = given.keeps
    before = watch.by_more
    watch.more_ns = round(given.seconds + 60) * SECOND
    yield
    injection.cleared()
    injection.wait_recovery()
    watch.catch_up()
    late = watch.by_more - before
    time.sleep(1)
    watch.more_ns = 0
    near().keeps = False
    is_restarted = may_be_restarted and given.seconds > RESTART_AFTER_S + 0.5
    limit = 0 if is_restarted and not given.keeps else HELD
    injection.row.late = max(injection.row.late, late)
    bench.expect(late <= limit, f"{late} old values, {given}")


def jam(given: Outage) -> None:
    BUS[0].is_jammed = True
    time.sleep(given.seconds)
    BUS[0].is_jammed = False


def no_acknowledge(given: Outage) -> None:
    far = BUS[0].adapters[1]
    far.is_open = False
    time.sleep(given.seconds)
    near().tell_state("a", 0, 0)
    far.is_open = True


def hang(given: Outage) -> None:
    near().is_stuck = True
    time.sleep(given.seconds)
    near().is_stuck = False


def bus_off(given: Outage) -> None:
    """The bus stays unusable after a restart by the unit, and an operator's restart ends it."""
    near().silent = True
    near().tell_state("b", 0, 255)
    BUS[0].is_jammed = True
    time.sleep(given.seconds)
    BUS[0].is_jammed = False
    near().down()
    near().up(beds.ADAPTER_RATE)


CAUSES: dict[str, Callable[[Outage], None]] = {
    "the bus is jammed": jam,
    "no node acknowledges": no_acknowledge,
    "the adapter hangs": hang,
    "bus-off": bus_off,
}


def injected(
    bench: Bench,
    injection: Injection,
    given: Outage,
    *,
    cause: Callable[[Outage], None],
    has_unit: bool,
) -> None:
    with outage(injection, given, has_unit or cause is bus_off):
        cause(given)


for _name, _cause in CAUSES.items():
    for _has_unit, _bed in ((False, without_unit), (True, with_unit)):
        _more = "with the restart unit" if _has_unit else "without the restart unit"
        fault(
            "Outage",
            f"{_name}, {_more}",
            RECOVERY_S,
            bed=_bed,
            settle_s=1,
            rounds=OUTAGES,
        )(partial(injected, cause=_cause, has_unit=_has_unit))


@fault(
    "Outage",
    "an adapter sends nothing until it is restarted",
    RESTART_AFTER_S + 2,
    bed=with_unit,
    settle_s=1,
    rounds=HANGS,
)
def hangs_until_restart(bench: Bench, injection: Injection, number: int) -> None:
    """The recovery counts from the hang, because the unit ends it."""
    time.sleep(WORKED_S + number * 0.037 % 1)
    restarts = UNITS[0].starts
    injection.cleared()
    near().is_stuck_until_restart = True
    injection.wait_recovery()
    bench.expect(UNITS[0].starts == restarts + 1, "one restart")


@fault(
    "Outage",
    "an adapter stays dead: one report, restarts with pauses",
    RECOVERY_S,
    bed=with_unit,
    settle_s=1,
    rounds=[100],
)
def stays_dead(bench: Bench, injection: Injection, seconds: float) -> None:
    time.sleep(CALM_S)
    lines = len(bench.gateway.lines)
    restarts = UNITS[0].starts
    near().is_stuck = True
    time.sleep(seconds)
    near().is_stuck = False
    injection.cleared()
    injection.wait_recovery()
    said = bench.gateway.lines[lines:]
    for text in ("no frame can be sent", "so it is restarted"):
        reports = sum(text in line for line in said)
        bench.expect(reports == 1, f"{reports} lines with {text!r}")
    count_of = UNITS[0].starts - restarts
    bench.expect(8 <= count_of <= 16, f"{count_of} restarts")


def parked_with_adapters(_: Path) -> contextlib.AbstractContextManager[Bench]:
    return beds.adapters_with(RATE_HZ, can=f"quiet_after_s = {QUIET_AFTER_S}\n")


@fault(
    "Outage",
    "the bus is jammed as quiet mode begins",
    RECOVERY_S,
    bed=parked_with_adapters,
    settle_s=1,
    rounds=(QUIET_AFTER_S - 1, QUIET_AFTER_S - 0.1, QUIET_AFTER_S + 0.1),
)
def jammed_as_quiet_begins(bench: Bench, injection: Injection, seconds: float) -> None:
    """The frames that the controller holds may leave late. After them, the gateway is silent."""
    watch = bench.watch
    before = watch.by_more
    watch.more_ns = (JAMMED_S + 60) * SECOND
    lines = len(bench.gateway.lines)
    bench.escs[0].on = False
    time.sleep(seconds)
    BUS[0].is_jammed = True
    bench.wait_log("quiet: no ESC was heard", lines)
    time.sleep(JAMMED_S)
    BUS[0].is_jammed = False
    with RawBus(bench.watched) as far:
        while far.receive(0.5):
            pass
        found = far.receive(CALM_S)
        bench.expect(found is None, f"{found} was sent in quiet mode")
    still_answers(bench)
    watch.catch_up()
    late = watch.by_more - before
    watch.more_ns = 0
    bench.expect(late <= HELD, f"{late} old values")
    injection.cleared()
    bench.escs[0].on = True
    injection.wait_recovery()
