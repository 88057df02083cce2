"""The three programs by turns: that they send the same frames, the CPU time each takes for a live frame, and the delay."""

import os
import random
import sys
import tempfile
from dataclasses import asdict

from programs import PROGRAMS, Measured, median, once, running
from registry import Context, Figure, LeftOut, NotEqual, benchmark, judged

from kontronik_can_gw.esc.kontronik.codec import Layout, encode
from kontronik_can_gw.esc.kontronik.deframer import Deframer
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData, device_and_variant, rows
from kontronik_can_gw.esc.kontronik.states import Device

CANOPEN = '[canopen]\nenabled = true\nself_start = true\nstore = "store"\n'


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


@benchmark("equal", "C, ours and the obvious program send the same frames for the same bytes")
def equal(context: Context) -> list[Figure]:
    """For the obvious one cantools packs them, so they hold what the ESC meant."""
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


# --- CPU time


def compare(context: Context, escs: int, *options: str) -> dict[str, list[Measured]]:
    """Rounds of the three programs by turns, so that what disturbs the machine disturbs all."""
    found: dict[str, list[Measured]] = {program: [] for program in PROGRAMS}
    for _ in range(context.rounds):
        for program, runs in found.items():
            runs.append(once(context, program, escs, *options))
    name = " ".join([str(escs), *options])
    context.data[name] = {program: [asdict(run) for run in runs] for program, runs in found.items()}
    return found


def cpu_of(runs: list[Measured]) -> float:
    """Median of the rounds."""
    if not all(run.cpu_us for run in runs):
        raise LeftOut(
            "this kernel counts CPU time by ticks (User Mode Linux): too coarse to compare. Use a real one"
        )
    return median([run.cpu_us for run in runs])


def lost_share(runs: list[Measured]) -> float:
    return median([run.lost_share for run in runs])


def losses(runs: list[Measured]) -> str:
    """In words, where they are worth a word."""
    return f"{lost_share(runs):.1%} of its CAN frames lost" if lost_share(runs) >= 0.001 else ""


def ratio(above: list[Measured], below: list[Measured]) -> float:
    """Median of the ratios of the rounds."""
    return median([a.cpu_us / b.cpu_us for a, b in zip(above, below, strict=True)])


def beside(context: Context, escs: int, most: str, least: str, *options: str) -> list[Figure]:
    """The three programs, and ours beside the two others. What is not sent costs nothing: with losses no target is reached."""
    found = compare(context, escs, *options)
    what = ", ".join([f"{escs} ESC", *options])
    figures = [
        Figure(f"{program}, {what}", cpu_of(runs), "us/frame", note=losses(runs))
        for program, runs in found.items()
    ]
    ours, fair = found["ours"], lost_share(found["ours"]) < 0.01
    for name, value, target in (
        ("ours / c", ratio(ours, found["c"]), most),
        ("obvious / ours", ratio(found["obvious"], ours), least),
    ):
        title = f"{name}, {what}"
        figures.append(
            judged(title, value, "x", target, fair=fair) if target else Figure(title, value, "x")
        )
    return figures


@benchmark("cpu", "CPU time a live frame at 1, 8 and 64 ESCs: C, ours, the obvious program")
def cpu(context: Context) -> list[Figure]:
    """The table of the three programs."""
    figures = beside(context, 1, "<= 1.35", ">= 6")
    if context.quick:
        return figures
    return figures + beside(context, 8, "<= 1.25", ">= 6") + beside(context, 64, "<= 1.2", "")


@benchmark("cpu-canopen", "CPU time with CANopen nodes and default PDOs, beside that without")
def canopen(context: Context) -> list[Figure]:
    """Ours at 8 ESCs with nodes and default PDOs, and without, by turns."""
    plain, both = [], []
    for _ in range(context.rounds):
        plain.append(once(context, "ours", 8))
        both.append(once(context, "ours", 8, config=CANOPEN))
    frames = median([run.result["others"] / run.sent for run in both])
    if not frames:
        raise RuntimeError("the CANopen nodes sent nothing")
    return [
        Figure(
            "ours, 8 ESC, CANopen too",
            cpu_of(both),
            "us/frame",
            note=f"{frames:.1f} CANopen frames a live frame",
        ),
        judged("with / without CANopen", ratio(both, plain), "x", "<= 1.25"),
    ]


def pinned(command: list[str]) -> list[str]:
    """The command on one core; the last, where the feeder need not be."""
    core = max(os.sched_getaffinity(0))
    text = f"import os, sys; os.sched_setaffinity(0, [{core}]); os.execv(sys.argv[1], sys.argv[1:])"
    return [sys.executable, "-c", text, *command]


@benchmark("many", "128 ESCs in one process; 15 000 CAN frames a second on one core: none lost")
def many(context: Context) -> list[Figure]:
    """128 ESCs in one process, and two buses' worth (15 000 CAN frames a second by 30 ESCs) on one core.

    A frame that is replaced by the next one, because the process had to wait, counts as lost.
    """
    figures = []
    for escs, where in ((4, list), (2, pinned)) if context.quick else ((128, list), (30, pinned)):
        run = once(context, "ours", escs, wrap=where)
        what = f"{escs} ESCs" + (" on one core" if where is pinned else "")
        note = f"delay, 99 %: {run.delay['p99']} us, longest {run.delay['max']:.0f}"
        figures += [
            Figure(
                f"{what}: CAN frames lost", run.lost, f"of {5 * run.sent}", "0", run.lost == 0, note
            ),
            Figure(f"{what}: share of a core", run.cpu_share * 100, "%"),
        ]
    return figures


# --- delay


def of_runs(runs: list[Measured], key: str) -> float:
    """A figure of the delay, the median of the rounds."""
    return median([run.delay[key] for run in runs])


@benchmark("delay", "from the last byte to the fifth CAN frame: C, ours, the obvious program")
def delay(context: Context) -> list[Figure]:
    """One ESC, the three programs by turns."""
    found = compare(context, 1)
    figures = []
    for program, runs in found.items():
        note = f"99 %: {of_runs(runs, 'p99'):.0f}, longest {of_runs(runs, 'max'):.0f}"
        figures.append(Figure(f"{program}, median", of_runs(runs, "p50"), "us", note=note))
    value = median(
        [a.delay["p50"] / b.delay["p50"] for a, b in zip(found["ours"], found["c"], strict=True)]
    )
    figures.append(judged("ours / c, median", value, "x", "<= 1.1"))
    figures.append(judged("ours, 99 %", of_runs(found["ours"], "p99"), "us", "<= 2000"))
    return figures


EVERYTHING = f"""{CANOPEN}[record]
directory = "captures"
[statistics]
file = "status.json"
"""
"""Recorder, status file, nodes."""


@benchmark("delay-full", "the same with 8 ESCs, recorder, statistics, CANopen and a polling master")
def full(context: Context) -> list[Figure]:
    """8 ESCs with recorder, status file, CANopen nodes and a master that asks 200 times a second for one of 20 objects."""
    runs = [once(context, "ours", 8, "--sdo", config=EVERYTHING) for _ in range(context.rounds)]
    context.data["runs"] = [run.result for run in runs]
    asked = sum(run.result["sdo_sent"] for run in runs)
    answered = sum(run.result["sdo_answers"] for run in runs)
    lost = max(0, asked - answered - len(runs))  # the last of each run may be on its way
    answer = median([run.result["sdo_us"]["p99"] for run in runs])
    if not answered:
        raise RuntimeError("the nodes answered no SDO request")
    longest = f"longest {of_runs(runs, 'max'):.0f}"
    return [
        Figure("8 ESCs and all, median", of_runs(runs, "p50"), "us"),
        judged("8 ESCs and all, 99 %", of_runs(runs, "p99"), "us", "<= 1000", longest),
        Figure("SDO answers, 99 %", answer, "us"),
        Figure("SDO requests not answered", lost, f"of {asked}", "0", lost == 0),
        Figure(
            "CPU, all of it", median([run.cpu_us for run in runs]), "us/frame", note=losses(runs)
        ),
    ]
