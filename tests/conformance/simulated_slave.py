"""The gateway's node as a slave under test, in this process and in simulated time.

A proxy may stand between the master and the node, and break a rule of the standards.
"""

from collections import deque
from collections.abc import Callable
from pathlib import Path

import can
from dialogue import Bench, live
from script import MS

from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.conformance.eds_file import EdsFile, read_eds
from kontronik_can_gw.desk.conformance.slave import Slave
from kontronik_can_gw.frames import CanFrame

EDS = Path(str(shipped("eds/kontronik_esc.eds")))
_LIMIT_S = 1.0
_TELEMETRY_NS = 400 * MS


class Proxy:
    """Passes frames between the master and the node. ``count`` is for its rules."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.to_master: deque[CanFrame] = deque()
        self.count = 0

    def answer(self, can_id: int, data: bytes) -> None:
        """Send a frame to the master that the node did not send."""
        self.to_master.append(CanFrame(can_id, data))


Rule = Callable[[CanFrame, Proxy], list[CanFrame]]
"""Returns the frames that are passed on instead of a frame."""


def pass_on(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
    return [frame]


class SimulatedBus(can.BusABC):
    """A bus with the node of a bench. Time passes only while ``recv`` waits."""

    def __init__(self, bench: Bench, from_master: Rule, from_node: Rule) -> None:
        self.bench = bench
        self._from_master = from_master
        self._from_node = from_node
        self._proxy = Proxy(bench)
        bench.uart(live())
        self._next_telemetry = _TELEMETRY_NS
        self._is_shutdown = True  # there is nothing to close

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        data = bytes(msg.dlc) if msg.is_remote_frame else bytes(msg.data)
        flags = {"extended": msg.is_extended_id, "remote": msg.is_remote_frame}
        for frame in self._from_master(CanFrame(msg.arbitration_id, data, **flags), self._proxy):
            self.bench.put(frame.can_id, frame.data, extended=frame.extended, remote=frame.remote)
            self.bench.answer_saves()
        self._collect()

    def recv(self, timeout: float | None = None) -> can.Message | None:
        assert timeout is not None
        until = self.bench.now + round(timeout * 1e9)
        while not self._proxy.to_master:
            if self.bench.now >= until:
                return None
            self._step(until)
        frame = self._proxy.to_master.popleft()
        return can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False)

    def time_s(self) -> float:
        return self.bench.now / 1e9

    def _step(self, until: int) -> None:
        """Let time pass until the next deadline of the gateway, but not beyond ``until``."""
        if self.bench.now >= self._next_telemetry:
            self.bench.uart(live())
            self._next_telemetry = self.bench.now + _TELEMETRY_NS
        due = max(self.bench.now, self.bench.gateway.next_deadline())
        self.bench.pass_time(min(until, due, self._next_telemetry))
        self._collect()

    def _collect(self) -> None:
        for frame in self.bench.take():
            self._proxy.to_master += self._from_node(frame, self._proxy)


def simulated_slave(
    from_master: Rule = pass_on,
    from_node: Rule = pass_on,
    *,
    eds: EdsFile | None = None,
    bench: Bench | None = None,
) -> Slave:
    """Return the node of a new gateway as a slave under test."""
    bench = bench or Bench(boot=False, escs={"timeout_ns": 1000 * MS})
    bus = SimulatedBus(bench, from_master, from_node)
    return Slave(bus, 1, eds or read_eds(EDS, 1), _LIMIT_S, bus.time_s)
