"""The faults of the emulated machine, all in one start of it, and their account as JSON.

    python tests/faults/qemu_programme.py [--out FILE] [--long] [--only TEXT]...

On any machine with QEMU set up (tests/vm/setup.sh qemu) this starts the emulated one and runs itself in there.
"""

import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

HERE = Path(__file__).resolve().parent
PROJECT = HERE.parent.parent
sys.path.insert(0, str(HERE))

import outside  # noqa: E402
from fault_report import Fault, in_order  # noqa: E402
from feeder import CURRENT, SPEED  # noqa: E402
from harness import MS, Bench, Identity, Metronome, NotRecovered, Port, Report, line  # noqa: E402
from qemu_adapters import CanAdapter, CanBus, SerialAdapter  # noqa: E402
from qemu_faults import BITRATE  # noqa: E402
from qemu_machine import Monitor, can_up, ip, wait_until  # noqa: E402
from qemu_ports import FarPort, UsbPort, WirePort  # noqa: E402
from signals import from_json, table_of, to_json  # noqa: E402

from kontronik_can_gw.protocol.codec import Layout  # noqa: E402
from kontronik_can_gw.protocol.states import Device  # noqa: E402

SLACK_NS = 400 * MS
AT_START = "at the start"
"""A fault whose name ends so starts the gateway itself."""
START_LIMIT_S = 120
TIMEOUT_S = {False: 420, True: 7200}
LONG = 10


def reader(benches: list[Bench]) -> int | None:
    """The gateway's process."""
    gateway = benches[0].gateway if benches else None
    return gateway.process.pid if gateway is not None and gateway.alive else None


class SlowMetronome(Metronome):
    """One that costs less, for a machine on which waking up is a piece of work."""

    SCRIPT = """
import sys, time
last = time.monotonic_ns()
while True:
    time.sleep(0.03)
    now = time.monotonic_ns()
    if now - last > 80_000_000:
        print(last + 30_000_000, now, flush=True)
    last = now
"""

    def __init__(self) -> None:
        self.stalls = []
        self._process = subprocess.Popen(
            [sys.executable, "-S", "-E", "-c", self.SCRIPT],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()


class EmulatedBench(Bench):
    """A bench on a machine so slow that two frames are often read at once: then the newer one goes to the bus.

    A value that was replaced by one sent at most SLACK_NS later is not lost, but counted in ``replaced``. What the gateway sends by
    the clock it sends four times more slowly than by the shipped DBC, and its CANopen nodes stay PRE-OPERATIONAL, for speed's sake.
    """

    replaced = 0

    def __init__(self, interface: str, watched: str, ports: Sequence[Port], report: Report, tables: Path) -> None:
        stem = tables / str(len(ports))
        super().__init__(
            interface,
            watched,
            ports,
            report,
            slack_ns=SLACK_NS,
            table=from_json(stem.with_suffix(".json").read_text()),
            options=f'[dbc]\nfile = "{stem.with_suffix(".dbc")}"',
            canopen="",
            start_limit_s=START_LIMIT_S,
        )
        self.metronome.close()
        self.metronome = SlowMetronome()

    def account(self, until_ns: int | None = None) -> tuple[int, int]:
        if until_ns is None:
            until_ns = time.monotonic_ns() - 150 * MS
        for index, fed in enumerate(self.fed):
            newer = 0
            for n in range(fed.newest(time.monotonic_ns()), self._accounted[index] - 1, -1):
                if fed.seen[n] == SPEED | CURRENT:
                    newer = fed.sent[n]
                elif fed.whole[n] and fed.sent[n] <= until_ns and newer and newer - fed.sent[n] <= SLACK_NS:
                    fed.seen[n] = SPEED | CURRENT
                    self.replaced += 1
        return super().account(until_ns)


class MachineBench(EmulatedBench):
    """Three ESCs on three kinds of port, and a gateway on the first controller; the second one watches."""

    def __init__(self, report: Report, tables: Path) -> None:
        own: list[Bench] = []
        self.monitor = Monitor()
        self.uart = FarPort("com1", "/dev/ttyS1", Identity(1, Layout.V4), lambda: reader(own))
        self.usb = UsbPort(Identity(2, Layout.LEGACY, Device.JIVEPRO, 12), lambda: reader(own), self.monitor)
        self.wire = WirePort(SerialAdapter(0, "ESC0003"), Identity(3, Layout.V4, Device.KOLIBRI, 8))
        for name in ("can0", "can1"):
            can_up(name, BITRATE, restart_ms=100)
        ports: list[Port] = [self.uart, self.usb, self.wire]
        super().__init__("can0", "can1", ports, report, tables)
        own.append(self)


class AdapterBench(EmulatedBench):
    """One ESC, and a gateway on a CAN adapter with errors; another adapter on its bus watches."""

    def __init__(self, report: Report, tables: Path) -> None:
        self.wire = WirePort(SerialAdapter(1, "ESC0004"), Identity(4, Layout.V4))
        self.bus = CanBus()
        self.adapter = CanAdapter(2, self.bus, "CAN0001")
        self.watcher = CanAdapter(3, self.bus, "CAN0002")
        for name, adapter in (("can2", self.adapter), ("can3", self.watcher)):
            adapter.plug()
            wait_until(Path("/sys/class/net", name).exists, 5, name)
            wait_until(lambda adapter=adapter: adapter.told_version, 5, f"{name}'s firmware")  # type: ignore[misc]
            can_up(name, BITRATE, restart_ms=100)
        super().__init__("can2", "can3", [self.wire], report, tables)

    def close(self) -> None:
        super().close()
        for name in ("can2", "can3"):
            ip("link", "set", name, "down")
        leave_plugged()


def leave_plugged() -> None:
    """Let a process that stays until the power goes off hold the played devices: Linux 6.1 crashes when an usb_8dev is pulled."""
    if os.fork():
        return
    null = os.open(os.devnull, os.O_RDWR)
    for fd in range(3):
        os.dup2(null, fd)
    while True:
        time.sleep(3600)


def run_faults(bench: EmulatedBench, faults: Sequence[Fault], times: int) -> None:
    for fault in faults:
        name = f"{fault.area}: {fault.name}"
        print(outside.BEGIN, name, flush=True)
        begin, replaced = time.monotonic(), bench.replaced
        try:
            if bench.gateway is None and not fault.name.endswith(AT_START):
                bench.start()
                begin = time.monotonic()
            fault.run(bench, fault, times)
        except (NotRecovered, AssertionError, OSError, subprocess.CalledProcessError) as error:
            row = bench.report.row(fault)
            if not any(str(error) in note for note in row.notes):
                row.notes.append(f"{type(error).__name__}: {error}")
            row.injected = max(row.injected, row.recovered + 1)
            recover(bench)
        if bench.replaced > replaced:
            bench.report.row(fault).figures["values replaced by newer ones"] = bench.replaced - replaced
        print(outside.END, name, flush=True)
        print(f"{line(bench.report.row(fault))}  [{time.monotonic() - begin:.1f} s]", flush=True)


def recover(bench: EmulatedBench) -> None:
    """After a fault that was not healed: all as at the start, so that the others are judged by themselves."""
    if isinstance(bench, MachineBench):
        bench.uart.fed.on = True
        bench.wire.send = bench.wire.clean
        for port in (bench.usb, bench.wire):
            if port.device != port.path:
                if port.device:
                    port.unplug()
                port.plug()
    if isinstance(bench, AdapterBench):
        bench.adapter.stall(False)
        for name in ("can2", "can3"):
            ip("link", "set", name, "down")
            can_up(name, BITRATE, restart_ms=100)
    begin = time.monotonic_ns()
    try:
        bench.wait_fresh(range(len(bench.ports)), begin, 3, begin)
    except NotRecovered:
        if bench.gateway is not None:
            print("\n".join(bench.gateway.lines[-20:]), flush=True)
            bench.gateway.kill()
            bench.gateway = None
    bench.leave_out(range(len(bench.ports)), begin - SLACK_NS, time.monotonic_ns())


def inside(folder: Path, faults: Sequence[Fault], times: int) -> None:
    report = Report()
    kinds: tuple[tuple[str, Callable[[Report, Path], EmulatedBench]], ...]
    kinds = (("machine", MachineBench), ("adapter", AdapterBench))
    for name, kind in kinds:
        mine = [fault for fault in faults if fault.bench == name]
        if not mine:
            continue
        with kind(report, folder) as bench:
            run_faults(bench, mine, times)
            if bench.gateway is not None:
                bench.stop()
        report.write(folder / "report.json")


def slower_dbc(escs: int) -> str:
    """The shipped layout for so many ESCs, its cycle times four times as long where they are shorter than a second."""
    command = [sys.executable, "-m", "kontronik_can_gw", "dbc", "--esc", str(escs)]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout

    def slower(found: re.Match[str]) -> str:
        cycle = int(found[2])
        return f"{found[1]}{cycle * 4 if cycle < 1000 else cycle};"

    return re.sub(r'(BA_ "GenMsgCycleTime" BO_ \d+ )(\d+);', slower, text)


def prepare(folder: Path) -> None:
    """Make what would take long in the emulated machine: tables of what the gateways send, and byte code."""
    for escs in (1, 3):
        text = slower_dbc(escs)
        Path(folder, f"{escs}.dbc").write_text(text)
        Path(folder, f"{escs}.json").write_text(to_json(table_of([text], escs)))
    sources = [str(PROJECT / name) for name in ("kontronik_can_gw", "tests/faults")]
    subprocess.run([sys.executable, "-m", "compileall", "-q", *sources], check=False)


def main() -> int:
    args = outside.parser(__doc__).parse_args()
    mine = outside.chosen(in_order("QEMU"), args.only)
    if args.inside is None:
        return outside.main(
            args, "qemu_programme.py", mine, backend="qemu", timeout_s=TIMEOUT_S[args.long], prepare=prepare
        )
    inside(args.inside, mine, LONG if args.long else 1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
