"""The three programs send the same frames for the same bytes: for the obvious one cantools packs them, so they hold what the ESC meant."""

import random
import tempfile

from bench_programs import running
from registry import Benchmark, Context, Figure, NotEqual

from kontronik_can_gw.esc.kontronik.codec import Layout, encode
from kontronik_can_gw.esc.kontronik.deframer import Deframer
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData, device_and_variant, rows
from kontronik_can_gw.esc.kontronik.states import Device


def random_live(chance: random.Random) -> LiveData:
    """Mostly values as they come, now and then any that the wire can carry, at its ends above all."""
    values = []
    for row in rows(LiveData).values():
        low, high = row.type_range
        kind = chance.random()
        if kind < 0.08:
            values.append(chance.choice([low, low + 1, low + 2, high, high - 1, high - 2]))
        else:
            values.append(
                chance.randint(low, high)
                if kind < 0.4
                else chance.randint(max(low, -100), min(high, 120))
            )
    return LiveData(*values)


def stream(frames: int, seed: int) -> bytes:
    """Live and info frames of both layouts and several devices, with noise, damage and gaps between them."""
    chance = random.Random(seed)
    found = bytearray()
    layout = Layout.V4
    for number in range(frames):
        if number % 25 == 20:
            layout = chance.choice(list(Layout))
        if number % 10 == 5:
            device = device_and_variant(chance.choice(list(Device)), chance.randrange(1024))
            found += encode(InfoData(device, 0x0411, cell_count=12), layout)
        frame = bytearray(encode(random_live(chance), layout))
        trouble = chance.random()
        if trouble < 0.06:  # a wrong bit in what the CRC covers
            frame[chance.randrange(4, 32)] ^= 1 << chance.randrange(8)
        elif trouble < 0.1:  # bytes lost
            del frame[chance.randrange(4, 20) : chance.randrange(20, 36)]
        elif trouble < 0.2:  # noise in front
            found += bytes(chance.choice(b"\0\x01\xfeOD") for _ in range(chance.randrange(1, 30)))
        found += frame
    return bytes(found)


def pieces(data: bytes) -> tuple[bytes, list[LiveData]]:
    """For the feeder: cut where frames end, so that each has at most one; and the live frames that are in there."""
    deframer = Deframer()
    found, lives = bytearray(), []
    begin = 0
    for at in range(len(data)):
        new = [
            frame.data
            for frame in deframer.feed(data[at : at + 1])
            if isinstance(frame.data, LiveData)
        ]
        if len(new) > 1:
            raise ValueError("two live frames at once: newest values would win")
        if new or at + 1 - begin == 100 or at + 1 == len(data):
            found += bytes([at + 1 - begin | (0x80 if new else 0)]) + data[begin : at + 1]
            begin = at + 1
        lives += new
    return bytes(found), lives


def sent_by(context: Context, program: str, cut: bytes) -> dict[int, list[str]]:
    """What a program sends for these pieces: data by id, in order."""
    with tempfile.NamedTemporaryFile(prefix="kontronik-bench-") as file:
        file.write(cut)
        file.flush()
        with running(context, program, 1, "--file", file.name) as (feeder, gateway):
            lines = feeder.rest(gateway)
    found: dict[int, list[str]] = {}
    for line in lines:
        number, _, data = line.partition(" ")
        found.setdefault(int(number, 16), []).append(data)
    return found


def first_difference(name: str, ours: dict[int, list[str]], theirs: dict[int, list[str]]) -> str:
    """In words; empty where there is none."""
    for number in sorted(ours.keys() | theirs.keys()):
        a, b = ours.get(number, []), theirs.get(number, [])
        for place, (x, y) in enumerate(zip(a, b, strict=False)):
            if x != y:
                return f"id {number:X}h, frame {place}: ours {x}, {name} {y}"
        if len(a) != len(b):
            return f"id {number:X}h: ours {len(a)} frames, {name} {len(b)}"
    return ""


def equal(context: Context) -> list[Figure]:
    """The same bytes to all three."""
    cut, lives = pieces(stream(80 if context.quick else 600, seed=1))
    ours = sent_by(context, "ours", cut)
    sent, meant = sum(map(len, ours.values())), 5 * (len(lives) + 2)
    if sent != meant:
        raise NotEqual(
            f"ours sent {sent} frames, not {meant}: for {len(lives)} live frames, the start and the loss"
        )
    figures = []
    for program in ("c", "obvious"):
        theirs = sent_by(context, program, cut)
        if text := first_difference(program, ours, theirs):
            raise NotEqual(text)
        figures.append(Figure(f"frames as {program} sends them", sent, "frames", "all", True))
    return figures


BENCHMARKS = [
    Benchmark(
        "equal", "C, ours and the obvious program send the same frames for the same bytes", equal
    )
]
