"""Compares recordings played by the C core at full speed with the same played by Python.

Rows, frames, damage and text must be equal.
"""

import random
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import equality
from capture_bench import START, Bench, made, samples

from kontronik_can_gw.capture.format import Entry, EntryKind, block, data_payload, json_payload
from kontronik_can_gw.desk.recordings import bytes_input
from kontronik_can_gw.desk.recordings.convert import TABLES, OutputFile, to_log, to_table
from kontronik_can_gw.desk.recordings.fields import Choice
from kontronik_can_gw.desk.recordings.inputs import Input, open_input
from kontronik_can_gw.desk.recordings.recording import PlayedBlock
from kontronik_can_gw.native import load
from kontronik_can_gw.times import SECOND

TEXTS = ("csv", "jsonl", "candump")


@contextmanager
def core(library: Any) -> Iterator[None]:
    """Use this shared object within the block. None means that there is none."""
    before = load.library
    load.library = lambda: (library, "")  # type: ignore[assignment]
    try:
        yield
    finally:
        load.library = before


def esc(chance: random.Random, number: int) -> dict[str, object]:
    gear = f"{chance.randint(1, 300)}/{chance.randint(1, 300)}"
    timeout = chance.choice((20, 250, 1000))
    poles = chance.choice((1, 7, 14, 64, 100))
    cells = chance.choice((0, 0, 6, 14))
    more = {"gear": gear, "cell_count": cells, "telemetry_timeout_ms": timeout}
    return {"name": f"e{number}", "pole_pairs": poles} | more


def odd(chance: random.Random, last: Entry) -> Entry:
    """Return a rare entry, or one that no recorder writes."""
    now = last.time_ns
    number = chance.randrange(1 << chance.choice((40, 40, 50, 64))).to_bytes(8, "little")
    noise = equality.stream(chance)
    return chance.choice(
        (
            Entry(
                now, EntryKind.CLOCK, 0, (START + chance.randrange(1 << 60)).to_bytes(8, "little")
            ),
            Entry(now, EntryKind.CLOCK, 0, b"short"),
            Entry(now, EntryKind.NOT_SENT),
            Entry(now, EntryKind.COUNTERS, 0, number * 8),
            Entry(now, EntryKind.COUNTERS, 0, number * 9),
            Entry(now, EntryKind.COUNTERS, 0, number * 3),
            Entry(now, EntryKind.HOLD),
            Entry(now, EntryKind.FIRST_FRAME),
            Entry(now, EntryKind.RELEASE),
            Entry(now, EntryKind.LOST, 0, number),
            Entry(now, EntryKind.FRAME, 0, b"1"),
            Entry(now, EntryKind.HELD_UP, 0, b"", 1),
            Entry(now - chance.randrange(SECOND), EntryKind.ADVANCE),
            Entry(now, EntryKind.BYTES, 0, noise, 0, now - chance.randrange(SECOND)),
            Entry(now, EntryKind.BYTES, 0, bytes(17_000) + noise, 0, now),
            Entry(now, EntryKind.BYTES, 9, noise, 0, now),
            Entry(now, 77),
        )
    )


def write_capture(chance: random.Random, path: Path, version: int = 2) -> Path:
    """Write a capture in which everything occurs. A part may be damaged."""
    nodes = chance.random() < 0.4
    escs = chance.randint(1, 3)
    setup = made(
        escs, nodes, lambda number: esc(chance, number), quiet_after_s=chance.choice((0, 1))
    )
    bench = Bench(*setup)
    bench.live(chance.randrange(1000), 6)
    entries = [bench.entries[0]]
    for entry in bench.entries[1:]:
        if chance.random() < 0.01:
            entries.append(odd(chance, entries[-1]))
        entries.append(entry)
    header = bench.setup.header() | {"run": "r", "part": 0, "created_ns": START}
    header |= {"monotonic_ns": START, "wall_ns": 1_700_000_000 * SECOND, "version": version}
    blocks = [block(b"H", 0, json_payload(header))]
    while entries:
        count = chance.choice((1, 2, 40, 400))
        some = entries[:count]
        entries = entries[count:]
        payload = data_payload(some)
        if version == 1:
            payload = data_payload([e._replace(came_ns=e.time_ns) for e in some])
        if chance.random() < 0.02:
            payload = payload[:-1]  # contradicts its table
        blocks.append(block(b"D", len(blocks), payload))
    if chance.random() < 0.5:
        blocks[chance.randrange(1, len(blocks))] = b"damaged"
    path.write_bytes(b"".join(blocks) + block(b"E", len(blocks), b""))
    return path


def write_bytes(chance: random.Random, path: Path) -> Path:
    """Write plain bytes. A part may be damaged."""
    data = b"".join(equality.stream(chance) for _ in range(chance.choice((1, 30, 300))))
    if chance.random() < 0.5:
        data += bytes(chance.choice(b"KODLI\0\xff") for _ in range(chance.choice((5, 100_000))))
    path.write_bytes(b"KODL" + data + b"".join(equality.stream(chance) for _ in range(20)))
    return path


def read(recording: Input, chosen: Sequence[int]) -> list[Any]:
    """Return rows, frames and damage of a recording."""
    rows = [(row.time_ns, row.values) for row in samples(recording, chosen)]
    found = [rows, list(recording.damage)]
    frames = list(recording.frames())
    return [*found, frames, list(recording.damage)]


def converted(recording: Input, choice: Choice, form: str, path: Path) -> Any:
    """Convert a recording. Return the result of the conversion and the content of its file."""
    path.unlink(missing_ok=True)  # of the other core
    with OutputFile(path) as out:
        if form in TABLES:
            result = to_table(recording, out, form, choice)
        else:
            result = to_log(recording, out, form, choice.start_ns, choice.end_ns)
    content = path.read_bytes() if path.exists() else b""
    return result, content


def run(library: Any, seed: int, folder: Path) -> int:
    """Compare a random recording. Return the number of rows and frames."""
    chance = random.Random(seed)
    write = write_capture if chance.random() < 0.6 else write_bytes
    path = write(chance, folder / f"{seed}.kcap")
    if write is write_bytes:
        path = path.rename(path.with_suffix(".bin"))
    setattr(bytes_input, "CHUNK", chance.choice((7, 100, 5000, 1 << 18)))  # noqa: B010
    found = []
    part = {
        "start_ns": chance.choice((None, SECOND)),
        "end_ns": chance.choice((None, 3 * SECOND)),
    }
    fields = range(len(open_input(path).fields))
    chosen = chance.choice((fields, chance.sample(fields, 20)))
    for which in (None, library):
        with core(which):
            recording = open_input(path)
            played = all(isinstance(block, PlayedBlock) for block in recording.blocks())
            assert played is (which is not None)
            read_once = read(recording, chosen)
            files = []
            choice = Choice(chosen, **part)
            for form in TEXTS:
                files.append(converted(recording, choice, form, folder / f"{seed}.{form}"))
            recording.close()
        found.append([*read_once, files])
    for python, native in zip(*found, strict=True):
        assert python == native, _difference(python, native)
    return len(found[0][0]) + len(found[0][3])


def _difference(*sides: Any) -> str:
    if not all(isinstance(side, list) for side in sides):
        return f"{sides}"
    lengths = [len(side) for side in sides]
    for place, pair in enumerate(zip(*sides, strict=False)):
        if pair[0] != pair[1]:
            return f"{place} of {lengths}: {str(pair)[:3000]}"
    return f"{min(lengths)} of {lengths}"
