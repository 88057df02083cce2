"""CPU time of converting captures and UART bytes to candump logs and tables.

The start of the program is not included. The bytes are a simulated flight of four minutes, which is
repeated.
"""

import random
import time
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

from programs import FIVE, Context, Figure, median, say

FLIGHT_S = 240
SEED = 6
_MB = 1_000_000


@cache
def flight() -> bytes:
    """Return the bytes of a flight, about 1 MB."""
    from kontronik_can_gw.esc.kontronik.simulator import EscOptions, SimulatedEsc

    say("a flight is simulated")
    sent = SimulatedEsc(EscOptions(), seed=SEED).frames_until(FLIGHT_S * 1_000_000_000)
    return b"".join(one.wire for one in sent)


class Run(NamedTuple):
    """The CPU time of a conversion, and a text with the numbers of rows or frames written."""

    cpu_s: float
    written: str

    @property
    def rows_per_s(self) -> float:
        """Rows or frames per second of CPU time."""
        return int(self.written.split()[0]) / self.cpu_s


def convert(
    context: Context,
    form: str,
    source: Path,
    live: bool = False,
    dbc: Path | None = None,
) -> Run:
    """Convert a recording. With ``live``, only the 16 values of live data are converted."""
    from kontronik_can_gw.desk.recordings.convert import TABLES, OutputFile, to_log, to_table
    from kontronik_can_gw.desk.recordings.fields import Choice
    from kontronik_can_gw.desk.recordings.inputs import open_input
    from kontronik_can_gw.desk.recordings.layouts import layout_of_dbc
    from kontronik_can_gw.esc.kontronik.fields import LiveData

    if form == "parquet":
        import pyarrow.parquet  # type: ignore[import-untyped]

        pyarrow.array([0])  # imports pandas if it is installed
    suffix = "log" if form == "candump" else form
    target = context.folder / f"converted.{suffix}"
    layout = None if dbc is None else layout_of_dbc(dbc)
    with open_input(source, layout) as recording:
        convert_all = partial(to_log, form=form)
        if form in TABLES:
            choice = Choice.of(recording.fields, LiveData._fields if live else ())
            convert_all = partial(to_table, form=form, choice=choice)
        begun = time.process_time()
        with OutputFile(target) as out:
            written = convert_all(recording, out)
        return Run(time.process_time() - begun, str(written))


def capture(context: Context, seconds: int, noise: bool = False) -> Path:
    """Write a capture of one ESC as a recorder does, with an iteration for each UART frame.

    With ``noise``, 5 % of the frames are damaged.
    """
    from kontronik_can_gw.assembly.assemble import assemble
    from kontronik_can_gw.capture.format import EntryKind, block, data_payload, json_payload
    from kontronik_can_gw.cli.recording import setup_of
    from kontronik_can_gw.config.parse import parse

    name = "noise" if noise else "capture"
    file = context.folder / f"{name}-{seconds}.kcap"
    if file.exists():
        return file
    chance = random.Random(SEED)
    period = 10_000_000
    start = 1_000_000_000
    setup = setup_of(assemble(parse({"esc": [{"port": "/dev/ttyUSB0"}]}, "bench.toml")))
    header = setup.header() | {"created_ns": start, "monotonic_ns": start, "wall_ns": start << 30}
    frames = [b"KOD" + frame for frame in flight().split(b"KOD")[1:]]
    first = [
        (start, EntryKind.PORT_OPENED, 0, b"", 0, None),
        (start, EntryKind.START, 0, b"", 1, None),
    ]
    blocks = [(b"H", json_payload(header)), (b"D", data_payload(first))]
    for begin in range(0, 100 * seconds, 50):
        entries: list[tuple[int, int, int, bytes, int, int | None]] = []
        for number in range(begin, begin + 50):
            now = start + number * period
            wire = frames[number % len(frames)]
            if noise and chance.random() < 0.05:
                at = chance.randrange(len(wire))
                wrong = bytes([wire[at] ^ 0x55])
                wire = wire[:at] + wrong + wire[at + 1 :] + chance.randbytes(3)
            entries.append((now, EntryKind.BYTES, 0, wire, 0, now - 4_000_000))
            entries.append((now, EntryKind.ADVANCE, 0, b"", 0, None))
        blocks.append((b"D", data_payload(entries)))
    blocks.append((b"E", b""))
    with file.open("wb") as out:
        for number, (kind, payload) in enumerate(blocks):
            out.write(block(kind, number, payload))
    return file


def captures(context: Context) -> list[Figure]:
    """An hour's capture of one ESC, and the same with noise."""
    figures = []
    seconds = 60 if context.quick else 3600
    clean = capture(context, seconds)
    noisy = capture(context, seconds, noise=True)
    for name, form, live, least in (
        ("candump", "candump", False, ""),
        ("parquet, 16 values", "parquet", True, ">= 400000"),
        ("parquet, all values", "parquet", False, ">= 120000"),
    ):
        plain = []
        noise_ratios = []
        for _ in range(context.rounds):
            without = convert(context, form, clean, live)
            with_noise = convert(context, form, noisy, live)
            plain.append(without)
            noise_ratios.append(with_noise.cpu_s / without.cpu_s)
        spent = median([run.cpu_s for run in plain]) * 3600 / seconds
        figures.append(Figure(f"{name}, an hour", spent, "s", "<= 2", plain[0].written))
        noise = median(noise_ratios)
        figures.append(Figure(f"{name}, with noise / without", noise, "x", "<= 1.5"))
        rows = median([run.rows_per_s for run in plain])
        figures.append(Figure(f"{name}, rows", rows, "rows/s", least))
    return figures


def can_logs(context: Context) -> list[Figure]:
    """An hour's candump log of one ESC as a table and as a page, compared with its capture."""
    seconds = 60 if context.quick else 3600
    source = capture(context, seconds)
    log = context.folder / f"log-{seconds}.log"
    convert(context, "candump", source)
    (context.folder / "converted.log").replace(log)
    hours = seconds / 3600
    tables = [convert(context, "csv", log) for _ in range(context.rounds)]
    spent = median([one.cpu_s for one in tables]) / hours
    pages = [(report(log), report(source)) for _ in range(context.rounds)]
    page = median([of_log for of_log, _ in pages]) / hours
    ratio = median([of_log / of_capture for of_log, of_capture in pages])
    return [
        Figure("candump log to csv, an hour", spent, "s", "<= 8", tables[0].written),
        Figure("page of a candump log, an hour", page, "s", "<= 5"),
        Figure("page of a candump log / of its capture", ratio, "x", "<= 4"),
    ]


def report(source: Path) -> float:
    """CPU seconds for the page of a recording."""
    from kontronik_can_gw.desk.recordings.inputs import open_input
    from kontronik_can_gw.desk.report.flight import Flight, needed_columns
    from kontronik_can_gw.desk.report.page import render

    begun = time.process_time()
    with open_input(source) as recording:
        chosen = needed_columns(recording.fields)
        flight = Flight(recording.bus.escs, [recording.fields[index] for index in chosen])
        for block in recording.blocks(chosen):
            flight.evaluate(block)
        render(flight.finish(), source=source.name, damage=recording.damage)
    return time.process_time() - begun


def plain_bytes(context: Context) -> list[Figure]:
    """MB of UART bytes for a CPU second: the deframer alone, and conversions.

    The fastest of the rounds counts.
    """
    source = context.folder / "bytes.bin"
    wanted = (1 if context.quick else 20) * _MB
    source.write_bytes(flight() * (wanted // len(flight()) + 1))
    size = source.stat().st_size / _MB
    fastest = min(scan(source) for _ in range(7))
    figures = [Figure("scan", size / fastest, "MB/s", ">= 900")]
    for form, live, dbc, aim in (
        ("candump", False, FIVE, ">= 80"),
        ("parquet", True, None, ">= 70"),
        ("csv", True, None, ">= 30"),
    ):
        run = min(convert(context, form, source, live, dbc) for _ in range(context.rounds))
        figures.append(Figure(f"{form}, bytes", size / run.cpu_s, "MB/s", aim, run.written))
    return figures


def scan(source: Path) -> float:
    """Return the CPU seconds that the core in C needs to find all frames."""
    from kontronik_can_gw.core.settings import CoreSettings
    from kontronik_can_gw.esc.telemetry import EscSettings
    from kontronik_can_gw.native.binding import load
    from kontronik_can_gw.native.core import NativeCore
    from kontronik_can_gw.native.objects import shared_object
    from kontronik_can_gw.signals.plan import MessageLayout

    data = source.read_bytes()
    escs = [EscSettings("esc1")]
    empty = MessageLayout("", "", ())
    core = NativeCore(load(shared_object()), CoreSettings(escs, empty), 0)
    core.state.mask = 0  # no events
    begun = time.process_time()
    for at in range(0, len(data), 16384):
        core.receive(0, data[at : at + 16384], 0, 0)
    return time.process_time() - begun
