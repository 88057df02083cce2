"""Measures the SDO latency of CANopen nodes during SYNCs, in real time and without CAN hardware.

    python tests/benchmarks/sdo_at_sync.py [NODES] [TYPE] [SECONDS] [HZ]

All TPDOs of all nodes get the transmission type TYPE. On a busy machine run it with `chrt -f 50`,
because else it measures the other programs.
"""

import os
import select
import socket
import struct
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

from programs import CANOPEN, new_bus, standin, started, write_config

from kontronik_can_gw.desk.pty import PtyEsc
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import LiveData

_FRAME = struct.Struct("=IB3x8s")
_SHIPPED = Path(__file__).resolve().parents[2] / "dbc" / "kontronik_esc.dbc"
_REQUEST_PERIOD_S = 0.013
_PATIENCE_S = 5.0


class Master:
    """The other end of the bus, with an SDO client."""

    def __init__(self, bus: socket.socket) -> None:
        self._bus = bus
        bus.setblocking(False)

    def send(self, cob_id: int, data: bytes = b"") -> None:
        self._bus.setblocking(True)
        padded = data.ljust(8, b"\0")
        self._bus.send(_FRAME.pack(cob_id, len(data), padded))
        self._bus.setblocking(False)

    def received(self, wait_s: float) -> Iterator[int]:
        """Yield the ids of the waiting frames, or of the frames received within this time."""
        select.select([self._bus], [], [], max(0.0, wait_s))
        try:
            while data := self._bus.recv(128):
                cob_id, _, _ = _FRAME.unpack(data[: _FRAME.size])
                yield cob_id
        except BlockingIOError:
            return

    def ask(self, node: int, request: bytes) -> None:
        """Send an SDO request and wait for its answer."""
        self.send(0x600 + node, request)
        end = time.monotonic() + _PATIENCE_S
        while time.monotonic() < end:
            if 0x580 + node in list(self.received(0.01)):
                return
        raise SystemExit(f"node {node} does not answer {request.hex()}")


def set_up(master: Master, node: int, kind: int) -> None:
    """Give the node's four default TPDOs a transmission type."""
    for number in range(4):
        cob_id = 0x180 + 0x100 * number + node
        for head, value in (
            (bytes((0x23, number, 0x18, 1)), 0xC000_0000 | cob_id),
            (bytes((0x2F, number, 0x18, 2)), kind),
            (bytes((0x23, number, 0x18, 1)), 0x4000_0000 | cob_id),
        ):
            master.ask(node, head + value.to_bytes(4, "little"))


def measure(
    master: Master,
    escs: list[PtyEsc],
    seconds: float,
    sync_hz: float,
) -> list[float]:
    """Return the sorted latencies in seconds."""
    lives = []
    for n in range(100):
        data = LiveData(electrical_speed=n, battery_voltage=2442 + n % 7, battery_current=n % 50)
        lives.append(encode(data, WireLayout.V4))
    start = time.monotonic()
    next_sync = next_live = next_request = start
    latencies: list[float] = []
    asked: tuple[int, float] | None = None
    count = 0
    while (now := time.monotonic()) < start + seconds:
        while next_sync <= now:
            master.send(0x80)
            next_sync += 1 / sync_hz
        if next_live <= now:
            for esc in escs:
                esc.write(lives[count % len(lives)])
            count += 1
            next_live += 0.01
        if asked is None and now >= next_request:
            node = len(latencies) % len(escs) + 1
            asked = node, time.monotonic()
            master.send(0x600 + node, bytes.fromhex("4000100000000000"))
            next_request = now + _REQUEST_PERIOD_S
        for cob_id in master.received(min(next_sync, next_live, next_request) - time.monotonic()):
            if asked is not None and cob_id == 0x580 + asked[0]:
                latencies.append(time.monotonic() - asked[1])
                asked = None
    if asked is not None:
        latencies.append(time.monotonic() - asked[1])
    return sorted(latencies)


def main(arguments: list[str]) -> None:
    defaults = ("4", "1", "10", "1000")
    given = [*arguments, *defaults[len(arguments) :]]
    count, kind, seconds, sync_hz = map(float, given)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        escs = [stack.enter_context(PtyEsc()) for _ in range(int(count))]
        bus = new_bus()
        listener = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
        listener.bind("\0" + bus)
        listener.listen(1)
        listener.settimeout(20)
        file = write_config(folder, [esc.path for esc in escs], _SHIPPED, CANOPEN)
        log = stack.enter_context((folder / "log").open("w"))
        command = standin(bus, "ours", "run", "-c", file)
        stack.enter_context(started(command, stderr=log, cwd=folder))
        far, _ = listener.accept()
        stack.enter_context(far)
        master = Master(far)
        time.sleep(2)
        for node in range(1, len(escs) + 1):
            set_up(master, node, int(kind))
        found = measure(master, escs, seconds, sync_hz)
    cores = os.cpu_count()
    median_ms = found[len(found) // 2] * 1e3
    p99_ms = found[int(0.99 * len(found))] * 1e3
    longest_ms = found[-1] * 1e3
    print(
        f"{len(escs)} nodes, type {int(kind)}, SYNC {sync_hz:g} Hz: {len(found)} requests, "
        f"median {median_ms:.1f} ms, p99 {p99_ms:.1f} ms, maximum {longest_ms:.1f} ms "
        f"({cores} CPUs)"
    )


if __name__ == "__main__":
    main(sys.argv[1:])
