"""The faults of the emulated machine, all in one start of it, and their account as JSON.

    python tests/faults/qemu_programme.py [--out FILE] [--long] [--only TEXT]...

On any machine with QEMU set up (tests/vm/setup.sh qemu) this starts the emulated one and runs itself in there.
"""

import contextlib
import functools
import pickle
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import outside
import programme
import qemu_can_faults  # noqa: F401  registers its faults
import qemu_serial_faults  # noqa: F401
from bus_watch import MS
from encoding import Identity
from fault_report import Report, Row, in_order
from feeder import CURRENT, SPEED
from harness import Bench, Gateway, Port
from qemu_adapters import CanAdapter, CanBus, SerialAdapter
from qemu_machine import Monitor, can_up, ip
from qemu_ports import FarPort, UsbPort, WirePort
from signals import table_of

from kontronik_can_gw.esc.kontronik.codec import Layout
from kontronik_can_gw.esc.kontronik.states import Device

SLACK_NS = 400 * MS
TIMEOUT_S = {False: 600, True: 7200}
LONG_TIMES = 10


class EmulatedBench(Bench):
    """A bench on a machine so slow that two frames are often read at once: then the newer one goes to the bus.

    A value that was replaced by one sent at most SLACK_NS later is not lost. What the gateway sends by the clock it sends four times
    more slowly than by the shipped DBC, and its CANopen nodes stay PRE-OPERATIONAL, for speed's sake.
    """

    metronome_step_s = 0.03

    def __init__(
        self, interface: str, watched: str, ports: Sequence[Port], report: Report, tables: Path
    ) -> None:
        stem = tables / str(len(ports))
        super().__init__(
            interface,
            watched,
            ports,
            report,
            slack_ns=SLACK_NS,
            table=pickle.loads(stem.with_suffix(".table").read_bytes()),
            options=f'[dbc]\nfile = "{stem}.dbc"',
            canopen="",
            start_limit_s=120,
        )

    def account(self, row: Row, until_ns: int | None = None) -> int:
        if until_ns is None:
            until_ns = time.monotonic_ns() - 150 * MS
        for index, fed in enumerate(self.fed):
            newer = 0
            for n in range(fed.newest(time.monotonic_ns()), self._accounted[index] - 1, -1):
                if fed.seen[n] == SPEED | CURRENT:
                    newer = fed.sent[n]
                elif (
                    fed.whole[n]
                    and fed.sent[n] <= until_ns
                    and newer
                    and newer - fed.sent[n] <= SLACK_NS
                ):
                    fed.seen[n] = SPEED | CURRENT
        return super().account(row, until_ns)


class MachineBench(EmulatedBench):
    """Three ESCs on three kinds of port, and a gateway on the first controller; the second one watches."""

    def __init__(self, report: Report, tables: Path) -> None:
        self.monitor = Monitor()
        self.uart = FarPort("com1", "/dev/ttyS1", Identity(1, Layout.V4), self._reader)
        self.usb = UsbPort(
            Identity(2, Layout.LEGACY, Device.JIVEPRO, 12), self._reader, self.monitor
        )
        self.wire = WirePort(SerialAdapter(0, "ESC0003"), Identity(3, Layout.V4, Device.KOLIBRI, 8))
        for name in ("can0", "can1"):
            can_up(name)
        super().__init__("can0", "can1", [self.uart, self.usb, self.wire], report, tables)

    def _reader(self) -> int | None:
        """The gateway's process."""
        gateway: Gateway | None = getattr(self, "gateway", None)  # the feeder asks before it is set
        return gateway.process.pid if gateway is not None and gateway.alive else None

    def close(self) -> None:
        super().close()
        self.monitor.close()


@functools.cache
def played_bus() -> CanBus:
    """Two CAN adapters, can2 and can3. Linux 6.1 crashes when an usb_8dev is pulled: a process that stays until the power goes off
    holds them too."""
    bus = CanBus()
    for port in (2, 3):
        CanAdapter(port, bus, f"CAN000{port}").plug()
    held = [adapter.fileno() for adapter in bus.adapters]
    null = subprocess.DEVNULL
    subprocess.Popen(["sleep", "infinity"], pass_fds=held, stdin=null, stdout=null, stderr=null)
    return bus


class AdapterBench(EmulatedBench):
    """One ESC, and a gateway on a CAN adapter with errors; another adapter on its bus watches."""

    def __init__(self, report: Report, tables: Path) -> None:
        self.adapter = played_bus().adapters[0]
        for name in ("can2", "can3"):
            can_up(name)
        wire = WirePort(SerialAdapter(1, "ESC0004"), Identity(4, Layout.V4))
        super().__init__("can2", "can3", [wire], report, tables)

    def close(self) -> None:
        super().close()
        self.adapter.stall(False)
        for name in ("can2", "can3"):
            ip("link", "set", name, "down")


@contextlib.contextmanager
def running(kind: Callable[[Report, Path], Bench], tables: Path, report: Report) -> Iterator[Bench]:
    with kind(report, tables) as bench:
        bench.start()
        yield bench


def prepare(folder: Path) -> None:
    """Make what would take long in the emulated machine: the shipped layout with cycle times below a second made four times as long,
    a table of what it sends, and byte code."""

    def slower(found: re.Match[str]) -> str:
        cycle = int(found[2])
        return f"{found[1]}{cycle * 4 if cycle < 1000 else cycle};"

    for escs in (1, 3):
        command = [sys.executable, "-m", "kontronik_can_gw", "dbc", "--esc", str(escs)]
        text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        text = re.sub(r'(BA_ "GenMsgCycleTime" BO_ \d+ )(\d+);', slower, text)
        Path(folder, f"{escs}.dbc").write_text(text)
        Path(folder, f"{escs}.table").write_bytes(pickle.dumps(table_of([text], escs)))
    sources = [str(outside.PROJECT / name) for name in ("kontronik_can_gw", "tests/faults")]
    subprocess.run([sys.executable, "-m", "compileall", "-q", *sources], check=False)


def main() -> int:
    args = outside.parser(__doc__).parse_args()
    mine = outside.chosen(in_order("QEMU"), args.only)
    if args.inside is None:
        timeout_s = TIMEOUT_S[args.long]
        return outside.main(
            args, "qemu_programme.py", mine, backend="qemu", timeout_s=timeout_s, prepare=prepare
        )
    kinds = {"machine": MachineBench, "adapter": AdapterBench}
    made = {name: functools.partial(running, kind, args.inside) for name, kind in kinds.items()}
    programme.run(mine, Report(), LONG_TIMES if args.long else 1, args.inside / "report.json", made)
    return 0


if __name__ == "__main__":
    sys.exit(main())
