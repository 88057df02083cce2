"""A capture of any length, made without waiting, and what the simulated ESCs meant in it, kept aside frame by frame.

In it: dropouts, a port that is unplugged, devices that are swapped (one gives no BEC current), errors for a while, a bus in trouble, a wall
clock that is set. What is kept (``Meant``, ``Sent``) comes from the simulator's own objects and from the frames that the gateway handed
out, never from the file.
"""

import random
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import zip_longest
from pathlib import Path
from typing import IO

import numpy as np
from capture_bench import made
from numpy.typing import NDArray

from kontronik_can_gw.capture.format import (
    Entry,
    Kind,
    block,
    data_payload,
    json_payload,
    number_data,
)
from kontronik_can_gw.capture.replay import in_order
from kontronik_can_gw.capture.setup import CaptureSetup
from kontronik_can_gw.esc.kontronik import Device
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData
from kontronik_can_gw.esc.kontronik.simulator import (
    Dropout,
    ErrorWindow,
    EscOptions,
    Faults,
    SimulatedEsc,
    Swap,
)
from kontronik_can_gw.esc.kontronik.simulator import Sent as Wired
from kontronik_can_gw.esc.kontronik.states import OperatingError, SelfTestError
from kontronik_can_gw.gateway_status import CanState
from kontronik_can_gw.runtime.recorded_gateway import RecordedGateway
from kontronik_can_gw.transmit_queue import TransmitQueue

MS = 1_000_000
SECOND = 1000 * MS
START = 86_400 * SECOND + 123_456_000
WALL = 1_790_000_000 * SECOND + 250_004_000
CLOCK_STEP = 1_500_250_000
"""The wall clock is set by so much in the middle."""
BYTE_NS = 11 * SECOND // 115_200
TIMEOUT_NS = 250 * MS
GEAR = Fraction(17, 2)
CELLS = 6
_BLOCK_NS = SECOND // 2

Times = NDArray[np.int64]


@dataclass
class Meant:
    """What one ESC meant to say, as far as it left on the line. Times are those of a frame's last byte."""

    live_ns: "array[int]" = field(default_factory=lambda: array("q"))
    read_ns: "array[int]" = field(default_factory=lambda: array("q"))
    """When a live frame was read: sometimes only together with the info frame behind it."""
    lives: "array[int]" = field(default_factory=lambda: array("q"))
    """The fields of LiveData, frame behind frame."""
    devices: "array[int]" = field(default_factory=lambda: array("q"))
    legacy: "array[int]" = field(default_factory=lambda: array("q"))
    info_ns: "array[int]" = field(default_factory=lambda: array("q"))
    infos: "array[int]" = field(default_factory=lambda: array("q"))
    wire: bytearray = field(default_factory=bytearray)
    unplugged: list[tuple[int, int]] = field(default_factory=list)
    """When the port was lost and opened again."""
    pole_pairs: int = 1

    def live_fields(self) -> dict[str, NDArray[np.int64]]:
        """A column for each field of the live frames."""
        return _columns(self.lives, LiveData._fields)

    def info_fields(self) -> dict[str, NDArray[np.int64]]:
        """A column for each field of the info frames."""
        return _columns(self.infos, InfoData._fields)


def _columns(values: "array[int]", names: tuple[str, ...]) -> dict[str, NDArray[np.int64]]:
    table = np.array(values, dtype=np.int64).reshape(-1, len(names))
    return {name: np.ascontiguousarray(table[:, index]) for index, name in enumerate(names)}


@dataclass
class Sent:
    """The CAN frames that the live gateway handed to its interface, in order."""

    times: "array[int]" = field(default_factory=lambda: array("q"))
    ids: "array[int]" = field(default_factory=lambda: array("q"))
    data: "array[int]" = field(default_factory=lambda: array("Q"))


@dataclass
class Recording:
    """A capture at ``path``, and the truth of it."""

    path: Path
    setup: CaptureSetup
    escs: list[Meant]
    sent: Sent
    end_ns: int
    clock_set_ns: int
    can_states: list[tuple[int, int]]

    def wall_ns(self, times: Times) -> Times:
        """Unix time in ns."""
        wall: Times = times - START + WALL + np.where(times >= self.clock_set_ns, CLOCK_STEP, 0)
        return wall

    @property
    def telemetry_frames(self) -> int:
        """Live and info frames that left on the lines."""
        return sum(len(esc.live_ns) + len(esc.info_ns) for esc in self.escs)


def options_of(index: int, seconds: float) -> EscOptions:
    """What ESC it is, and what happens to it in so many seconds."""
    length = int(seconds * SECOND)
    jive, kosmik = Device.JIVEPRO, Device.KOSMIK
    return EscOptions(
        device=kosmik if index % 2 == 0 else jive,
        faults=Faults(
            dropout=Dropout(2 * SECOND, min(400 * SECOND, int(length / 3.7)) + index * 7 * MS),
            errors=(
                ErrorWindow(OperatingError.UNDERVOLTAGE, length // 5, length // 20),
                ErrorWindow(OperatingError.OPERATING_ERROR_FOUND, length // 5, length // 19),
                ErrorWindow(OperatingError.BEC_OVERTEMPERATURE, length * 3 // 5, length // 30),
                ErrorWindow(SelfTestError.TEST_EEPROM_VERSION, length // 2, length // 10),
            ),
            swaps=(
                Swap(length * 2 // 5 + 3 * MS, jive if index % 2 == 0 else kosmik),
                Swap(length * 4 // 5 + 3 * MS, kosmik if index % 2 == 0 else Device.KOLIBRI),
            ),
        ),
    )


def esc(number: int) -> dict[str, object]:
    """The configuration of an ESC."""
    return {"name": f"esc{number + 1}", "pole_pairs": pole_pairs(number), "gear": str(GEAR)}


def pole_pairs(number: int) -> int:
    return 5 + 2 * number


class _Writer:
    """The file as the recorder writes it: a block each half second."""

    def __init__(self, file: IO[bytes], setup: CaptureSetup) -> None:
        self._file = file
        self._number = 0
        self._entries: list[Entry] = []
        self._begun = START
        header = setup.header() | {"run": "a1b2c3d4e5f60718", "part": 0, "created_ns": START}
        self._block(
            b"H", json_payload(header | {"monotonic_ns": START, "wall_ns": WALL, "devices": []})
        )

    def put(
        self, time_ns: int, kind: int, esc: int, data: bytes, flags: int, came_ns: int | None = None
    ) -> None:
        if time_ns - self._begun >= _BLOCK_NS:
            self._begun = time_ns
            self.flush()
        self._entries.append(Entry(time_ns, kind, esc, data, flags, came_ns))

    def flush(self) -> None:
        if self._entries:
            self._block(b"D", data_payload(self._entries))
            self._entries.clear()

    def close(self) -> None:
        self.flush()
        self._block(b"E", b"")

    def _block(self, kind: bytes, payload: bytes) -> None:
        self._file.write(block(kind, self._number, payload))
        self._number += 1


@dataclass(order=True)
class _Read:
    """Bytes that the gateway reads at once."""

    time_ns: int
    esc: int
    data: bytes = field(compare=False)


def record(path: Path, seconds: float, escs: int = 1, seed: int = 1) -> Recording:
    """Make a capture of so many seconds at ``path``."""
    setup, layout = made(escs, of_esc=esc)
    length = int(seconds * SECOND)
    end = START + length
    states = [
        (START, CanState.ERROR_ACTIVE),
        (START + length // 4, CanState.ERROR_WARNING),
        (START + length // 4 + 2 * SECOND, CanState.ERROR_ACTIVE),
    ]
    recording = Recording(
        path,
        setup,
        [Meant(pole_pairs=pole_pairs(n)) for n in range(escs)],
        Sent(),
        end,
        START + length // 2 + 1,
        [(at, int(state)) for at, state in states],
    )
    out = START + length * 7 // 10
    recording.escs[0].unplugged.append((out, out + min(4 * SECOND, length // 15)))
    with path.open("wb") as file:
        writer = _Writer(file, setup)
        gateway = RecordedGateway(writer.put, setup.escs, layout, START)
        sent, waiting = recording.sent, TransmitQueue()

        def take(now: int) -> None:
            frames = in_order(gateway.take_frames(now), waiting)
            gateway.status.sent_frames += len(frames)
            gateway.take_link_changes()
            for frame in frames:
                sent.times.append(now)
                sent.ids.append(frame.can_id)
                sent.data.append(int.from_bytes(frame.data, "little"))
                assert len(frame.data) == 8

        def turns(until: int) -> None:
            while (due := gateway.next_deadline()) < until:
                gateway.advance(due)
                take(due)

        happenings = [(at, 0, int(state)) for at, state in states]
        happenings += [(lost, 1, 0) for lost, _ in recording.escs[0].unplugged]
        happenings += [(opened, 2, 0) for _, opened in recording.escs[0].unplugged]
        happenings += [(recording.clock_set_ns, 3, 0)]
        happenings.sort()
        for index in range(escs):
            gateway.port(index, True, START)
        gateway.start(START)
        take(START)
        for read in _reads(recording, seconds, random.Random(seed)):
            while happenings and happenings[0][0] <= read.time_ns:
                at, what, value = happenings.pop(0)
                turns(at)
                if what == 0:
                    gateway.set_can_state(CanState(value), at)
                elif what == 3:
                    writer.put(at, Kind.CLOCK, 0, number_data(at - START + WALL + CLOCK_STEP), 0)
                else:
                    gateway.port(0, what != 1, at)
                gateway.advance(at)
                take(at)
            turns(read.time_ns)
            gateway.receive_bytes(read.esc, read.data, read.time_ns, read.time_ns)
            gateway.advance(read.time_ns)
            take(read.time_ns)
        turns(end)
        gateway.stop(end)
        take(end)
        writer.close()
    return recording


def _reads(recording: Recording, seconds: float, rng: random.Random) -> Iterator[_Read]:
    """What is read, in order of time; notes in ``recording`` what was meant. Frames come whole, in two pieces, or two at once."""
    plans = [options_of(index, seconds) for index in range(len(recording.escs))]
    starts = [START + 5 * MS + index * 1_700_000 for index in range(len(plans))]
    simulated = [
        SimulatedEsc(plan, seed=index + 1, start_ns=starts[index])
        for index, plan in enumerate(plans)
    ]
    held: list[_Read] = []
    end = START + int(seconds * SECOND)
    for slice_end in [*range(START + SECOND, end, SECOND), end]:
        found = held
        for index, esc in enumerate(simulated):
            meant = recording.escs[index]
            unread = b""
            frames = [one for one in esc.frames_until(slice_end) if _arrives(one, meant, end)]
            for one, behind in zip_longest(frames, frames[1:]):
                last = one.time_ns + len(one.wire) * BYTE_NS
                live = isinstance(one.data, LiveData)
                _note(one, meant, plans[index], starts[index])
                if live and behind and behind.time_ns == last and rng.random() < 0.5:
                    unread = one.wire
                    # it stands in front
                    meant.read_ns.append(last + len(behind.wire) * BYTE_NS - 1)
                    continue
                if live:
                    meant.read_ns.append(last)
                if not unread and len(meant.live_ns) > 1 and rng.random() < 0.15:
                    cut = rng.randrange(1, len(one.wire))
                    found.append(_Read(one.time_ns + cut * BYTE_NS, index, one.wire[:cut]))
                    found.append(_Read(last, index, one.wire[cut:]))
                else:
                    found.append(_Read(last, index, unread + one.wire))
                    unread = b""
        found.sort()
        held = [read for read in found if read.time_ns > slice_end]
        yield from (read for read in found if read.time_ns <= slice_end)
    yield from sorted(held)


def _note(one: Wired, meant: Meant, plan: EscOptions, start_ns: int) -> None:
    """Keep what a frame means."""
    last = one.time_ns + len(one.wire) * BYTE_NS
    meant.wire += one.wire
    if not isinstance(one.data, LiveData):
        meant.info_ns.append(last)
        meant.infos.extend(one.data)
        return
    meant.live_ns.append(last)
    meant.lives.extend(one.data)
    swaps = [swap for swap in plan.faults.swaps if one.time_ns - start_ns >= swap.time_ns]
    meant.devices.append(int(swaps[-1].device if swaps else plan.device))
    meant.legacy.append(len(one.wire) == 38)


def _arrives(one: Wired, meant: Meant, end: int) -> bool:
    last = one.time_ns + len(one.wire) * BYTE_NS
    return last < end and not any(
        lost <= last and one.time_ns <= again for lost, again in meant.unplugged
    )
