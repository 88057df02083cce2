"""The benches that the faults of the programme share, by name."""

import contextlib
import itertools
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from encoding import Identity
from fault_report import Report
from harness import Bench, PtyPort
from signals import Table, table_of_shipped
from slcan_adapters import Bus

from kontronik_can_gw.esc.kontronik.codec import Layout
from kontronik_can_gw.esc.kontronik.states import Device

WITHOUT_OVERRIDE = ("setpriv", "--bounding-set=-dac_override,-dac_read_search")
"""Root that file permissions hold for."""
IDENTITIES = (Identity(1), Identity(2, Layout.LEGACY, Device.JIVEPRO, 12, alarms=True))
ADAPTER_RATE = 500_000
BUSES: dict[str, Bus] = {}
"""The emulated adapters' buses by the gateway's interface."""

_numbers = itertools.count()
_tables: dict[tuple[int, bool], Table] = {}


def run(*words: str) -> None:
    subprocess.run(words, check=True)


def make_pair(gateway_end: str, far_end: str, up: bool = True) -> None:
    """A CAN cable: what is sent at one end comes out at the other. ``up``: the gateway's end too."""
    run("ip", "link", "add", gateway_end, "type", "vxcan", "peer", "name", far_end)
    # first: what is sent while it is down is seen by nobody
    run("ip", "link", "set", far_end, "up")
    if up:
        run("ip", "link", "set", gateway_end, "up")


@contextlib.contextmanager
def pair() -> Iterator[tuple[str, str]]:
    """Names of the two ends of a fresh CAN cable."""
    number = next(_numbers)
    ends = f"gw{number}", f"far{number}"
    make_pair(*ends)
    try:
        yield ends
    finally:
        subprocess.run(["ip", "link", "del", ends[0]], check=False, capture_output=True)


def table(escs: int, canopen: bool) -> Table:
    if (escs, canopen) not in _tables:
        _tables[escs, canopen] = table_of_shipped(escs, canopen)
    return _tables[escs, canopen]


@contextlib.contextmanager
def bench_of(
    report: Report,
    identities: Sequence[Identity] = IDENTITIES,
    rate_hz: float = 50,
    canopen: str | None = "self_start = true",
    started: bool = True,
    prefix: Sequence[str] = (),
) -> Iterator[Bench]:
    """A running gateway with these ESCs on a CAN cable; what nobody injected is accounted before it is handed out."""
    folder = Path(tempfile.mkdtemp(prefix="ports."))
    with pair() as (near, far):
        ports = [
            PtyPort(folder / f"esc{i + 1}", identity, rate_hz)
            for i, identity in enumerate(identities)
        ]
        known = table(len(ports), canopen is not None)
        with Bench(near, far, ports, report, canopen=canopen, table=known, prefix=prefix) as bench:
            if started:
                bench.start()
            yield bench


@contextlib.contextmanager
def two(report: Report) -> Iterator[Bench]:
    with bench_of(report, prefix=WITHOUT_OVERRIDE) as bench:
        yield bench


@contextlib.contextmanager
def eight(report: Report) -> Iterator[Bench]:
    layouts = (Layout.V4, Layout.LEGACY)
    identities = [Identity(i + 1, layouts[i % 2]) for i in range(8)]
    with bench_of(report, identities, rate_hz=25, canopen=None) as bench:
        # feeder and judge have the processor, too
        yield bench


@contextlib.contextmanager
def adapters(report: Report) -> Iterator[Bench]:
    """One ESC, a gateway on an emulated adapter, the judge on another."""
    folder = Path(tempfile.mkdtemp(prefix="ports."))
    number = next(_numbers)
    near, far = f"sl{number}", f"slfar{number}"
    bus = BUSES[near] = Bus(near, far)
    try:
        for adapter in bus.adapters:
            run("ip", "link", "set", adapter.name, "txqueuelen", "100")
            adapter.up(ADAPTER_RATE)
        ports = [PtyPort(folder / "esc1", Identity(1), rate_hz=25)]  # the adapters are slow
        with Bench(near, far, ports, report, table=table(1, True)) as bench:
            bench.start()
            yield bench
    finally:
        bus.close()


MakesBench = Callable[[Report], contextlib.AbstractContextManager[Bench]]
BENCHES: dict[str, MakesBench] = {
    "two": two,
    "cycles": two,
    "adapters": adapters,
    "eight": eight,
}
