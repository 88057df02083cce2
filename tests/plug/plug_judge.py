"""Judges the files of a gateway after a power loss."""

import json
from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from kontronik_can_gw.canopen.storage import decode
from kontronik_can_gw.capture.format import SUFFIX, Block, Scanner, read_entries
from kontronik_can_gw.config.keys import RecordConfig
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.runtime.files.recorder import Recorder
from kontronik_can_gw.runtime.files.store import ParameterStore
from kontronik_can_gw.runtime.status.snapshot import PROGRAM
from kontronik_can_gw.times import SECOND

MAX_LOSS_NS = SECOND
"""Input that a power loss may cost."""
NODE = "esc1"
TIMEOUT = 0x210004
HEARTBEAT = 0x101700
LOWEST = 200
"""Value of both objects in set 0. In set N of the parameters both are N higher."""
_CHUNK = 1 << 20


class Capture(NamedTuple):
    """A capture as the gateway wrote it. It begins and ends with the first and the last entry."""

    blocks: list[tuple[bytes, bytes]]
    """Kind and payload."""
    times: list[int]
    """Time of the last entry up to each block. Before the first entry, its time."""


@dataclass
class Verdict:
    """The result for one state."""

    problems: list[str] = field(default_factory=list)
    blocks: dict[str, int] = field(default_factory=dict)
    """Number of intact blocks from the beginning of each capture."""
    loss_ns: int = 0
    """Longest time of input before the power loss that is missing."""
    found: int = 0
    """Number of the stored set. 0 without stored parameters."""


def read_blocks(file: Path) -> list[Block]:
    """Return the intact blocks up to the first error of the file system."""
    scanner = Scanner()
    blocks = []
    try:
        with file.open("rb", buffering=0) as stream:
            while data := stream.read(_CHUNK):
                blocks += scanner.feed(data)
    except OSError:
        pass
    blocks += scanner.flush()
    return [each for each in blocks if isinstance(each, Block)]


def capture_of(blocks: list[Block]) -> Capture:
    """Return a whole capture for comparison. ValueError if a block is missing."""
    if [each.number for each in blocks] != list(range(len(blocks))):
        raise ValueError("a block is missing")
    times: list[int] = []
    last = 0
    for each in blocks:
        if each.kind == b"D":
            entries = list(read_entries(each.payload))
            if not last:
                times = [entries[0].time_ns] * len(times)
            last = entries[-1].time_ns
        times.append(last)
    return Capture([(each.kind, each.payload) for each in blocks], times)


def judge_captures(
    verdict: Verdict,
    folder: Path,
    written: Mapping[str, Capture],
    cut_ns: int,
    flushed: Mapping[str, int] | None,
) -> None:
    """Judge all captures. ``flushed`` is the number of blocks of each that had been flushed.

    Power was lost at ``cut_ns``. No capture may have a block that was not written. If ``flushed``
    is None, any number of blocks may be missing at the end.
    """
    for name, capture in written.items():
        blocks = read_blocks(folder / name)
        intact = 0
        for each in blocks:
            is_known = each.number < len(capture.blocks)
            if not is_known or capture.blocks[each.number] != (each.kind, each.payload):
                verdict.problems.append(f"{name}: block {each.number} was never written")
            elif each.number == intact:
                intact += 1
        verdict.blocks[name] = intact
        if flushed is None:
            continue
        if intact < flushed.get(name, 0):
            text = f"{name}: {intact} blocks are readable, but {flushed[name]} were flushed"
            verdict.problems.append(text)
        if cut_ns > capture.times[0]:
            has = capture.times[max(0, intact - 1)]
            loss_ns = min(cut_ns, capture.times[-1]) - has
            verdict.loss_ns = max(verdict.loss_ns, loss_ns)
            if loss_ns > MAX_LOSS_NS:
                verdict.problems.append(f"{name}: {loss_ns / SECOND:.2f} s of input are lost")


def judge_parameters(verdict: Verdict, folder: Path, allowed: Container[int]) -> None:
    """Judge the stored parameters by the gateway's own code."""
    store = ParameterStore(folder)
    try:
        if problem := store.lock(NODE):
            verdict.problems.append(f"parameters: {problem}")
        stored, problem = store.load(NODE, decode)
    finally:
        store.close(0)
    if problem is not None:
        verdict.problems.append(f"parameters: {problem}")
        return
    numbers = {0}
    if stored is not None:
        values = [stored.values.get(key, b"") for key in (TIMEOUT, HEARTBEAT)]
        numbers = {int.from_bytes(value, "little") - LOWEST for value in values}
    if len(numbers) > 1:
        verdict.problems.append(f"parameters: a mixture of the sets {sorted(numbers)}")
        return
    (verdict.found,) = numbers
    if verdict.found not in allowed:
        verdict.problems.append(f"parameters: set {verdict.found} instead of {allowed}")


def judge_statistics(verdict: Verdict, file: Path) -> None:
    """Judge the status document, which may be missing."""
    try:
        data = file.read_bytes()
    except FileNotFoundError:
        return
    except OSError as error:
        verdict.problems.append(f"statistics: {error}")
        return
    try:
        is_whole = data.endswith(b"}\n") and json.loads(data)["program"] == PROGRAM
    except (ValueError, KeyError, TypeError):
        is_whole = False
    if not is_whole:
        verdict.problems.append(f"statistics: {len(data)} bytes, and not a document: {data[:40]!r}")


def judge_start(verdict: Verdict, folder: Path) -> None:
    """Let a recorder start in the folder, and check that its capture is whole."""
    recorder = Recorder(folder, RecordConfig(min_free_mb=1))
    try:
        before = set(folder.glob(f"*{SUFFIX}"))
        recorder.start()
    except (OSError, RunError) as error:
        verdict.problems.append(f"start: {error}")
        return
    for number in range(100):
        recorder.put(number + 1, 3, 0, b"", 0)
    recorder.close()
    made = set(folder.glob(f"*{SUFFIX}")) - before
    kinds = [each.kind for file in made for each in read_blocks(file)]
    if kinds != [b"H", b"D", b"H", b"E"]:
        text = f"start: the new capture has the blocks {kinds}: {recorder.facts.problem}"
        verdict.problems.append(text)
