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
from collections.abc import Iterator
from pathlib import Path

import outside
import programme
import qemu_faults  # noqa: F401  registers its faults
from bus_watch import MS
from encoding import Identity
from fault_report import Report, Row, in_order
from feeder import CURRENT, SPEED
from harness import Bench, Gateway
from qemu_adapter import SerialAdapter
from qemu_machine import can_up
from qemu_ports import FarPort, WirePort
from signals import table_of

from kontronik_can_gw.esc.kontronik.codec import Layout
from kontronik_can_gw.esc.kontronik.states import Device

SLACK_NS = 400 * MS
TIMEOUT_S = {False: 600, True: 7200}
LONG_TIMES = 10


class MachineBench(Bench):
    """Two ESCs on two kinds of port, and a gateway on the first controller; the second one watches.

    The machine is so slow that two frames are often read at once: then the newer one goes to the bus. A value that was replaced by one
    sent at most SLACK_NS later is not lost. What the gateway sends by the clock it sends four times more slowly than by the shipped
    DBC, and its CANopen nodes stay PRE-OPERATIONAL, for speed's sake.
    """

    metronome_step_s = 0.03

    def __init__(self, report: Report, tables: Path) -> None:
        self.uart = FarPort("com1", "/dev/ttyS1", Identity(1, Layout.V4), self._reader)
        adapter = SerialAdapter(0, "ESC0002")
        self.wire = WirePort(adapter, Identity(2, Layout.LEGACY, Device.JIVEPRO, 12))
        for name in ("can0", "can1"):
            can_up(name)
        super().__init__(
            "can0",
            "can1",
            [self.uart, self.wire],
            report,
            slack_ns=SLACK_NS,
            table=pickle.loads((tables / "sent.table").read_bytes()),
            options=f'[dbc]\nfile = "{tables / "slow.dbc"}"',
            canopen="",
            start_limit_s=120,
        )

    def _reader(self) -> int | None:
        """The gateway's process."""
        gateway: Gateway | None = getattr(self, "gateway", None)  # the feeder asks before it is set
        return gateway.process.pid if gateway is not None and gateway.alive else None

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


@contextlib.contextmanager
def running(tables: Path, report: Report) -> Iterator[Bench]:
    with MachineBench(report, tables) as bench:
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
    (folder / "sent.table").write_bytes(pickle.dumps(table_of([text], 2)))
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
    made = {"machine": functools.partial(running, args.inside)}
    programme.run(mine, Report(), LONG_TIMES if args.long else 1, args.inside / "report.json", made)
    return 0


if __name__ == "__main__":
    sys.exit(main())
