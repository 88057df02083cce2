"""Recordings to convert: a capture of two ESCs, a CAN log, plain bytes. Made once a session."""

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
    """Run the command in this process; its exit code."""
    return main(["convert", *map(str, words)])


@cache
def capture_bytes(
    escs: int = 2, seed: int = 3, seconds: float = 6, devices: Sequence[str] = ()
) -> bytes:
    """A capture file in which everything happens. ``devices``: what is learnt of the ESCs at its end."""
    bench = Bench(*made(escs)).live(seed, seconds)
    return capture_file(bench.setup, bench.entries, devices, wall_ns=WALL_NS)


@cache
def dump_bytes(seconds: float = 4, faults: bool = False) -> bytes:
    """The bytes of one ESC."""
    spoilt = Faults(flipped_bits=0.0005) if faults else Faults()
    esc = SimulatedEsc(EscOptions(device=Device.KOSMIK, faults=spoilt), seed=5)
    return b"".join(sent.wire for sent in esc.frames_until(int(seconds * SECOND)))


@cache
def _flown() -> Timed:
    return flight(layout_of(["esc1"]), 3)


def candump_log(path: Path, times: int = 1) -> Path:
    """What an ESC's gateway sends in 3 s, as ``candump -L`` has it; so many ``times`` over."""
    path.write_text(write_log(path, _flown()).read_text() * times)
    return path
