"""The beds of the fault programme. Each bed creates a bench with a running gateway."""

import contextlib
import functools
import itertools
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from fault_report import FAULTS, Fault
from feeder import Identity
from harness import Bench, PtyPort
from signals import table_sent
from slcan_adapters import Bus

from kontronik_can_gw.esc.kontronik.codec import WireLayout
from kontronik_can_gw.esc.kontronik.states import Device

WITHOUT_OVERRIDE = ("setpriv", "--bounding-set=-dac_override,-dac_read_search")
"""Command prefix for a root process that file permissions apply to."""
IDENTITIES = (Identity(1), Identity(2, WireLayout.LEGACY, Device.JIVEPRO, 12, alarms=True))
ADAPTER_RATE = 500_000
table = functools.cache(table_sent)
"""Return the table of a shipped layout. It is computed once."""
_numbers = itertools.count()
MakesBench = Callable[[Path], contextlib.AbstractContextManager[Bench]]
Injects = Callable[[Any, Any, Any], None]


def run(command: str) -> None:
    subprocess.run(command.split(), check=True)


def make_pair(gateway_end: str, far_end: str) -> None:
    """Create a CAN cable that carries frames between two interfaces.

    The gateway's end is down.
    """
    run(f"ip link add {gateway_end} type vxcan peer name {far_end}")
    run(f"ip link set {far_end} up")


@contextlib.contextmanager
def bench_of(
    identities: Sequence[Identity] = IDENTITIES,
    rate_hz: float = 50,
    names: tuple[str, str] | None = None,
    **options: Any,
) -> Iterator[Bench]:
    """Yield a running gateway with these ESCs, on a CAN cable or on existing interfaces."""
    number = next(_numbers)
    near, far = names or (f"gw{number}", f"far{number}")
    if names is None:
        make_pair(near, far)
        run(f"ip link set {near} up")
    folder = Path(tempfile.mkdtemp(prefix="ports."))
    ports = []
    for number, identity in enumerate(identities, 1):
        ports.append(PtyPort(folder / f"esc{number}", identity, rate_hz))
    known = table(("--esc", str(len(ports))), options.get("canopen", True), len(ports))
    try:
        with Bench(near, far, ports, known, **options) as bench:
            bench.start()
            yield bench
    finally:
        if names is None:
            subprocess.run(["ip", "link", "del", near], check=False, capture_output=True)


def two(_: Path) -> contextlib.AbstractContextManager[Bench]:
    return bench_of(prefix=WITHOUT_OVERRIDE)


def everything(
    folder: Path,
    identities: Sequence[Identity] = IDENTITIES,
) -> contextlib.AbstractContextManager[Bench]:
    """Return the bench of ``two``, or of other ESCs, with recording and DroneCAN."""
    record = f'[record]\ndirectory = "{folder / "captures"}"\nkeep_mb = 20\nmin_free_mb = 1\n'
    dronecan = "[dronecan]\nenabled = true\nnode_id = 100\n"
    return bench_of(identities, prefix=WITHOUT_OVERRIDE, more=record + dronecan)


def parked(_: Path) -> contextlib.AbstractContextManager[Bench]:
    """Return the bench of ``two`` with a quiet mode."""
    return bench_of(prefix=WITHOUT_OVERRIDE, can="quiet_after_s = 2\n")


def eight(_: Path) -> contextlib.AbstractContextManager[Bench]:
    """Return a bench with eight slow ESCs. Feeder and judge need the processor, too."""
    layouts = (WireLayout.V4, WireLayout.LEGACY)
    identities = [Identity(i + 1, layouts[i % 2]) for i in range(8)]
    return bench_of(identities, rate_hz=25, canopen=False)


BUS: list[Bus] = []
"""The bus of the bed ``adapters`` while that bed exists."""


def adapters(_: Path) -> contextlib.AbstractContextManager[Bench]:
    return adapters_with()


@contextlib.contextmanager
def adapters_with(rate_hz: float = 25, **options: Any) -> Iterator[Bench]:
    """Yield a bench with one ESC and slow emulated adapters for the gateway and the judge."""
    number = next(_numbers)
    names = f"sl{number}", f"slfar{number}"
    BUS[:] = [Bus(*names)]
    try:
        for adapter in BUS[0].adapters:
            run(f"ip link set {adapter.name} txqueuelen 100")
            adapter.up(ADAPTER_RATE)
        with bench_of([Identity(1)], rate_hz=rate_hz, names=names, **options) as bench:
            yield bench
    finally:
        BUS[0].close()


def fault(
    area: str,
    name: str,
    limit_s: float | None,
    *,
    bed: MakesBench = two,
    **further: Any,
) -> Callable[[Injects], Injects]:
    """Register a function as a fault.

    After its cause is ``cleared``, the programme waits for the recovery.
    """

    def register(inject: Injects) -> Injects:
        FAULTS.append(Fault(area, name, limit_s, inject, bed, **further))
        return inject

    return register
