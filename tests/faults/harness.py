"""The bench of the fault programme: fed ESCs, a gateway process, a judge of the bus, and the account of each injected fault.

    @fault("Serial", "port gone and back", 2.0, escs=[0])    # who is disturbed by it; []: nobody may be; all unless given
    def gone(bench, injection, pause):                       # one of the fault's rounds
        ...the fault is on...
        injection.cleared()                                  # its cause is gone: until the first right value sent since then

Then the bus is watched a while longer, then wrong and lost values are put down to the fault. Times are
monotonic nanoseconds, of frames the kernel's.
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
"""A frame that was handed over so shortly before a fault may be its victim."""
AHEAD = ("chrt", "-f", "10")
"""The gateway goes before the bench's own processes, with which it shares a processor here."""


class NotRecovered(AssertionError):
    """The gateway did not come back in time."""


class LoggedProcess:
    """A program as its own process, and the lines that it has written so far: ``lines`` to standard error, ``out`` to standard output."""

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
        """Wait until it has ended and all that it wrote is read; its exit code."""
        code = self.process.wait(60)
        for reader in self._readers:
            reader.join(60)
        return code

    def kill(self) -> None:
        """End it, however it fares."""
        if self.process.poll() is None:
            self.process.kill()
        self.wait()


class Gateway(LoggedProcess):
    """``kontronik-can-gw run`` with a prefix (``setpriv``) and an environment if need be."""

    def __init__(self, config: Path, prefix: Sequence[str], environment: Mapping[str, str]) -> None:
        program = [sys.executable, "-m", "kontronik_can_gw", "run", "-c", str(config), "--wait"]
        self.started_ns = time.monotonic_ns()
        super().__init__([*AHEAD, *prefix, *program], environment)

    def figures(self) -> dict[str, int]:
        """Resident memory in KiB, open descriptors, threads."""
        folder = Path("/proc", str(self.process.pid))
        status = dict(row.split(":", 1) for row in (folder / "status").read_text().splitlines())
        return {
            "rss": int(status["VmRSS"].split()[0]),
            "descriptors": len(list((folder / "fd").iterdir())),
            "threads": int(status["Threads"]),
        }

    def growth(self, before: dict[str, int], rss_kib: int) -> list[str]:
        """What it has more of than before, memory above so much."""
        limits = before | {"rss": before["rss"] + rss_kib}
        after = self.figures()
        return [
            f"{each} {before[each]} -> {after[each]}"
            for each in before
            if after[each] > limits[each]
        ]


class PtyPort(FedEsc):
    """A fed ESC on a pseudo terminal, which is made without echo, behind a symbolic link; it may be unplugged and plugged in again."""

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
        """The terminal hangs up, the link goes."""
        with self._lock:
            if self._pty is not None:
                self._received += self._pty.check()
                self._pty.close()
                self._pty = None

    def plug(self, other: bool = False) -> None:
        """A new terminal behind the same link; ``other``: certainly under another number than the one before."""
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
    """Everything that runs around one gateway.

    ``interface`` is the gateway's, ``watched`` the far end of it, where the judge listens. ``canopen``: with a node for each ESC.
    ``more``: further tables of the configuration.
    """

    said_instead: str | None = None
    """What the log may say in place of a line that is waited for."""

    def __init__(
        self,
        interface: str,
        watched: str,
        escs: Sequence[FedEsc],
        table: Table,
        *,
        slack_ns: int = 60 * MS,
        canopen: bool = True,
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
        self.config.write_text(self._configuration(canopen) + more)
        self.watch = BusWatch(watched, table, self.escs, slack_ns=slack_ns).start()
        self.feeder = Feeder(self.escs).start()
        self._gateway: Gateway | None = None
        self._accounted = [0 for _ in escs]
        self._received = 0
        self._excluded: list[list[tuple[int, int]]] = [[] for _ in escs]

    def _configuration(self, canopen: bool) -> str:
        text = f'[can]\ninterface = "socketcan"\nchannel = "{self.interface}"\nbitrate = 1000000\n'
        if canopen:
            text += "[canopen]\nenabled = true\nself_start = true\nnode_id = 1\nserial = 1050112\n"
            text += f'store = "{self.store}"\n'
        for i, esc in enumerate(self.escs):
            text += f'[[esc]]\nname = "esc{i + 1}"\nport = "{esc.path}"\npole_pairs = {POLE_PAIRS}\ngear = {GEAR}\n'
        return text

    # --- the gateway

    @property
    def gateway(self) -> Gateway:
        """The one that runs."""
        assert self._gateway is not None
        return self._gateway

    def start(self, *, wait: bool = True) -> None:
        """Start the gateway; ``wait``: until every ESC that is on has its values on the bus. NotRecovered if they do not come."""
        assert self._gateway is None
        begin = time.monotonic_ns()
        self._gateway = Gateway(self.config, self.prefix, self.environment)
        if wait:
            on = [i for i, esc in enumerate(self.escs) if esc.on]
            self.wait_fresh(on, begin, 20)
            self.leave_out(range(len(self.escs)), begin - IN_FLIGHT_NS, time.monotonic_ns())

    def stop(self) -> int:
        """End the gateway by SIGTERM; its exit code."""
        process = self.gateway.process
        try:
            process.terminate()
            return process.wait(10)
        except subprocess.TimeoutExpired:
            raise NotRecovered("it did not end within 10 s of SIGTERM") from None
        finally:
            self.kill()

    def kill(self) -> None:
        """End the gateway, however it fares."""
        gateway = self._gateway
        self._gateway = None
        if gateway is not None:
            gateway.kill()

    def wait_fresh(
        self, escs: Sequence[int], after_ns: int, seconds: float, sent_after_ns: int = 0
    ) -> int:
        """Wait until each of these ESCs has had a right value on the bus after a time; when the last of them came first."""
        came = [after_ns]

        def all_came() -> bool:
            found = [self.watch.first_fresh(esc, after_ns, sent_after_ns) for esc in escs]
            came[1:] = [fresh.at_ns for fresh in found if fresh]
            return all(found)

        names = ", ".join(f"esc{esc + 1}" for esc in escs)
        self.wait_until(all_came, seconds, f"right values of {names}")
        return max(came)

    def wait_until(self, condition: Callable[[], object], seconds: float, what: str) -> None:
        """Wait until something holds. NotRecovered when it does not come."""
        begin = time.monotonic()
        last = False
        while not condition():
            if last:
                raise NotRecovered(f"{what}: not within {seconds:g} s; {self.last_words()}")
            self.check_alive()
            if time.monotonic() - begin > seconds:
                self.watch.catch_up()  # and look once more
                last = True
            else:
                time.sleep(0.01)

    def wait_log(self, text: str, since: int = 0, seconds: float = 10) -> None:
        """Wait for a line with this text in the gateway's log, from that line on."""
        lines = self.gateway.lines
        texts = [each for each in (text, self.said_instead) if each]
        self.wait_until(
            lambda: any(each in line for line in lines[since:] for each in texts),
            seconds,
            f"the log says {text!r}",
        )

    def expect(self, holds: object, what: str) -> None:
        """NotRecovered unless something holds."""
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

    def leave_out(self, escs: Sequence[int] | range, begin_ns: int, end_ns: int) -> None:
        """What these ESCs sent in that time need not come to the bus."""
        for esc in escs:
            self._excluded[esc].append((begin_ns, end_ns))

    def account(self, row: Row) -> list[tuple[int, str]]:
        """Note in a row how many values that were sent since the last account, outside of all faults, never came; when and which."""
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
        """One injection of a fault, noted in the row; True if the bench is still good."""
        row.injected += 1
        try:
            self.check_alive()
            self.account(row)  # of before; nobody's fault is the programme's too
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
        """End the gateway and everything else; the folder stays for a look at it as long as the machine lives."""
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
    """One fault while it is on and until it is healed."""

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
        """The cause is gone; what is sent from now on has to arrive soon."""
        self.cleared_ns = time.monotonic_ns()

    def wait_recovery(self) -> None:
        """Wait for the first right value of each disturbed ESC that was sent since ``cleared``."""
        assert self.cleared_ns is not None
        limit_s = (self.fault.limit_s or 1.0) * 3 + 2
        self.recovered_ns = self.bench.wait_fresh(
            self.escs, self.cleared_ns, limit_s, self.cleared_ns
        )
        self.healed_at(self.recovered_ns)

    def healed_at(self, at_ns: int) -> None:
        """Something else that had to heal too was good at that time."""
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
        """What was sent until then may be lost."""
        self.bench.leave_out(self.escs, self.begin_ns - IN_FLIGHT_NS, end_ns)

    def note_values(self, losses: Sequence[tuple[int, str]]) -> None:
        """Put the wrong values since the injection, and these lost ones, down to it."""

        def after(at_ns: int | None) -> str:
            return "no time" if at_ns is None else f"{(at_ns - self.begin_ns) / SECOND:.3f} s"

        watch = self.bench.watch
        row = self.row
        wrong = watch.wrong_count - self._wrong
        row.wrong += wrong
        for each in list(watch.wrong)[-min(wrong, 3) :] if wrong else ():
            row.notes.append(f"wrong value {after(each.at_ns)} after the injection: {each.what}")
        if losses:
            when = "; ".join(f"{after(at)} {what}" for at, what in losses[:4])
            row.notes.append(
                f"{len(losses)} values lost, cleared at {after(self.cleared_ns)}, "
                f"recovered at {after(self.recovered_ns)}: {when}"
            )
