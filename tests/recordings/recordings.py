"""Recordings to convert: a capture of two ESCs, a CAN log and plain bytes.

Each is made once in a test session.
"""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

from capture_bench import Bench, capture_file, made
from simulated_bus import Timed, flight, layout_of, write_log

from kontronik_can_gw.cli import main
from kontronik_can_gw.esc.kontronik.simulator import EscOptions, Faults, SimulatedEsc
from kontronik_can_gw.esc.kontronik.states import Device
from kontronik_can_gw.times import SECOND

WALL_NS = 1_700_000_000 * SECOND + 250_000_000


def convert(*words: object) -> int:
    """Run ``convert`` in this process and return its exit code."""
    return main(["convert", *map(str, words)])


@cache
def capture_bytes(
    escs: int = 2,
    seed: int = 3,
    seconds: float = 6,
    devices: Sequence[str] = (),
) -> bytes:
    """Return a capture file with all kinds of events.

    ``devices`` are the names of the ESCs' devices, which are written at its end.
    """
    bench = Bench(*made(escs)).live(seed, seconds)
    return capture_file(bench.setup, bench.entries, devices, wall_ns=WALL_NS)


@cache
def dump_bytes(seconds: float = 4, faults: bool = False) -> bytes:
    """Return the bytes of one ESC."""
    spoilt = Faults(flipped_bits=0.0005) if faults else Faults()
    esc = SimulatedEsc(EscOptions(device=Device.KOSMIK, faults=spoilt), seed=5)
    return b"".join(sent.wire for sent in esc.frames_until(int(seconds * SECOND)))


@cache
def _flown() -> Timed:
    return flight(layout_of(["esc1"]), 3)


def candump_log(path: Path, times: int = 1) -> Path:
    """Write the frames of a gateway in 3 s as ``candump -L`` does, several times in a row."""
    path.write_text(write_log(path, _flown()).read_text() * times)
    return path
