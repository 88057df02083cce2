"""Recordings to convert: a capture of two ESCs, a CAN log, plain bytes. Made once a session."""

import random
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import cantools.database
from capture_bench import Bench, capture_file, made

from kontronik_can_gw.cli import main
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.esc.kontronik import Device
from kontronik_can_gw.esc.kontronik.simulator import EscOptions, Faults, SimulatedEsc
from kontronik_can_gw.esc.telemetry import SECOND

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
    spoilt = Faults(noise=0.5, lost_bytes=0.002, flipped_bits=0.0002) if faults else Faults()
    esc = SimulatedEsc(EscOptions(device=Device.KOSMIK, faults=spoilt), seed=5)
    return b"".join(sent.wire for sent in esc.frames_until(int(seconds * SECOND)))


@cache
def shipped_database() -> "cantools.database.can.Database":
    """The DBC of one ESC, by cantools."""
    database = cantools.database.load_file(shipped("dbc/kontronik_esc.dbc"))
    assert isinstance(database, cantools.database.can.Database)
    return database


def candump_lines(count: int, seed: int = 1) -> list[tuple[int, int, bytes]]:
    """Frames of the shipped DBC with values of all kinds, not available and errors too: time in us, id, data."""
    chance = random.Random(seed)
    database = shipped_database()
    now = 1_700_000_000_000_000
    lines = []
    for number in range(count):
        now += chance.choice((10, 250, 9_000, 20_000))
        message = database.messages[number % len(database.messages)]
        values: dict[str, int] = {}
        for signal in message.signals:
            names = list(signal.choices or {})
            bits = 1 << signal.length
            low = -bits // 2 if signal.is_signed else 0
            if names and len(names) > 2 and chance.random() < 0.9:
                values[signal.name] = chance.choice(names)
            else:
                values[signal.name] = chance.choice(
                    (low, low + bits - 1, chance.randrange(low, low + bits))
                )
        lines.append((now, message.frame_id, message.encode(values, scaling=False, strict=False)))
    return lines


def write_candump(path: Path, lines: list[tuple[int, int, bytes]]) -> Path:
    """As ``candump -L`` has it."""
    path.write_text(
        "".join(
            f"({us // 10**6}.{us % 10**6:06d}) can0 {i:03X}#{d.hex().upper()}\n"
            for us, i, d in lines
        )
    )
    return path
