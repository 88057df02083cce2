"""The stated worst case of the core on a Thumb-2 processor, for the shipped DBC.

The machine code gives the cost of each straight piece (longest_path.py). This file adds the limits
of the loops, which follow from core.c and from the size of the plan.
"""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from built import there
from every_value import export_shipped
from longest_path import Costs, read_functions

from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.desk.recordings.layouts import layout_of_dbc
from kontronik_can_gw.native.header import KCG
from kontronik_can_gw.native.tables import Tables

HERE = Path(__file__).parent
COMPILER = "arm-none-eabi-gcc"
OPTIONS = (
    *("-std=gnu99", "-mcpu=cortex-m4", "-mthumb", "-Os", "-g", "-nostdlib"),
    *("-fno-jump-tables", "-fno-tree-loop-distribute-patterns"),
    *("-Wl,-Ttext=0x10000", "-Wl,-Tdata=0x20000000", "-Wl,-e,start"),
)
CALLS = ("receive", "advance", "take", "sent", "other")
MOST_BYTES = 256
SHORTEST = 38
LONGEST = 44
HELD = LONGEST - 1
HEADER = 4
STORED = 2
"""KCG_FOUND of the exported core."""
LONGEST_CRCS = 40 + 34 + 4
"""Passes of the CRC's loop for one header: both forms, the longer CRC, the ends of the loops."""


def build_image(folder: Path) -> Path:
    """Compile the exported core for a Cortex-M4."""
    export_shipped(folder)
    sources = ["core.c", "tables.c", str(HERE / "cortex_m_image.c")]
    command = [COMPILER, *OPTIONS, "-I.", *sources, "-lgcc", "-o", "image.elf"]
    subprocess.run(command, cwd=folder, check=True)
    return folder / "image.elf"


@dataclass(frozen=True)
class Plan:
    """Sizes of a plan on which the limits depend."""

    messages: int
    pages: int
    escs: int
    listeners: int
    """The most messages that follow events of an ESC."""
    of_the_gateway: int
    """Messages with values of the gateway."""
    signals: int
    pairs: int
    """Entries of the tables of all signals."""
    pieces: int
    """The most pieces of a signal."""
    on_change: int
    """Signals of the messages that are compared with their last frame when they are sent."""
    news: int
    """Signals of the messages that are compared with their last frame when they are requested."""
    divisions: int
    """The most divisions that packing all signals needs."""
    news_divisions: int
    """The same for the signals of `news`."""


def plan_of(dbc: Path) -> Plan:
    bus = layout_of_dbc(dbc)
    tables = Tables(CoreSettings(bus.escs, bus.layout))
    on_change = [row for row in tables.messages if row.flags & KCG.ON_CHANGE]
    news = [row for row in on_change if not row.flags & KCG.EVENT]
    news_signals = [
        tables.signals[number]
        for row in news
        for number in range(row.first_signal, row.first_signal + row.signals)
    ]
    return Plan(
        messages=len(tables.messages),
        pages=sum(row.pages for row in tables.messages),
        escs=len(bus.escs),
        listeners=max(map(len, tables.listeners_of)),
        of_the_gateway=sum(bool(row.flags & KCG.OF_THE_GATEWAY) for row in tables.messages),
        signals=len(tables.signals),
        pairs=sum(row.pairs for row in tables.signals),
        pieces=max(row.pieces for row in tables.signals),
        on_change=sum(row.signals + 1 for row in on_change),
        news=sum(row.signals + 1 for row in news),
        divisions=sum(map(divisions_of, tables.signals)),
        news_divisions=sum(map(divisions_of, news_signals)),
    )


def divisions_of(row: Any) -> int:
    """Return the most 64-bit divisions that the raw value of a signal needs."""
    if row.kind == KCG.OF_ALIVE:
        return 1
    of_time = 2 * (row.kind in (KCG.OF_AGE, KCG.OF_UPTIME))
    scaled = 2 * (not row.flags & (KCG.PLAIN | KCG.TABLE))
    return of_time + scaled + bool(row.flags & KCG.ROLLS)


SHARED_CALLS = {
    (caller, called): "division"
    for caller in ("pack", "value_of")
    for called in ("__aeabi_ldivmod", "__aeabi_uldivmod")
}
SHARED_CALLS["kcg_next_event", "report"] = "report"  # the state of the link
SHARED_CALLS["kcg_gateway_changed", "request"] = "gateway"
SHARED = {
    "for (; n; p++, n--) {": "crc",
    "for (size_t i = from; i < to; i++) {": "drop",
    "if (p[k] == (uint8_t)byte)": "memchr",
    "while (from < size) {": "header_at",
    "at += HEADER_SIZE;": "scan",
    "for (; s < end; s++) {": "pack",
    "if (accept_next(g))": "accept",
    "accept_next(g);": "accept",
    "g->pending[at] = (uint16_t)i;": "sort",
    "p++;": "pair",
}


def limits_of(plan: Plan) -> dict[str, int]:
    """Return how often each other loop repeats at most."""
    depth = plan.messages.bit_length()
    return {
        # bytes in string.h; kcg_init, which runs once, is not counted
        "for (size_t k = 0; k < size; k++) /* bytes of memcpy */": LONGEST,
        "for (size_t k = 0; k < size; k++) /* bytes of memmove, upwards */": 8 * HELD,
        "for (size_t k = size; k > 0; k--) /* bytes of memmove, downwards */": 8 * HELD,
        "for (size_t k = 0; k < size; k++) /* bytes of memset */": 16,
        "for (size_t k = 0; k < size; k++) /* bytes of memcmp */": 8,
        # words of copies that the compiler writes itself
        "memcpy(e->info, body, KCG_INFO_SIZE);": 8,
        "memcpy(e->live, f->body, KCG_LIVE_SIZE);": 8,
        "memcpy(old, new, sizeof new);": 4,
        # the deframer
        "for (; form < NO_FORM; form++) {": 2,
        "decided++;": HELD,
        # values
        "} while (++p < last);": plan.pieces,
        # deadlines: the depth of the heap
        "at = (at - 1) / 2;": depth,
        "for (;;) {": depth,
        # messages
        "for (uint32_t i = 0; i < g->plan->messages; i++) {": plan.messages,
        "for (uint32_t i = 0; i < g->plan->messages; i++)": plan.messages,
        "for (uint32_t k = 0; k < g->pendings; k++)": plan.messages,
        "for (uint32_t k = 0; k < g->plan->pages; k++)": plan.pages,
        "for (int k = plan->first_listener[esc]; k < plan->first_listener[esc + 1]; k++) {": (
            plan.listeners
        ),
        "for (int i = 0; i < g->plan->escs; i++)": plan.escs,
        "for (int i = 0; i < g->plan->escs; i++) {": plan.escs,
        "for (uint32_t k = 0; k < m->escs; k++)": plan.escs,
        "mark(g, i, when, CYCLE);": 2 * plan.messages,  # a cycle and a minimum delay time of each
        "gap = 2 * gap + 1;": depth,
        "for (uint32_t k = gap; k < size; k++) {": plan.messages,
        "for (; k < g->pendings && g->taken < max; k++) {": plan.messages,
        "if (!(m->flags & KCG_FREE)) {": plan.messages,  # kcg_sent
    }


def _sort_passes(size: int) -> int:
    """Return the most passes of the inner loop of a Shell sort with gaps of 2^k - 1."""
    gap = 1
    while gap < size:
        gap = 2 * gap + 1
    passes = 0
    while gap := gap // 2:
        passes += sum(place // gap + 1 for place in range(gap, size))
    return passes


class Limits:
    """The most instructions of each kind of call."""

    def __init__(self, image: Path, plan: Plan) -> None:
        sys.setrecursionlimit(10_000)
        self.costs = Costs(read_functions(image), limits_of(plan), SHARED, SHARED_CALLS)
        self.plan = plan
        self._own = {name: self.costs.of(name) for name in CALLS}
        unused = {*self.costs.limits, *SHARED} - self.costs.used
        assert not unused, f"no loop has this source text: {sorted(unused)}"

    def _sum(self, own: int, packs: int = 0, reports: int = 0, **passes: int) -> int:
        """Add the passes of the shared loops.

        packs: how often all signals are packed. reports: how often events request messages, which
        includes kcg_gateway_changed once for each.
        """
        plan = self.plan
        passes["pack"] = passes.get("pack", 0) + reports * plan.news
        passes["division"] = packs * plan.divisions + reports * plan.news_divisions
        passes["pair"] = (packs + reports) * (plan.pairs + plan.signals)
        passes["gateway"] = reports * plan.of_the_gateway
        return own + sum(count * self.costs.passes[name] for name, count in passes.items())

    def receive(self, size: int, most_frames: int = MOST_BYTES) -> int:
        """Return the limit of kcg_receive with so many bytes, with at most so many frames."""
        scans = [HELD + min(size, LONGEST), max(0, size - 1)]
        if size <= LONGEST:
            scans.pop()
        scanned = sum(scans)
        frames = min(most_frames, (HELD + size) // SHORTEST)
        headers = sum(max(0, bytes_ - SHORTEST) // HEADER + 1 for bytes_ in scans)
        turns = sum(bytes_ // (HEADER - 1) + 2 for bytes_ in scans)
        return self._sum(
            self._own["receive"],
            scan=turns,
            crc=headers * LONGEST_CRCS,
            drop=scanned + 2 * turns,
            memchr=scanned + 2 * turns,
            header_at=scanned + turns,
            accept=frames + 2,
            report=1,
            # expired values of each ESC, each frame, the state of the link, the gateway's second
            reports=self.plan.escs + frames + 2,
        )

    def advance(self) -> int:
        # expired values of each ESC, the gateway's second, the beginning and the end of quiet mode
        reports = self.plan.escs + 3
        return self._sum(self._own["advance"], accept=1, report=1, reports=reports)

    def take(self) -> int:
        """Return the limit of kcg_take with all messages."""
        packed = self.plan.signals + self.plan.messages + self.plan.news
        return self._sum(
            self._own["take"], packs=2, pack=packed, sort=_sort_passes(self.plan.messages)
        )

    def sent(self) -> int:
        return self._sum(self._own["sent"], packs=1, pack=self.plan.on_change)

    def other(self) -> int:
        """Return the limit of all other calls, except kcg_init."""
        scan = HELD
        turns = scan // (HEADER - 1) + 2
        return self._sum(
            self._own["other"],
            scan=turns,
            crc=(max(0, scan - SHORTEST) // HEADER + 1) * LONGEST_CRCS,
            drop=scan + 2 * turns,
            memchr=scan + 2 * turns,
            header_at=scan + turns,
            accept=STORED + 1,
            report=1,
            # expired values of each ESC, each stored frame, the state of the link, the gateway's
            # second
            reports=self.plan.escs + STORED + 2,
        )

    def stated(self) -> dict[str, int]:
        """Return the numbers of the table in docs/firmware.md, by its first column."""
        half = MOST_BYTES // 2
        byte = -((self.receive(half, 0) - self.receive(MOST_BYTES, 0)) // half)
        frame = self.receive(SHORTEST, 1) - self.receive(SHORTEST, 0)
        call = max(
            self.receive(size, frames) - size * byte - frames * frame
            for size in range(MOST_BYTES + 1)
            for frames in range((size + HELD) // SHORTEST + 1)
        )
        return {
            "`kcg_receive`: each call": call,
            "`kcg_receive`: each byte": byte,
            "`kcg_receive`: each UART frame that ends in it": frame,
            "`kcg_receive` of one byte": self.receive(1),
            "`kcg_receive` of 256 bytes": self.receive(MOST_BYTES),
            "`kcg_advance`": self.advance(),
            "`kcg_take` of all messages": self.take(),
            "`kcg_sent` of all messages": self.sent(),
            "each other call, except `kcg_init`": self.other(),
        }

    def lines(self) -> list[str]:
        """Return the limits as count_instructions.c reads them."""
        rows = [f"ONE_BYTE 1 {self.receive(1)}"]
        rows += [f"BYTES {size} {self.receive(size)}" for size in range(MOST_BYTES + 1)]
        others = {
            "ADVANCE": self.advance(),
            "TAKE": self.take(),
            "SENT": self.sent(),
            "OTHER": self.other(),
        }
        return rows + [f"{name} 0 {limit}" for name, limit in others.items()]


def search(folder: Path, limits: Limits, calls: int, seed: int = 1) -> str:
    """Make so many calls. Return what the program prints. AssertionError above a limit."""
    image = folder / "image.elf"
    subprocess.run(
        [COMPILER.replace("gcc", "objcopy"), "-O", "binary", str(image), str(folder / "image.bin")],
        check=True,
    )
    names = subprocess.run(
        [COMPILER.replace("gcc", "nm"), str(image)],
        capture_output=True,
        text=True,
        check=True,
    )
    rows = [line.split() for line in names.stdout.splitlines()]
    lines = [f"{name} 0 {int(address, 16)}" for address, _, name in rows]
    (folder / "limits.txt").write_text("\n".join([*lines, *limits.lines(), ""]))
    import unicorn

    package = Path(unicorn.__file__).parent
    library = package / "lib" / "libunicorn.so.2"
    program = folder / "count_instructions"
    command = [there(), "-std=gnu99", "-O2", "-I", str(package / "include")]
    command += [str(HERE / "count_instructions.c"), str(library), f"-Wl,-rpath,{library.parent}"]
    subprocess.run([*command, "-o", str(program)], check=True)
    words = [str(program), "image.bin", "limits.txt", str(calls), str(seed)]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
