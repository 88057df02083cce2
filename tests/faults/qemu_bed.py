"""The bench on emulated hardware: an ESC on its 16550A, one on a played adapter whose wire has real bits, two CAN controllers."""

import contextlib
import os
import pickle
import random
import re
import select
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from bus_watch import MS
from encoding import Identity
from feeder import CURRENT, SPEED, FedEsc
from harness import Bench, LoggedProcess
from qemu_adapter import ESC_LINE, Line, SerialAdapter
from qemu_machine import AS_SET, can_up, line_setting, serial_ports, wait_until
from signals import table_of

from kontronik_can_gw.esc.kontronik.codec import Layout
from kontronik_can_gw.esc.kontronik.states import Device

SLACK_NS = 400 * MS
RATE_HZ = 10
INFO_EVERY = 20
TOLD_S = 0.05
"""Until the metronome has told of the last standstill."""


class FarPort(FedEsc):
    """An ESC at the far end of QEMU's serial port.

    QEMU keeps what comes while the port is closed, and delivers it at the next opening: no UART does. So this ESC is silent
    until the process that ``reader`` names has the port open.
    """

    def __init__(self, identity: Identity, reader: Callable[[], int | None]) -> None:
        super().__init__(identity, RATE_HZ, INFO_EVERY)
        self.path = self.device = "/dev/ttyS1"
        self._reader = reader
        self._known: int | None = None  # the process that has it open
        self._is_set = False
        self._fd = os.open("/dev/virtio-ports/com1", os.O_RDWR | os.O_NONBLOCK)
        self._transmitted = 0  # by the machine
        self._before_set = 0  # bytes sent until the port was set: what the kernel may have echoed
        self._stop = False
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def write(self, data: bytes) -> bool:
        reader = self._reader()
        if reader is None:
            return False
        if self._known != reader:
            if not self._is_open(reader):
                return False
            self._known = reader
        self._is_set = self._is_set or line_setting(self.device) == AS_SET
        if not self._is_set:
            self._before_set += len(data)
        return self.put(data)

    def put(self, data: bytes, seconds: float = 1.0) -> bool:
        """Bytes to the port; whether it took all of them within the time."""
        done, deadline = 0, time.monotonic() + seconds
        while done < len(data) and time.monotonic() < deadline:
            try:
                done += os.write(self._fd, data[done:])
            except BlockingIOError:
                time.sleep(0.002)
        return done == len(data)

    def _is_open(self, process: int) -> bool:
        with contextlib.suppress(OSError):
            for fd in os.listdir(f"/proc/{process}/fd"):
                if os.readlink(f"/proc/{process}/fd/{fd}") == self.device:
                    return True
        return False

    def _listen(self) -> None:
        while not self._stop:
            if select.select([self._fd], [], [], 0.2)[0]:
                with contextlib.suppress(BlockingIOError):
                    self._transmitted += len(os.read(self._fd, 4096))

    def received(self) -> int:
        return max(0, self._transmitted - self._before_set)

    def close(self) -> None:
        self._stop = True
        self._thread.join(2)
        os.close(self._fd)


class WirePort(FedEsc):
    """A played adapter. ``send`` is how a frame gets onto the wire; setting it to another of the methods is the fault."""

    def __init__(self, identity: Identity) -> None:
        super().__init__(identity, RATE_HZ, INFO_EVERY)
        self.adapter = SerialAdapter("ESC0002")
        self.send: Callable[[bytes], bool] = self.clean
        self._random = random.Random(1)
        self.device = ""
        self.plug()
        self.path = self.device

    def write(self, data: bytes) -> bool:
        return self.send(data)

    def clean(self, data: bytes) -> bool:
        self.adapter.put(data)
        return self.adapter.plugged

    def silent(self, data: bytes) -> bool:
        return False

    def flipped(self, data: bytes) -> bool:
        """One bit time of the frame, start, parity and stop bits among them, has the wrong level."""
        self.adapter.flip(data, self._random.randrange(1, len(data) * ESC_LINE.bits + 1))
        return False

    def at(self, line: Line) -> Callable[[bytes], bool]:
        """As an ESC sends whose UART is set otherwise."""

        def send(data: bytes) -> bool:
            self.adapter.put(data, line)
            return False

        return send

    def unplug(self) -> None:
        """Returns when its device file is gone."""
        before, self.device = self.device, ""
        self.adapter.unplug()
        wait_until(lambda: before not in serial_ports(), 5, f"{before} gone")

    def plug(self) -> None:
        """Returns when its device file is there, maybe another than before."""
        before = serial_ports()
        self.adapter.plug()
        wait_until(lambda: serial_ports() - before, 5, "the adapter's device file")
        (self.device,) = serial_ports() - before

    def received(self) -> int:
        return self.adapter.received

    def close(self) -> None:
        self.unplug()


_METRONOME = """
import time
step, last = 0.03, time.monotonic_ns()
while True:
    time.sleep(step)
    now = time.monotonic_ns()
    if now - last > 3e9 * step:
        print(last + int(1e9 * step), now, flush=True)
    last = now
"""


class Metronome(LoggedProcess):
    """A process that only wakes up, and notes when it could not: then nothing could run, the gateway neither."""

    def __init__(self) -> None:
        python = [sys.executable, "-S", "-E", "-c", _METRONOME]
        super().__init__(["chrt", "-f", "20", *python], keep_out=True)

    def stood_still(self, begin_ns: int, end_ns: int) -> int:
        """Nanoseconds of that time in which nothing ran."""
        total = 0
        for words in reversed(self.out):
            begin, end = map(int, words.split())
            if end < begin_ns:
                break
            total += max(0, min(end, end_ns) - max(begin, begin_ns))
        return total


class MachineBench(Bench):
    """Two ESCs on two kinds of port, and a gateway on the first controller; the second one watches.

    The machine is so slow that two frames are often read at once: then the newer one goes to the bus. A value that was replaced by one
    sent at most SLACK_NS later is not lost. What the gateway sends by the clock it sends four times more slowly than by the shipped
    DBC, and its CANopen nodes stay PRE-OPERATIONAL, for speed's sake.
    """

    def __init__(self, folder: Path) -> None:
        self._gateway = None  # the feeder asks before it is set
        self.uart = FarPort(Identity(1, Layout.V4), self._reader)
        self.wire = WirePort(Identity(2, Layout.LEGACY, Device.JIVEPRO, 12))
        for name in ("can0", "can1"):
            can_up(name)
        super().__init__(
            "can0",
            "can1",
            [self.uart, self.wire],
            pickle.loads((folder / "sent.table").read_bytes()),
            slack_ns=SLACK_NS,
            dbc=folder / "slow.dbc",
            canopen="",
            start_limit_s=120,
        )
        self._metronome = Metronome()

    def _reader(self) -> int | None:
        """The gateway's process."""
        if self._gateway is None or self._gateway.process.poll() is not None:
            return None
        return self._gateway.process.pid

    def stood_still(self, begin_ns: int, end_ns: int) -> int:
        return self._metronome.stood_still(begin_ns, end_ns)

    def running_s(self, begin_ns: int, end_ns: int) -> float:
        time.sleep(TOLD_S)
        return super().running_s(begin_ns, end_ns)

    def close(self) -> None:
        super().close()
        self._metronome.kill()

    def forgive(self, until_ns: int) -> None:
        time.sleep(TOLD_S)
        both = SPEED | CURRENT
        for esc, accounted in zip(self.escs, self._accounted, strict=True):
            newer = 0
            for n in range(esc.newest(time.monotonic_ns()), accounted - 1, -1):
                sent = esc.sent[n]
                if esc.seen[n] == both:
                    newer = sent
                elif esc.whole[n] and sent <= until_ns and newer and newer - sent <= SLACK_NS:
                    esc.seen[n] = both


@contextlib.contextmanager
def machine(folder: Path) -> Iterator[MachineBench]:
    """The bed; ``folder`` has what ``prepare`` made."""
    with MachineBench(folder) as bench:
        bench.start()
        yield bench


def prepare(folder: Path) -> None:
    """Make what would take long in the emulated machine: the shipped layout with cycle times below a second made four times as long,
    a table of what it sends, and byte code."""

    def slower(found: re.Match[str]) -> str:
        cycle = int(found[2])
        return f"{found[1]}{cycle * 4 if cycle < 1000 else cycle};"

    command = [sys.executable, "-m", "kontronik_can_gw", "dbc", "--esc", "2"]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    text = re.sub(r'(BA_ "GenMsgCycleTime" BO_ \d+ )(\d+);', slower, text)
    (folder / "slow.dbc").write_text(text)
    (folder / "sent.table").write_bytes(pickle.dumps(table_of(text, 2)))
    here = Path(__file__).resolve().parent
    sources = [str(here.parents[1] / "kontronik_can_gw"), str(here)]
    subprocess.run([sys.executable, "-m", "compileall", "-q", *sources], check=False)
