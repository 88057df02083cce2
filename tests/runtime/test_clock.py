"""The state of the wall clock: synchronised, set, hardware clock. Time is passed in."""

from pathlib import Path

import pytest
from statistics_bench import Bench

from kontronik_can_gw.capture.format import (
    CLOCK_FLAGS,
    Block,
    EntryKind,
    Scanner,
    read_entries,
    read_json,
)
from kontronik_can_gw.config.keys import RecordConfig
from kontronik_can_gw.desk.metrics import families
from kontronik_can_gw.desk.monitor.status import judge, lines_of
from kontronik_can_gw.runtime.files.recorder import Recorder
from kontronik_can_gw.runtime.system.clock import (
    MAX_ERROR_US,
    ClockFacts,
    ClockWatch,
    SetTimer,
    hardware_clock,
    max_error_us,
)
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("clock")

UNIX_NS = 1_700_000_000 * SECOND


class Timer(SetTimer):
    """A timer that reports that the clock was set when a test says so."""

    def __init__(self) -> None:
        self.is_set = False

    def was_set(self) -> bool:
        found = self.is_set
        self.is_set = False
        return found

    def close(self) -> None:
        """Do nothing."""


class World:
    """A wall clock, and the watch that follows it."""

    def __init__(self, error: int | None = 1000) -> None:
        self.offset = UNIX_NS
        self.error = error
        self.timer = Timer()
        self.watch = ClockWatch(
            lambda: self.offset, lambda: self.error, lambda: "rtc-ds3231", self.timer
        )

    def set_by(self, by_ns: int) -> None:
        self.offset += by_ns
        self.timer.is_set = True


@pytest.mark.parametrize(
    ("error", "is_synchronized", "max_error_s"),
    [
        (0, True, 0.0),
        (1500, True, 0.0015),
        (MAX_ERROR_US - 1, True, 15.999999),
        (MAX_ERROR_US, False, None),
        (None, None, None),
    ],
)
def test_kernels_largest_error_decides_if_the_clock_is_synchronised(
    error: int | None, is_synchronized: bool | None, max_error_s: float | None
) -> None:
    facts = World(error).watch.facts
    assert facts == ClockFacts(is_synchronized, max_error_s, "rtc-ds3231")


def test_step_has_its_size_and_the_time_after_it() -> None:
    world = World()
    assert world.watch.poll(1 * SECOND) is None
    world.set_by(-3600 * SECOND)
    assert world.watch.poll(2 * SECOND) == -3600 * SECOND
    assert world.watch.poll(3 * SECOND) is None
    facts = world.watch.facts
    assert (facts.steps, facts.last_step_by_ns) == (1, -3600 * SECOND)
    assert facts.last_step_ns == UNIX_NS - 3598 * SECOND
    world.set_by(5 * SECOND)
    world.watch.poll(4 * SECOND)
    assert world.watch.facts.steps == 2


def test_neither_a_slow_correction_nor_a_tiny_change_is_a_step() -> None:
    world = World()
    world.offset += 400_000  # a time service slows the clock down or speeds it up
    assert world.watch.poll(SECOND) is None
    world.set_by(MS - 1)  # for example a leap second table was loaded
    assert world.watch.poll(2 * SECOND) is None
    assert world.watch.facts.steps == 0


def test_this_kernel_reports_the_error_and_has_the_timer() -> None:
    error = max_error_us()
    assert error is not None
    assert 0 <= error <= MAX_ERROR_US
    timer = SetTimer()
    assert timer._fd is not None
    assert not timer.was_set()
    timer.close()
    timer.close()


def test_first_hardware_clock_is_found(tmp_path: Path) -> None:
    assert hardware_clock(tmp_path / "none") == ""
    assert hardware_clock(tmp_path) == ""
    for name, text in (("rtc1", "rtc-pcf8523 1-0068\n"), ("rtc0", "rtc-ds3231\n")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "name").write_text(text)
    assert hardware_clock(tmp_path) == "rtc-ds3231"
    assert hardware_clock(tmp_path / "rtc0" / "name") is None


# --- status and metrics

STEPPED = ClockFacts(False, None, "", 2, UNIX_NS, 90 * SECOND)


@pytest.mark.parametrize(
    ("facts", "line", "metrics"),
    [
        (ClockFacts(), "clock: state unknown", {"clock_steps_total": 0}),
        (
            ClockFacts(True, 0.012, "rtc-ds3231"),
            "clock: synchronised, hardware clock rtc-ds3231",
            {"clock_synchronized": 1, "clock_max_error_seconds": 0.012, "clock_hardware": 1},
        ),
        (
            STEPPED,
            "clock: not synchronised, no hardware clock, set by +90.000 s at 2023-11-14T22:13:20Z",
            {"clock_synchronized": 0, "clock_hardware": 0, "clock_steps_total": 2},
        ),
    ],
)
def test_status_and_metrics_have_the_state_of_the_clock(
    facts: ClockFacts, line: str, metrics: dict[str, float]
) -> None:
    bench = Bench()
    bench.run(1)
    document = bench.document(clock=facts)
    seen = judge(Path("status.json"), document, bench.now)
    shown = " ".join(" ".join(text.plain for text in lines_of(seen)).split())
    assert line in shown
    found = {
        sample.name.removeprefix("kontronik_"): sample.value
        for family in families(document, 0)
        for sample in family.samples
        if "_clock_" in sample.name
    }
    assert found == {"clock_steps_total": 0} | metrics


def test_document_without_a_clock_is_still_shown() -> None:
    bench = Bench()
    document = bench.document()
    del document["clock"]
    seen = judge(Path("status.json"), document, bench.now)
    assert not any("clock" in text.plain for text in lines_of(seen))
    assert not any("_clock_" in family.name for family in families(document, 0))


# --- captures


def recorded(folder: Path, *states: ClockFacts) -> tuple[list[dict[str, object]], list[int]]:
    """Record an entry in each of these states of the clock, one a second.

    Return the headers' states, and the flags of the CLOCK entries.
    """
    now = 10 * SECOND
    it = Recorder(folder, RecordConfig(min_free_mb=0), clock=lambda: now)
    for state in states:
        it.clock_facts = state
        it._write([(now, EntryKind.ADVANCE, 0, b"", 0, None)], now)
        now += SECOND
    it._end_part()
    [path] = folder.iterdir()
    headers = []
    flags = []
    for found in Scanner().feed(path.read_bytes()):
        assert isinstance(found, Block)
        if found.kind == b"H":
            headers.append(read_json(found.payload)["clock"])
        elif found.kind == b"D":
            entries = read_entries(found.payload)
            flags += [entry.flags for entry in entries if entry.kind == EntryKind.CLOCK]
    return headers, flags


def test_capture_has_the_state_at_its_beginning_and_each_change(tmp_path: Path) -> None:
    without = ClockFacts(False, None, "")
    synchronised = ClockFacts(True, 0.01, "", 1, UNIX_NS, SECOND)
    headers, flags = recorded(
        tmp_path, without, without, synchronised, synchronised, ClockFacts(None), without
    )
    assert headers[0] == {
        "synchronized": False,
        "max_error_s": None,
        "hardware": "",
        "steps": 0,
        "last_step_ns": None,
        "last_step_by_ns": 0,
    }
    assert flags == [CLOCK_FLAGS[True], CLOCK_FLAGS[None], CLOCK_FLAGS[False]]


def test_step_of_a_synchronised_clock_is_recorded_at_once(tmp_path: Path) -> None:
    before = ClockFacts(True)
    _, flags = recorded(tmp_path, before, before, before._replace(steps=1))
    assert flags == [CLOCK_FLAGS[True]]
