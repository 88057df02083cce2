"""A recorded gateway without a clock. Random events happen to it.

The bench has the frames that it sent, and the entries of the recording.
"""

import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from kontronik_can_gw.assembly.assemble import assemble
from kontronik_can_gw.assembly.capture_setup import CaptureSetup
from kontronik_can_gw.capture.format import Entry, block, data_payload, json_payload
from kontronik_can_gw.capture.recorded_gateway import RecordedGateway
from kontronik_can_gw.cli.recording import setup_of
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.desk.recordings.recording import Input, Sample
from kontronik_can_gw.desk.recordings.replay import TimedFrame, in_order
from kontronik_can_gw.esc.kontronik.simulator import EscOptions, Faults, SimulatedEsc
from kontronik_can_gw.esc.kontronik.states import Device
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.transmit_queue import TransmitQueue
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.status import CanState
from kontronik_can_gw.times import MS, SECOND

START = 5_000 * SECOND + 123


def esc(number: int) -> dict[str, object]:
    return {"name": f"e{number}", "pole_pairs": number + 1}


def made(
    escs: int = 1,
    canopen: bool = False,
    of_esc: Callable[[int], dict[str, object]] = esc,
    dronecan: Mapping[str, object] | None = None,
    quiet_after_s: int = 0,
    **dbc: object,
) -> tuple[CaptureSetup, MessageLayout]:
    """Return the setup of a gateway and the layout of its messages.

    ``of_esc`` returns the configuration of an ESC without its port.
    """
    tables: dict[str, object] = {
        "can": {"interface": "virtual", "quiet_after_s": quiet_after_s},
        "dbc": dbc,
        "canopen": {"enabled": canopen, "self_start": True, "store": "/nonexistent/store"},
        "dronecan": dronecan or {},
        "esc": [{"port": f"/dev/ttyUSB{n}"} | of_esc(n) for n in range(escs)],
    }
    loaded = assemble(parse(tables, "bench.toml"))
    return setup_of(loaded), loaded.layout


@dataclass
class Bench:
    """A recorded gateway.

    ``entries`` has the recorded entries. ``sent`` has the frames that the live gateway sent on an
    interface that takes everything.
    """

    setup: CaptureSetup
    layout: MessageLayout
    entries: list[Entry] = field(default_factory=list)
    sent: list[TimedFrame] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.gateway = RecordedGateway(
            self._put,
            CoreSettings(
                self.setup.escs,
                self.layout,
                silent_on_loss=self.setup.dbc_settings.silent_on_loss,
                **self.setup.core_numbers,
            ),
            START,
            outputs=self.setup.outputs,
        )
        self.quiet_turns = 0
        """Number of iterations in quiet mode."""
        self._waiting = TransmitQueue()
        self._saves: list[int] = []
        self._is_open = True

    def _put(
        self,
        time_ns: int,
        kind: int,
        esc: int,
        data: bytes,
        flags: int,
        came_ns: int | None,
    ) -> None:
        self.entries.append(Entry(time_ns, kind, esc, data, flags, came_ns))

    def take(self, now: int) -> None:
        frames = in_order(self.gateway.take_frames(now), self._waiting)
        if self._is_open:
            self.gateway.status.sent_frames += len(frames)
            self.sent += [TimedFrame(now, frame) for frame in frames]
        elif frames:
            self.gateway.not_sent(now)
        if self._is_open and self.gateway.is_held:
            first = self.gateway.first_frame(now)
            assert first is not None
            self.gateway.status.sent_frames += 1
            self.sent.append(TimedFrame(now, first))
            self.gateway.release(now)
        self._saves += [esc for esc, _ in self.gateway.take_saves()]

    def live(self, seed: int, seconds: float, wild: bool = True) -> "Bench":
        """Run for a time with random events, and end.

        Bytes arrive in random pieces, turns are late, the bus and the ports fail and return, and a
        master sends requests. If the gateway has a quiet mode, the ESCs are silent for every second
        period of two seconds.
        """
        now = self.running(seed, wild)(seconds)
        self.gateway.stop(now)
        self.take(now)
        return self

    def running(
        self,
        seed: int,
        wild: bool = True,
    ) -> Callable[[float], int]:
        """Start the gateway. Return a function that runs it for a number of seconds.

        The function returns the time after that.
        """
        rng = random.Random(seed)
        gateway = self.gateway
        now = START + rng.randrange(MS)
        faults = Faults(flipped_bits=0.0005)
        escs = []
        for _ in self.setup.escs:
            device = rng.choice([Device.KOSMIK, Device.JIVEPRO])
            options = EscOptions(device=device, faults=faults)
            escs.append(SimulatedEsc(options, seed=rng.randrange(1000), start_ns=now))
        for index in range(len(escs)):
            gateway.port(index, True, now)
        gateway.start(now, rng.random() < 0.9)
        self.take(now)
        open_ports = [True] * len(escs)

        def run(seconds: float) -> int:
            nonlocal now
            end = now + int(seconds * SECOND)
            while now < end:
                late = rng.choice([0, 0, rng.randrange(200_000), rng.randrange(3 * MS)])
                soon = now + rng.randrange(1, 12 * MS)
                now = max(now + 1, min(gateway.next_deadline(), soon) + late)
                if wild and rng.random() < 0.002:
                    now += rng.randrange(400 * MS)
                    gateway.held_up(now, rng.random() < 0.5)
                for index, esc in enumerate(escs):
                    data = b"".join(sent.wire for sent in esc.frames_until(now))
                    if (
                        self.setup.core_numbers.get("quiet_after_ns")
                        and (now - START) // (2 * SECOND) % 2
                    ):
                        data = b""
                    if data and open_ports[index]:
                        cut = rng.randrange(len(data) + 1)
                        for part in filter(None, (data[:cut], data[cut:])):
                            since = now - rng.choice([0, rng.randrange(20 * MS)])
                            gateway.receive_bytes(index, part, now, since)
                if wild:
                    self._happens(rng, now, open_ports)
                gateway.advance(now)
                self.take(now)
                self.quiet_turns += gateway.status.is_quiet
            return now

        return run

    def _happens(
        self,
        rng: random.Random,
        now: int,
        open_ports: list[bool],
    ) -> None:
        gateway = self.gateway
        index = rng.randrange(len(open_ports))
        what = rng.random()
        if what < 0.002:
            open_ports[index] = not open_ports[index]
            gateway.port(index, open_ports[index], now)
        elif what < 0.006:
            gateway.set_can_state(rng.choice(list(CanState)), now)
            self._is_open = self._is_open and gateway.status.can_state is not CanState.DOWN
        elif what < 0.01:
            self._is_open = True
            gateway.can_opened(now)
            gateway.can_returned(now)
        elif what < 0.012:
            gateway.status.bus_off_count += 1
            gateway.status.replaced_frames += rng.randrange(5)
            gateway.escs[index].line_errors += 3
        elif what < 0.014:
            gateway.receive_overrun(now)
        elif what < 0.03 and self._saves:
            gateway.saved(self._saves.pop(0), rng.choice([None, "disk full"]), now)
        elif what < 0.06 and gateway.receive_ids:
            can_id = rng.choice(sorted(gateway.receive_ids))
            data = rng.choice(
                [
                    bytes((0x40, 0x10 + rng.randrange(16), 0x20, rng.randrange(4), 0, 0, 0, 0)),
                    b"\x23\x10\x10\x01save",
                    bytes((0x2B, 0x17, 0x10, 0, rng.randrange(256), 1, 0, 0)),
                    bytes((0x2F, 0x00, 0x21, 1, rng.randrange(1, 9), 0, 0, 0)),
                    bytes((rng.choice([1, 2, 0x80, 0x81, 0x82]), rng.randrange(3))),
                    rng.randbytes(rng.randrange(9)),
                ]
            )
            gateway.status.received_frames += 1
            if can_id >> 31:  # one id of a block of ids
                frame = CanFrame(can_id & 0x1FFFFFFF | rng.randrange(0x80), data, True)
            else:
                frame = CanFrame(can_id, data)
            gateway.receive_frame(frame, now, now - rng.randrange(50 * MS))


def capture_file(
    setup: CaptureSetup,
    entries: Sequence[Entry],
    devices: Sequence[str] = (),
    **more: object,
) -> bytes:
    """Return a capture in the recorder's format.

    ``devices`` are devices of the ESCs that become known at its end. ``more`` has further keys of
    its header.
    """
    header = setup.header() | {"run": "r", "part": 0, "created_ns": START, "monotonic_ns": START}
    header |= {"wall_ns": 1_700_000_000 * SECOND} | more
    blocks = [(b"H", json_payload(header))]
    for at in range(0, len(entries), 300):
        blocks.append((b"D", data_payload(entries[at : at + 300])))
    if devices:
        known = {"variant": 200, "firmware": "1.2", "layout": "V4"}
        learnt = [known | {"device": name} for name in devices]
        blocks.append((b"I", json_payload({"devices": learnt})))
    blocks.append((b"E", b""))
    return b"".join(block(kind, number, data) for number, (kind, data) in enumerate(blocks))


def capture(
    path: Path,
    setup: CaptureSetup,
    entries: Sequence[Entry],
    **more: object,
) -> Path:
    """Write a ``capture_file``. Return its path."""
    path.write_bytes(capture_file(setup, entries, **more))  # type: ignore[arg-type]
    return path


def samples(recording: Input, chosen: Sequence[int] | None = None) -> Iterator[Sample]:
    """Yield the rows of a recording one by one."""
    for rows in recording.blocks(chosen):
        yield from map(Sample, rows.times, zip(*rows.columns, strict=True))
