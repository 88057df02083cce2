"""The bench of the fault programme: fed ESCs, a gateway process, a judge, and each fault's result.

    @fault("Serial", "port gone and back", 2.0, escs=[0])
    def gone(bench, injection, pause):
        ...the fault is on...
        injection.cleared()

``escs`` are the ESCs that the fault may disturb, by default all of them. With ``[]`` no ESC may be
disturbed. The last argument is one of the fault's rounds. ``cleared`` means that the cause is gone.
The recovery lasts from then to the first right value that was sent after it.

The bus is watched a while longer, and wrong and lost values are counted for the fault. Times are
monotonic nanoseconds. Times of frames are the kernel's.
"""

import os
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Self

from bus_watch import MS, SECOND, BusWatch
from fault_report import Fault, Row
from feeder import CURRENT, GEAR, POLE_PAIRS, SPEED, FedEsc, Feeder, Identity
from signals import Table

from kontronik_can_gw.desk.pty import PtyEsc

IN_FLIGHT_NS = 60 * MS
"""A frame that was sent within this time before a fault may be lost because of it."""
AHEAD = ("chrt", "-f", "10")
"""Gives the gateway priority over the bench's own processes, which share its processor."""


class NotRecovered(AssertionError):
    """The gateway did not recover in time."""


class LoggedProcess:
    """A program in a separate process, and the lines that it has written so far.

    ``lines`` has the lines of standard error, ``out`` the lines of standard output.
    """

    def __init__(
        self,
        command: Sequence[str],
        environment: Mapping[str, str] | None = None,
        keep_out: bool = False,
    ) -> None:
        self.process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE if keep_out else subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, **(environment or {})},
        )
        self.lines: list[str] = []
        self.out: list[str] = []
        self._readers = []
        for stream, lines in ((self.process.stderr, self.lines), (self.process.stdout, self.out)):
            if stream is not None:
                reader = threading.Thread(target=self._read, args=(stream, lines), daemon=True)
                reader.start()
                self._readers.append(reader)

    @staticmethod
    def _read(stream: IO[str], lines: list[str]) -> None:
        with stream:
            for text in stream:
                lines.append(text.rstrip())

    @property
    def log(self) -> str:
        return "\n".join(self.lines)

    def wait(self) -> int:
        """Wait until it has ended and its output is read. Return its exit code."""
        code = self.process.wait(60)
        for reader in self._readers:
            reader.join(60)
        return code

    def kill(self) -> None:
        """Kill it unless it has ended."""
        if self.process.poll() is None:
            self.process.kill()
        self.wait()


class Gateway(LoggedProcess):
    """``kontronik-can-gw run`` with an optional prefix such as ``setpriv``, and an environment."""

    def __init__(
        self,
        config: Path,
        prefix: Sequence[str],
        environment: Mapping[str, str],
    ) -> None:
        program = [sys.executable, "-m", "kontronik_can_gw", "run", "-c", str(config), "--wait"]
        self.started_ns = time.monotonic_ns()
        super().__init__([*AHEAD, *prefix, *program], environment)

    def figures(self) -> dict[str, int]:
        """Return its resident memory in KiB and its numbers of open descriptors and threads."""
        folder = Path("/proc", str(self.process.pid))
        status = dict(row.split(":", 1) for row in (folder / "status").read_text().splitlines())
        return {
            "rss": int(status["VmRSS"].split()[0]),
            "descriptors": len(list((folder / "fd").iterdir())),
            "threads": int(status["Threads"]),
        }

    def growth(
        self,
        before: dict[str, int],
        rss_kib: int,
    ) -> list[str]:
        """Return the figures that have grown, as text. Memory may grow by ``rss_kib``."""
        limits = before | {"rss": before["rss"] + rss_kib}
        after = self.figures()
        grown = []
        for each in before:
            if after[each] > limits[each]:
                grown.append(f"{each} {before[each]} -> {after[each]}")
        return grown


class PtyPort(FedEsc):
    """A fed ESC on a pseudo terminal without echo, behind a symbolic link.

    It may be unplugged and plugged in again.
    """

    def __init__(self, link: Path, identity: Identity, rate_hz: float = 50) -> None:
        super().__init__(identity, rate_hz)
        self.link = link
        self.path = str(link)
        self._lock = threading.Lock()
        self._received = 0
        self._pty: PtyEsc | None = None
        self.plug()

    @property
    def device(self) -> str:
        """The terminal behind the link."""
        assert self._pty is not None
        return self._pty.path

    def write(self, data: bytes) -> bool:
        with self._lock:
            return self._pty is not None and self._pty.write(data)

    def unplug(self) -> None:
        """Hang up the terminal and remove the link."""
        with self._lock:
            if self._pty is not None:
                self._received += self._pty.check()
                self._pty.close()
                self._pty = None

    def plug(self, other: bool = False) -> None:
        """Create a terminal behind the same link. With ``other`` it has another number."""
        before = PtyEsc() if other else None
        with self._lock:
            assert self._pty is None
            self._pty = PtyEsc(self.link)
        if before is not None:
            before.close()

    def received(self) -> int:
        with self._lock:
            if self._pty is not None:
                self._received += self._pty.check()
            return self._received

    def close(self) -> None:
        self.unplug()


class Bench:
    """One gateway and everything that runs around it.

    ``interface`` is the gateway's interface. The judge receives at ``watched``, its far end.
    With ``canopen`` there is a node for each ESC. ``can`` has further keys of [can], and ``more``
    further tables of the configuration.
    """

    said_instead: str | None = None
    """Text that the log may have in place of an expected line."""

    def __init__(
        self,
        interface: str,
        watched: str,
        escs: Sequence[FedEsc],
        table: Table,
        *,
        slack_ns: int = 60 * MS,
        canopen: bool = True,
        can: str = "",
        more: str = "",
        store: Path | None = None,
        prefix: Sequence[str] = (),
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.interface = interface
        self.watched = watched
        self.escs = list(escs)
        self.folder = Path(tempfile.mkdtemp(prefix="faults."))
        self.store = store or self.folder / "store"
        self.config = self.folder / "gateway.toml"
        self.prefix = tuple(prefix)
        self.environment = dict(environment or {})
        self.config.write_text(self._configuration(canopen, can) + more)
        self.watch = BusWatch(watched, table, self.escs, slack_ns=slack_ns).start()
        self.feeder = Feeder(self.escs).start()
        self._gateway: Gateway | None = None
        self._accounted = [0 for _ in escs]
        self._received = 0
        self._excluded: list[list[tuple[int, int]]] = [[] for _ in escs]

    def _configuration(self, canopen: bool, can: str) -> str:
        text = f'[can]\ninterface = "socketcan"\nchannel = "{self.interface}"\nbitrate = 1000000\n'
        text += can
        if canopen:
            text += "[canopen]\nenabled = true\nself_start = true\nnode_id = 1\nserial = 1050112\n"
            text += f'store = "{self.store}"\n'
        for number, esc in enumerate(self.escs, 1):
            text += f'[[esc]]\nname = "esc{number}"\nport = "{esc.path}"\n'
            text += f"pole_pairs = {POLE_PAIRS}\ngear = {GEAR}\n"
        return text

    # --- the gateway

    @property
    def gateway(self) -> Gateway:
        """The running gateway."""
        assert self._gateway is not None
        return self._gateway

    def start(self, *, wait: bool = True) -> None:
        """Start the gateway.

        With ``wait``, wait until the values of every ESC that is on are on the bus. Raise
        NotRecovered if they do not arrive within 20 s.
        """
        assert self._gateway is None
        begin = time.monotonic_ns()
        self._gateway = Gateway(self.config, self.prefix, self.environment)
        if wait:
            on = [i for i, esc in enumerate(self.escs) if esc.on]
            self.wait_fresh(on, begin, 20)
            self.leave_out(range(len(self.escs)), begin - IN_FLIGHT_NS, time.monotonic_ns())

    def stop(self) -> int:
        """End the gateway by SIGTERM. Return its exit code."""
        process = self.gateway.process
        try:
            process.terminate()
            return process.wait(10)
        except subprocess.TimeoutExpired:
            raise NotRecovered("it did not end within 10 s of SIGTERM") from None
        finally:
            self.kill()

    def kill(self) -> None:
        """Kill the gateway unless it has ended."""
        gateway = self._gateway
        self._gateway = None
        if gateway is not None:
            gateway.kill()

    def wait_fresh(
        self,
        escs: Sequence[int],
        after_ns: int,
        seconds: float,
        sent_after_ns: int = 0,
    ) -> int:
        """Wait until each of these ESCs has had a right value on the bus after a time.

        Return the time at which the last ESC's first right value arrived.
        """
        came = [after_ns]

        def all_came() -> bool:
            found = [self.watch.first_fresh(esc, after_ns, sent_after_ns) for esc in escs]
            came[1:] = [fresh.at_ns for fresh in found if fresh]
            return all(found)

        names = ", ".join(f"esc{esc + 1}" for esc in escs)
        self.wait_until(all_came, seconds, f"right values of {names}")
        return max(came)

    def wait_until(
        self,
        condition: Callable[[], object],
        seconds: float,
        what: str,
    ) -> None:
        """Wait until a condition is true. Raise NotRecovered if it stays false."""
        begin = time.monotonic()
        last = False
        while not condition():
            if last:
                raise NotRecovered(f"{what}: not within {seconds:g} s; {self.last_words()}")
            self.check_alive()
            if time.monotonic() - begin > seconds:
                self.watch.catch_up()  # and check a last time
                last = True
            else:
                time.sleep(0.01)

    def wait_log(
        self,
        text: str,
        since: int = 0,
        seconds: float = 10,
    ) -> None:
        """Wait for a line with this text in the gateway's log, beginning at line ``since``."""
        lines = self.gateway.lines
        texts = [each for each in (text, self.said_instead) if each]

        def is_logged() -> bool:
            log = "\n".join(lines[since:])
            return any(each in log for each in texts)

        self.wait_until(is_logged, seconds, f"the log says {text!r}")

    def expect(self, holds: object, what: str) -> None:
        """Raise NotRecovered unless the condition is true."""
        if not holds:
            raise NotRecovered(f"{what}; {self.last_words()}")

    def check_alive(self) -> None:
        code = self._gateway and self._gateway.process.poll()
        if code is not None:
            raise NotRecovered(f"the gateway ended with {code}; {self.last_words()}")
        for failure in (self.feeder.error, self.watch.failure):
            if failure is not None:
                raise failure

    def last_words(self) -> str:
        lines = self._gateway.lines[-6:] if self._gateway is not None else []
        return f"the gateway's last lines: {' | '.join(lines) or 'none'}"

    # --- accounts

    def leave_out(
        self,
        escs: Sequence[int] | range,
        begin_ns: int,
        end_ns: int,
    ) -> None:
        """Do not expect frames on the bus that these ESCs sent in this time."""
        for esc in escs:
            self._excluded[esc].append((begin_ns, end_ns))

    def account(self, row: Row) -> list[tuple[int, str]]:
        """Count in a row the values that were lost outside of all faults since the last account.

        Return the time and a description of each.
        """
        until_ns = time.monotonic_ns() - 150 * MS
        self.watch.catch_up()
        losses = []
        for index, fed in enumerate(self.escs):
            last = fed.newest(until_ns)
            for n in range(self._accounted[index], last + 1):
                at = fed.sent[n]
                if not fed.whole[n] or fed.seen[n] == SPEED | CURRENT:
                    continue
                if any(begin <= at <= end for begin, end in self._excluded[index]):
                    continue
                seen = {0: "nothing", SPEED: "only EscSpeed"}.get(fed.seen[n], "only EscCurrent")
                losses.append((at, f"esc{index + 1} frame {n} of {len(fed.sent)}: {seen} came"))
            self._accounted[index] = max(self._accounted[index], last + 1)
            self._excluded[index] = [x for x in self._excluded[index] if x[1] > until_ns]
        row.lost += len(losses)
        return losses

    def inject(self, fault: Fault, row: Row, given: Any) -> bool:
        """Inject a fault once, and note the result. Return True if the bench is still usable."""
        row.injected += 1
        try:
            self.check_alive()
            self.account(row)  # losses before the injection count as well
        except NotRecovered as error:
            row.notes.append(str(error))
            return False
        injection = Injection(self, fault, row)
        good = False
        try:
            fault.inject(self, injection, given)
            if injection.cleared_ns is not None and injection.recovered_ns is None:
                injection.wait_recovery()
            injection.leave_out_until(injection.recovered_ns or time.monotonic_ns())
            time.sleep(fault.settle_s)
            self.check_alive()
            good = True
        except NotRecovered as error:
            row.notes.append(str(error))
        except Exception as error:
            traceback.print_exc()
            row.notes.append(repr(error))
        if not good:
            injection.leave_out_until(time.monotonic_ns())
        injection.note_values(self.account(row))
        received = self._received
        self._received = sum(esc.received() for esc in self.escs)
        row.transmitted += max(0, self._received - received)
        if fault.limit_s is not None and injection.recovery_s > fault.limit_s:
            row.notes.append(f"recovered only after {injection.recovery_s:.2f} s")
        else:
            row.recovered += good
        row.worst_s = max(row.worst_s, injection.recovery_s)
        return good

    def close(self) -> None:
        """End the gateway and everything else. The folder is kept for inspection."""
        self.feeder.close()
        self.kill()
        self.watch.close()
        for esc in self.escs:
            esc.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Injection:
    """One injected fault until the gateway has recovered from it."""

    def __init__(self, bench: Bench, fault: Fault, row: Row) -> None:
        self.bench = bench
        self.fault = fault
        self.row = row
        self.escs = range(len(bench.escs)) if fault.escs is None else fault.escs
        self.begin_ns = time.monotonic_ns()
        self.cleared_ns: int | None = None
        self.recovered_ns: int | None = None
        self.recovery_s = 0.0
        self._boot_ups = len(bench.watch.boot_ups)
        self._emergencies = len(bench.watch.emergencies)
        self._wrong = bench.watch.wrong_count

    def cleared(self) -> None:
        """Note that the cause is gone. Frames that are sent later have to arrive soon."""
        self.cleared_ns = time.monotonic_ns()

    def wait_recovery(self) -> None:
        """Wait for a right value of each disturbed ESC that was sent after ``cleared``."""
        assert self.cleared_ns is not None
        limit_s = (self.fault.limit_s or 1.0) * 3 + 2
        self.recovered_ns = self.bench.wait_fresh(
            self.escs,
            self.cleared_ns,
            limit_s,
            self.cleared_ns,
        )
        self.healed_at(self.recovered_ns)

    def healed_at(self, at_ns: int) -> None:
        """Note that something else that had to recover was good at this time."""
        assert self.cleared_ns is not None
        self.recovery_s = max(self.recovery_s, (at_ns - self.cleared_ns) / SECOND)

    def wait_boot_up(self, node: int) -> None:
        """Wait for a boot-up message of a node since the injection."""
        times: list[int] = []

        def seen() -> bool:
            found = self.bench.watch.boot_ups[self._boot_ups :]
            times.extend(at_ns for at_ns, booted in found if booted == node)
            return times != []

        self.bench.wait_until(seen, 3, f"boot-up of node {node}")
        self.healed_at(times[0])

    def wait_emergency(self, node: int, code: int) -> None:
        """Wait for an EMCY of a node since the injection."""

        def seen() -> bool:
            found = self.bench.watch.emergencies[self._emergencies :]
            return any((each.node, each.code) == (node, code) for each in found)

        self.bench.wait_until(seen, 3, f"EMCY {code:X}h")

    def leave_out_until(self, end_ns: int) -> None:
        """Allow frames that were sent until this time to be lost."""
        self.bench.leave_out(self.escs, self.begin_ns - IN_FLIGHT_NS, end_ns)

    def note_values(self, losses: Sequence[tuple[int, str]]) -> None:
        """Count the wrong values since the injection, and these lost ones, for this fault."""

        def after(at_ns: int | None) -> str:
            if at_ns is None:
                return "no time"
            return f"{(at_ns - self.begin_ns) / SECOND:.3f} s"

        watch = self.bench.watch
        row = self.row
        wrong = watch.wrong_count - self._wrong
        row.wrong += wrong
        shown = list(watch.wrong)[-min(wrong, 3) :] if wrong else []
        for each in shown:
            row.notes.append(f"wrong value {after(each.at_ns)} after the injection: {each.what}")
        if losses:
            when = "; ".join(f"{after(at)} {what}" for at, what in losses[:4])
            row.notes.append(
                f"{len(losses)} values lost, cleared at {after(self.cleared_ns)}, "
                f"recovered at {after(self.recovered_ns)}: {when}"
            )
