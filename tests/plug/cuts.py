"""Cuts the power of a recording gateway at every write, and judges the remaining files.

    python tests/plug/cuts.py ext4|f2fs|vfat --states N --seed N --folder DIR

``power_cuts.py`` runs it in User Mode Linux. The gateway runs on a logged device. Each state
that a power loss may leave is mounted and judged, and the recorder starts in it. Every tenth
state loses power a second time while it is mounted and used again. In every 100th state `run`
itself starts. The exit code is 1 if a state is bad. DIR gets

* ``FILESYSTEM.json`` with the figures,
* ``FILESYSTEM.recorded.gz`` with the log. ``--recorded`` examines it again, because a further run
  of the gateway has another log, also with the same seed.
* ``FILESYSTEM-N.img.gz`` with the disk of each bad state, for a mount or `dump.f2fs`.
"""

import argparse
import gzip
import json
import pickle
import random
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from block_log import Log, State, Write
from devices import Image, LoggedDevice, LoopDevice, load_modules, mount, unmount
from plug_judge import (
    Verdict,
    judge_captures,
    judge_parameters,
    judge_start,
    judge_statistics,
)
from plug_scenario import (
    FILE_SYSTEMS,
    MEMORY,
    ROOT,
    FileSystem,
    RealStart,
    Recorded,
    make_file_system,
    record,
)

SECOND_CUT_EVERY = 10
SECOND_CUTS = 3
START_EVERY = 100
MAX_REPAIRED = 3
"""Largest exit code of a repair that was successful."""
SHOWN = 20
"""Number of bad states that are described."""


class Examiner:
    """Mounts states of a recorded gateway's disk, and judges them."""

    def __init__(self, system: FileSystem, disk: LoopDevice, recorded: Recorded) -> None:
        self._system = system
        self._disk = disk
        self._recorded = recorded
        self._log_device = LoopDevice(2, MEMORY / "second", 64 << 20)
        self._device = LoggedDevice("examined", disk, self._log_device)
        self._real = RealStart(system)
        self.kind = system.kind
        self.image = Image(disk)
        self.rescued = 0
        """Number of states that the kernel mounted only after a repair."""
        self.undone = 0
        """Number of second power losses that undid flushed writes of captures."""

    def examine(
        self,
        state: State,
        writes: tuple[Write, ...],
        before: Verdict | None,
        *,
        is_second: bool = False,
        with_run: bool = False,
    ) -> tuple[Verdict, Log]:
        """Judge a state with these writes. Also return the log of the writes meanwhile.

        ``before`` is the verdict of the state with exactly the flushed writes. After a second loss
        of power it is the verdict before that.
        """
        if self._device.is_nearly_full:
            self._device.close()
            self._device = LoggedDevice("examined", self._disk, self._log_device)
        self.image.put(writes)
        verdict = Verdict()
        try:
            self._mount(may_be_repaired=is_second or state.kind == "torn")
        except OSError as error:
            verdict.problems.append(f"does not mount: {error}; {last_words_of_the_kernel()}")
        else:
            self._judge(verdict, state, before, is_second)
            if with_run and (problem := self._real.problem()):
                verdict.problems.append(problem)
            unmount(ROOT)
        log = Log(self._device.entries(), self._system.unit)
        for entry in log.entries:
            if entry.is_write:
                self.image.note_changed(entry.sector, len(entry.data))
        return verdict, log

    def keep(self, writes: tuple[Write, ...], file: Path) -> None:
        """Write the disk of the state with these writes to a compressed file."""
        self.image.put(writes)
        with (MEMORY / "disk").open("rb") as disk, gzip.open(file, "wb", 1) as stream:
            shutil.copyfileobj(disk, stream)

    def _mount(self, may_be_repaired: bool) -> None:
        """Mount the device as a system does that boots."""
        system = self._system
        if system.repair:
            self._repair(system.repair)
        try:
            mount(self._device.path, ROOT, system.kind)
        except OSError:
            if not (may_be_repaired and system.rescue):
                raise
            self.rescued += 1
            self._repair(system.rescue)
            mount(self._device.path, ROOT, system.kind)

    def _repair(self, command: Sequence[str]) -> None:
        words = [*command, self._device.path]
        done = subprocess.run(words, capture_output=True, check=False)
        if done.returncode > MAX_REPAIRED:
            raise OSError(f"{words}: {done.stdout.decode(errors='replace')}")

    def _judge(
        self,
        verdict: Verdict,
        state: State,
        before: Verdict | None,
        is_second: bool,
    ) -> None:
        log = self._recorded.log
        may_undo = is_second and not self._system.is_recovery_safe
        flushed: Mapping[str, int] | None = before.blocks if before else {}
        allowed = range(log.stored(state.at), log.requested(state.at) + 1)
        if may_undo:
            flushed = None
        elif is_second and before:
            allowed = range(before.found, before.found + 1)
        cut_ns = log.latest_ns(state.at)
        judge_captures(verdict, ROOT / "captures", self._recorded.captures, cut_ns, flushed)
        if may_undo and before and verdict.blocks != before.blocks:
            self.undone += 1
        if self._system.has_store:
            judge_parameters(verdict, ROOT / "store", allowed)
            judge_statistics(verdict, ROOT / "status.json")
        judge_start(verdict, ROOT / "captures")


def last_words_of_the_kernel() -> str:
    done = subprocess.run(["dmesg"], capture_output=True, check=False, text=True)
    return " | ".join(done.stdout.splitlines()[-3:])


class Tally:
    """Counts states, describes the bad ones and keeps their disks."""

    def __init__(self, examiner: Examiner, folder: Path) -> None:
        self._examiner = examiner
        self._folder = folder
        self.counts: Counter[str] = Counter()
        self.bad = 0
        self.shown: list[str] = []
        """Descriptions of the first bad states."""
        self.loss_ns = 0

    def add(self, kind: str, state: State, writes: tuple[Write, ...], verdict: Verdict) -> None:
        self.counts[kind] += 1
        self.loss_ns = max(self.loss_ns, verdict.loss_ns)
        if verdict.problems:
            self.bad += 1
            if self.bad <= SHOWN:
                file = self._folder / f"{self._examiner.kind}-{self.bad}.img.gz"
                self._examiner.keep(writes, file)
                head = f"BAD {kind} {state.kind} at entry {state.at}, flushed {state.base}"
                self.shown.append("\n    ".join([f"{head}, {file.name}:", *verdict.problems]))
                print(self.shown[-1], flush=True)

    @property
    def total(self) -> int:
        return sum(self.counts.values())


def second_cuts(state: State, log: Log, generator: random.Random) -> Iterator[tuple[Write, ...]]:
    """Yield the writes of states after a second power loss. ``log`` is from the first to it."""
    for _ in range(SECOND_CUTS):
        at = generator.choice(log.positions())
        second = log.variant(at, generator) if generator.random() < 0.5 else log.prefix(at)
        before = [(e.sector, e.data) for e in log.entries[: second.base] if e.is_write]
        yield (*state.writes, *before, *second.writes)


def examine_all(
    examiner: Examiner,
    recorded: Recorded,
    states: list[State],
    generator: random.Random,
    folder: Path,
) -> Tally:
    """Examine the states in the order of the log, and second power losses in some of them."""
    tally = Tally(examiner, folder)
    flushed: Verdict | None = None
    base = 0
    for number, state in enumerate(states):
        if state.base > base:
            entries = recorded.log.entries[base : state.base]
            examiner.image.advance([(e.sector, e.data) for e in entries if e.is_write])
            base = state.base
        with_run = number % START_EVERY == 0
        verdict, log = examiner.examine(state, state.writes, flushed, with_run=with_run)
        tally.add(state.kind, state, state.writes, verdict)
        if state.kind == "prefix" and state.at == state.base:
            flushed = verdict
        if number % SECOND_CUT_EVERY == 0 and not verdict.problems:
            for writes in second_cuts(state, log, generator):
                again, _ = examiner.examine(state, writes, verdict, is_second=True)
                tally.add("second", state, writes, again)
        if number % max(1, len(states) // 20) == 0:
            print(f"{number} of {len(states)} states, {tally.bad} bad", flush=True)
    return tally


def recorded_gateway(
    system: FileSystem,
    disk: LoopDevice,
    args: argparse.Namespace,
) -> tuple[bytes, Recorded]:
    """Return the empty file system and the log of a gateway, which a file may have."""
    if args.recorded:
        with gzip.open(args.recorded) as stream:
            found: tuple[bytes, Recorded] = pickle.load(stream)
            return found
    make_file_system(system, disk)
    empty = (MEMORY / "disk").read_bytes()
    recorded = record(system, disk, args.seed)
    with gzip.open(args.folder / f"{system.kind}.recorded.gz", "wb", 1) as stream:
        pickle.dump((empty, recorded), stream)
    return empty, recorded


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("system", choices=FILE_SYSTEMS)
    parser.add_argument("--states", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--recorded", type=Path)
    args = parser.parse_args()
    system = FILE_SYSTEMS[args.system]
    load_modules()
    for folder in (ROOT, MEMORY):
        folder.mkdir()
    disk = LoopDevice(0, MEMORY / "disk", system.size)
    empty, recorded = recorded_gateway(system, disk, args)
    (MEMORY / "disk").open("r+b").write(empty)
    generator = random.Random(args.seed)
    share = 1 + SECOND_CUTS / SECOND_CUT_EVERY
    states = recorded.log.states(round(args.states / share), generator)
    print(
        f"{args.system}: {len(recorded.log.entries)} entries, {len(states)} states, "
        f"{time.monotonic():.0f} s",
        flush=True,
    )
    examiner = Examiner(system, disk, recorded)
    tally = examine_all(examiner, recorded, states, generator, args.folder)
    figures = {
        "states": tally.total,
        "kinds": tally.counts,
        "bad": tally.bad,
        "rescued": examiner.rescued,
        "undone": examiner.undone,
        "positions": len(recorded.log.positions()),
        "shown": tally.shown,
        "loss_s": round(tally.loss_ns / 1e9, 3),
    }
    (args.folder / f"{args.system}.json").write_text(json.dumps(figures))
    print(figures, flush=True)
    return int(tally.bad > 0)


if __name__ == "__main__":
    sys.exit(main())
