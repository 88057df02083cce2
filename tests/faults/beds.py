"""The benches that the faults of the programme share, by name."""

import contextlib
import functools
import itertools
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from encoding import Identity
from fault_report import Report
from harness import Bench, PtyPort
from signals import Table, table_sent
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


@functools.cache
def table(escs: int, canopen: bool) -> Table:
    """Of the shipped layouts expanded to so many ESCs, nodes from 1 on."""
    return table_sent(["--esc", str(escs)], canopen, escs)


@contextlib.contextmanager
def bench_of(
    report: Report,
    identities: Sequence[Identity] = IDENTITIES,
    rate_hz: float = 50,
    cable: contextlib.AbstractContextManager[tuple[str, str]] | None = None,
    **options: Any,
) -> Iterator[Bench]:
    """A running gateway with these ESCs on a CAN cable; what nobody injected is accounted before it is handed out."""
    folder = Path(tempfile.mkdtemp(prefix="ports."))
    with cable or pair() as (near, far):
        ports = [
            PtyPort(folder / f"esc{i + 1}", identity, rate_hz)
            for i, identity in enumerate(identities)
        ]
        known = table(len(ports), options.get("canopen", "") is not None)
        with Bench(near, far, ports, report, table=known, **options) as bench:
            bench.start()
            yield bench


def two(report: Report) -> contextlib.AbstractContextManager[Bench]:
    return bench_of(report, prefix=WITHOUT_OVERRIDE)


def eight(report: Report) -> contextlib.AbstractContextManager[Bench]:
    """Slow ones: feeder and judge have the processor, too."""
    layouts = (Layout.V4, Layout.LEGACY)
    identities = [Identity(i + 1, layouts[i % 2]) for i in range(8)]
    return bench_of(report, identities, rate_hz=25, canopen=None)


def adapters(report: Report) -> contextlib.AbstractContextManager[Bench]:
    """One ESC, a gateway on an emulated adapter, the judge on another; the adapters are slow."""
    return bench_of(report, [Identity(1)], rate_hz=25, cable=adapter_pair())


@contextlib.contextmanager
def adapter_pair() -> Iterator[tuple[str, str]]:
    number = next(_numbers)
    near, far = f"sl{number}", f"slfar{number}"
    bus = BUSES[near] = Bus(near, far)
    try:
        for adapter in bus.adapters:
            run("ip", "link", "set", adapter.name, "txqueuelen", "100")
            adapter.up(ADAPTER_RATE)
        yield near, far
    finally:
        bus.close()


MakesBench = Callable[[Report], contextlib.AbstractContextManager[Bench]]
BENCHES: dict[str, MakesBench] = {
    "two": two,
    "cycles": two,
    "adapters": adapters,
    "eight": eight,
}
