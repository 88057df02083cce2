"""The three programs send the same frames for the same bytes, and these hold what the ESC meant."""

import random
import tempfile
from collections.abc import Sequence
from typing import Any

from bench_programs import FIVE, PROGRAMS, Feeder, Gateway
from registry import Benchmark, Context, Figure, LeftOut, NotEqual

from kontronik_can_gw.lean import without_asammdf
from kontronik_can_gw.protocol.codec import Layout, encode
from kontronik_can_gw.protocol.deframer import Deframer
from kontronik_can_gw.protocol.fields import InfoData, LiveData, device_and_variant, rows
from kontronik_can_gw.protocol.states import Device

FIRST_ID = 272
_SOURCES = {
    "PwmInput": "pwm_input",
    "ThrottlePercent": "throttle",
    "OutputOpeningPercent": "output_opening",
    "OperatingStateRaw": "operating_state",
}
"""Signals whose names are not the fields' in other letters."""


def random_live(chance: random.Random) -> LiveData:
    """Mostly values as they come, now and then any that the wire can carry, at its ends above all."""
    values = []
    for row in rows(LiveData).values():
        low, high = row.type_range
        kind = chance.random()
        if kind < 0.08:
            values.append(chance.choice([low, low + 1, low + 2, high, high - 1, high - 2]))
        else:
            values.append(chance.randint(low, high) if kind < 0.4 else chance.randint(max(low, -100), min(high, 120)))
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
        new = [frame.data for frame in deframer.feed(data[at : at + 1]) if isinstance(frame.data, LiveData)]
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
        feeder = Feeder(context, 1, "--file", file.name)
        try:
            gateway = Gateway(context, program, feeder)
            try:
                lines = feeder.rest(gateway)
            finally:
                gateway.close()
        finally:
            feeder.close()
    found: dict[int, list[str]] = {}
    for line in lines:
        number, _, data = line.partition(" ")
        found.setdefault(int(number, 16), []).append(data)
    return found


def check_values(frames: dict[int, list[str]], lives: Sequence[LiveData]) -> int:
    """Decoded by cantools the frames hold the physical values that were on the wire. Returns how many values were compared.

    What a signal has no room for has to be Error; the BEC current, which depends on the device, may be NotAvailable.
    """
    with without_asammdf():
        import cantools

    database: Any = cantools.database.load_file(FIVE)
    compared = 0
    for message in database.messages:
        datas = frames[message.frame_id]
        if len(datas) != len(lives) + 2:
            raise NotEqual(f"{message.name}: {len(datas)} frames for {len(lives)} live frames, a start and a loss")
        for number, (data, live) in enumerate(zip(datas[1:-1], lives, strict=True)):
            decoded = message.decode(bytes.fromhex(data))
            for signal in message.signals:
                field = _SOURCES.get(signal.name) or "".join(
                    f"_{c.lower()}" if c.isupper() else c for c in signal.name
                ).removeprefix("_")
                meant = rows(LiveData)[field].physical(getattr(live, field))
                got = decoded[signal.name]
                compared += 1
                if str(got) == "NotAvailable" and field == "bec_current":
                    continue
                fits = signal.minimum <= meant <= signal.maximum
                if (str(got) != "Error") if not fits else (isinstance(got, str) or abs(got - meant) > 1e-9):
                    raise NotEqual(f"{signal.name} of live frame {number}: {got}, on the wire {meant}")
    return compared


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
    values = check_values(ours, lives)
    figures = [Figure("values as on the wire", values, "values", "all", True)]
    for program in PROGRAMS:
        if program == "ours":
            continue
        try:
            theirs = sent_by(context, program, cut)
        except LeftOut as reason:
            context.say(f"{program} left out: {reason}")
            continue
        if text := first_difference(program, ours, theirs):
            raise NotEqual(text)
        figures.append(Figure(f"frames as {program} sends them", sum(map(len, ours.values())), "frames", "all", True))
    context.data["live_frames"] = len(lives)
    return figures


BENCHMARKS = [Benchmark("equal", "C, ours and the obvious program send the same frames for the same bytes", equal)]
