"""Captures around events: the ring, its captures, and the disk."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, cast

import pytest
from capture_bench import START, Bench, made

from kontronik_can_gw.capture.format import Entry, EntryKind, read_numbers
from kontronik_can_gw.capture.recorded_gateway import devices_of, state_of
from kontronik_can_gw.config.keys import RecordConfig
from kontronik_can_gw.desk.recordings.inputs import CaptureInput, open_input
from kontronik_can_gw.desk.recordings.replay import TimedFrame
from kontronik_can_gw.runtime.files import event_recorder, recorder
from kontronik_can_gw.runtime.files.event_recorder import EventRecorder, Ring
from kontronik_can_gw.runtime.system.clock import ClockFacts
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("events")

REMARKS = (EntryKind.LOST, EntryKind.CLOCK)
BOTH = pytest.mark.parametrize("core_language", ["C", "Python"], indirect=True)


@dataclass(frozen=True)
class HalfSecond:
    """A part of the simulated flight, and the gateway's state after it."""

    now: int
    entries: Sequence[Entry]
    state: dict[str, Any]
    devices: list[dict[str, Any] | None]


class Simulation:
    """One flight, of which each half second is simulated once, when a test first needs it."""

    def __init__(self) -> None:
        self.bench = Bench(*made(2))
        self.state = state_of(self.bench.gateway)
        self._run = self.bench.running(3, wild=False)
        self._parts: list[HalfSecond] = []
        self._given = 0

    def part(self, number: int) -> HalfSecond:
        while len(self._parts) <= number:
            now = self._run(0.5)
            entries = self.bench.entries[self._given :]
            self._given += len(entries)
            gateway = self.bench.gateway
            part = HalfSecond(now, entries, state_of(gateway), devices_of(gateway))
            self._parts.append(part)
        return self._parts[number]


_simulations: dict[str, Simulation] = {}
"""The flight with each core, by its language."""


@pytest.fixture(autouse=True, scope="module")
def released() -> Iterator[None]:
    yield
    _simulations.clear()


@pytest.fixture(autouse=True)
def simulation(core_language: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the recorder's thread sleep until the end, and let a Flight use the core's flight."""
    monkeypatch.setattr(recorder, "PERIOD_S", 10_000)
    monkeypatch.setattr(recorder, "_CLOSE_S", 60)
    monkeypatch.setattr(recorder, "state_of", attrgetter("state"))
    monkeypatch.setattr(recorder, "devices_of", attrgetter("devices"))
    language = core_language or "C"
    if language not in _simulations:
        _simulations[language] = Simulation()
    Flight.simulation = _simulations[language]


class Flight:
    """A simulated flight with a recorder, whose thread's work is done at the flight's time."""

    simulation: Simulation

    def __init__(self, folder: Path, **settings: int) -> None:
        self.folder = folder
        self.bench = self.simulation.bench
        known = {"created_ns": START, "state": self.simulation.state}
        self.now = START
        config = RecordConfig(**{"min_free_mb": 0} | settings)  # type: ignore[arg-type]
        self.it = EventRecorder(folder, config, 2, lambda: self.now)
        self.it.header = self.bench.setup.header() | known
        self.it.start(wait=True)
        self._flown = 0
        self.put: list[Entry] = []
        """All entries that the recorder was given."""
        put = self.it.put

        def noted(*entry: object) -> None:
            put(*entry)  # type: ignore[arg-type]
            self.put.append(Entry(*entry))  # type: ignore[arg-type]

        self.it.put = noted  # type: ignore[method-assign,assignment]

    def fly(self, seconds: float) -> int:
        """Fly for some seconds. The recorder works twice a second. Return the time."""
        for _ in range(int(2 * seconds)):
            part = self.simulation.part(self._flown)
            self._flown += 1
            self.now = part.now
            for entry in part.entries:
                self.it.put(*entry)
            self.it.note(cast(Any, part), self.now)
            self.it._work([])
        return self.now

    def event(self, reason: str, esc: str = "e0") -> int:
        self.it.trigger(self.now, self.now / SECOND, esc, reason)
        return self.now

    def captures(self) -> list[Path]:
        return sorted(self.folder.iterdir(), key=lambda path: path.stat().st_mtime_ns)

    def sent(self, begin_ns: int, end_ns: int) -> list[TimedFrame]:
        return between(self.bench.sent, begin_ns, end_ns)


def between(frames: Sequence[TimedFrame], begin_ns: int, end_ns: int) -> list[TimedFrame]:
    return [frame for frame in frames if begin_ns <= frame.time_ns < end_ns]


def replayed(path: Path) -> tuple[list[TimedFrame], CaptureInput]:
    with open_input(path) as found:
        assert isinstance(found, CaptureInput)
        frames = list(found.frames())
        assert found.damage == []
        return frames, found


@BOTH
def test_flight_with_two_faults_gives_two_captures_equal_to_the_flight(tmp_path: Path) -> None:
    flight = Flight(tmp_path, before_s=5, after_s=4)
    flight.fly(40)
    assert list(tmp_path.iterdir()) == []
    first = flight.event("undervoltage")
    flight.fly(40)
    second = flight.event("telemetry lost", "e1")
    flight.fly(20)
    flight.it.close()
    captures = flight.captures()
    assert len(captures) == 2
    for path, event_ns, reason in (
        (captures[0], first, "e0: undervoltage"),
        (captures[1], second, "e1: telemetry lost"),
    ):
        frames, found = replayed(path)
        begin = event_ns - 5 * SECOND
        end = event_ns + 4 * SECOND
        live = flight.sent(begin, end)
        assert len(live) > 3000
        assert between(frames, begin, end) == live
        assert reason in found.provenance["recorded because of"]
        longest = (5 + 4 + 20) * SECOND
        assert frames[-1].time_ns - frames[0].time_ns < longest
    assert flight.it.facts.events == 2
    assert flight.it.facts.event is not None
    assert flight.it.facts.event["file"] == str(captures[1])
    assert flight.it.facts.lost == 0


def test_events_in_one_capture_extend_it(tmp_path: Path) -> None:
    flight = Flight(tmp_path, before_s=2, after_s=5)
    flight.fly(20)
    flight.event("one")
    flight.fly(4)
    last = flight.event("two")
    flight.fly(20)
    flight.it.close()
    [path] = flight.captures()
    frames, found = replayed(path)
    assert last + 5 * SECOND <= frames[-1].time_ns < last + 9 * SECOND
    assert "e0: one (" in found.provenance["recorded because of"]
    assert "e0: two (" in found.provenance["recorded because of"]


def test_event_soon_after_a_capture_has_its_seconds_before_it_too(tmp_path: Path) -> None:
    flight = Flight(tmp_path, before_s=5, after_s=1)
    flight.fly(30)
    flight.event("one")
    flight.fly(5)
    second = flight.event("two")
    flight.fly(10)
    flight.it.close()
    _, path = flight.captures()
    frames, _ = replayed(path)
    begin = second - 5 * SECOND
    end = second + 1 * SECOND
    assert between(frames, begin, end) == flight.sent(begin, end)


def test_event_at_the_start_records_the_run_from_its_beginning(tmp_path: Path) -> None:
    flight = Flight(tmp_path, before_s=30, after_s=1)
    flight.fly(2)
    flight.event("undervoltage")
    flight.fly(8)
    flight.it.close()
    frames, _ = replayed(flight.captures()[0])
    assert frames[:2000] == flight.bench.sent[:2000]


def test_capture_on_an_event_has_parts(tmp_path: Path) -> None:
    flight = Flight(tmp_path, before_s=5, after_s=150, part_minutes=1)
    flight.fly(20)
    event = flight.event("undervoltage")
    flight.fly(170)
    flight.it.close()
    files = flight.captures()
    assert [path.stem.rpartition("-")[2] for path in files] == ["00000", "00001", "00002"]
    frames, found = replayed(tmp_path)
    begin = event - 5 * SECOND
    end = event + 150 * SECOND
    assert between(frames, begin, end) == flight.sent(begin, end)
    assert "undervoltage" in found.provenance["recorded because of"]


def test_part_with_the_event_is_not_removed_while_its_capture_goes_on(tmp_path: Path) -> None:
    flight = Flight(tmp_path, before_s=1, after_s=300, part_minutes=1, keep_mb=1)
    flight.fly(20)
    event = flight.event("undervoltage")
    flight.fly(260)
    assert flight.it.facts.file
    parts = [path.stem.rpartition("-")[2] for path in flight.captures()]
    assert parts[0] == "00000"
    assert "00001" not in parts, "the limit removes the other parts"
    frames, _ = replayed(flight.captures()[0])
    begin = event - 1 * SECOND
    end = event + 1 * SECOND
    assert between(frames, begin, end) == flight.sent(begin, end)
    flight.fly(60)
    assert not flight.it.facts.file
    flight.it.close()
    recorder.remove_oldest(tmp_path, 1, flight.it._spared)
    assert flight.captures() == [], "after its end the capture can be removed"


def test_of_very_many_events_at_once_the_first_are_listed_and_all_are_counted(
    tmp_path: Path,
) -> None:
    flight = Flight(tmp_path, before_s=1, after_s=3)
    flight.fly(16)
    for number in range(1100):
        flight.event(f"event {number}")
    flight.fly(1)
    assert flight.it.facts.events == 1100
    name, _ = flight.it.take_events()[0]
    assert name == "event: e0: event 0"
    flight.fly(8)
    flight.it.close()
    _, found = replayed(flight.captures()[0])
    assert "e0: event 0 (" in found.provenance["recorded because of"]


def test_last_of_very_many_events_at_once_extends_a_capture(tmp_path: Path) -> None:
    flight = Flight(tmp_path, before_s=1, after_s=3)
    flight.fly(16)
    for number in range(1000):
        flight.event(f"event {number}")
    last = flight.now + 5 * SECOND
    flight.it.trigger(last, 1.0, "e0", "last")
    flight.fly(15)
    flight.it.close()
    frames, _ = replayed(flight.captures()[0])
    assert frames[-1].time_ns >= last + 3 * SECOND - SECOND // 10


def test_end_of_the_gateway_ends_a_capture(tmp_path: Path) -> None:
    flight = Flight(tmp_path, before_s=5, after_s=600)
    flight.fly(10)
    flight.event("undervoltage")
    flight.it.close()
    frames, _ = replayed(flight.captures()[0])
    assert frames[-1].time_ns > flight.now - SECOND


def test_event_while_the_folder_is_unusable_is_recorded_later(tmp_path: Path) -> None:
    folder = tmp_path / "captures"
    folder.write_text("not a folder")
    flight = Flight(folder, before_s=5, after_s=3)
    flight.fly(30)
    event = flight.event("undervoltage")
    flight.fly(1)
    problem = flight.it.facts.problem
    assert "captures" in problem
    [(name, line)] = flight.it.take_events()
    assert name == "event: e0: undervoltage"
    assert line == f"{name}: cannot be recorded yet: {problem}"
    folder.unlink()
    flight.fly(20)
    flight.it.close()
    assert flight.it.facts.problem == ""
    frames, _ = replayed(flight.captures()[0])
    begin = event - 5 * SECOND
    end = event + 3 * SECOND
    assert between(frames, begin, end) == flight.sent(begin, end)


def test_event_is_recorded_after_any_time_without_the_disk(tmp_path: Path) -> None:
    folder = tmp_path / "captures"
    folder.write_text("not a folder")
    flight = Flight(folder, before_s=1, after_s=1)
    flight.fly(20)
    event = flight.event("undervoltage")
    flight.fly(60)
    flight.event("a later one")
    flight.fly(20)
    full = [report.text for report in flight.it.reports(0) if report.name == "captures: memory"]
    assert full == [
        "captures: the memory is full, so input is lost until the folder can be used",
    ]
    lost = flight.it.facts.lost
    assert lost > 1000
    folder.unlink()
    flight.fly(15)
    flight.it.close()
    [path] = flight.captures()
    frames, found = replayed(path)
    begin = event - 1 * SECOND
    end = event + 1 * SECOND
    assert between(frames, begin, end) == flight.sent(begin, end)
    assert "e0: undervoltage (" in found.provenance["recorded because of"]
    assert "e0: a later one (" in found.provenance["recorded because of"]
    facts = flight.it.facts
    assert facts.events == 2
    assert facts.event is not None
    assert facts.event["file"] == str(path)
    [end_of_fault] = [each for each in flight.it.reports(0) if each.name == "captures: memory"]
    assert not end_of_fault.begins


def test_entries_and_an_event_that_waited_for_the_thread_are_recorded(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(recorder, "_AT_ONCE", recorder.CAPACITY)
    flight = Flight(tmp_path, before_s=1, after_s=1)
    flight.fly(20)
    work = flight.it._work
    flight.it._work = lambda _items: None  # type: ignore[method-assign]
    event = flight.event("undervoltage")
    flight.fly(25)
    flight.it._work = work  # type: ignore[method-assign]
    flight.fly(4)
    flight.it.close()
    frames, _ = replayed(flight.captures()[0])
    begin = event - 1 * SECOND
    end = event + 1 * SECOND
    assert between(frames, begin, end) == flight.sent(begin, end)


def test_capture_without_any_entry_is_reported(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(event_recorder, "_BYTES_PER_S", 1)
    flight = Flight(tmp_path, before_s=1, after_s=1)
    flight.fly(4)
    flight.event("undervoltage")
    flight.fly(8)
    flight.it._ring._max_bytes = 1 << 20
    flight.fly(4)
    name = "event: e0: undervoltage"
    lines = flight.it.take_events()
    assert (
        name,
        f"{name}: could not be recorded, because the memory is too small for the input",
    ) in lines
    assert flight.it.facts.event is None
    flight.it.close()
    assert flight.captures() == []


@pytest.mark.parametrize("failing", ["append", "sync"])
def test_disk_that_fails_during_a_capture_begins_a_new_one(
    failing: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flight = Flight(tmp_path, before_s=5, after_s=20)
    flight.fly(30)
    event = flight.event("undervoltage")
    flight.fly(6)

    def fail(*_: object) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(recorder.CapturePart, failing, fail)
        flight.fly(4)
    assert "No space left on device" in flight.it.facts.problem
    flight.fly(30)
    flight.it.close()
    path = flight.captures()[-1]
    assert path.stat().st_size > 10_000
    frames, _ = replayed(path)
    assert frames[0].time_ns < event
    settled = frames[0].time_ns + 12 * SECOND
    end = event + 20 * SECOND
    assert len(between(frames, settled, end)) > 1000
    assert between(frames, settled, end) == flight.sent(settled, end)
    assert flight.it.facts.lost == 0


@pytest.mark.promise("captures")
def test_lost_entries_are_counted_while_the_disk_fails_for_long(tmp_path: Path) -> None:
    folder = tmp_path / "captures"
    folder.write_text("not a folder")
    flight = Flight(folder, before_s=1, after_s=60)
    limit = event_recorder.ring_bytes(RecordConfig(before_s=1), 2)
    flight.event("undervoltage")
    flight.fly(90)
    assert limit / 2 < flight.it.facts.ring_bytes <= limit
    flight.it.reports(0)
    assert flight.it.facts.lost > 1000
    flight.it.close()


@pytest.mark.promise("full-disk")
@pytest.mark.parametrize("ends_before", [False, True])
def test_capture_states_exactly_what_a_full_disk_has_cost(
    ends_before: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """``ends_before``: the capture ends during the loss, so nothing follows the loss in it."""
    monkeypatch.setattr(event_recorder, "_BYTES_PER_S", 3000)
    flight = Flight(tmp_path, before_s=2, after_s=4)
    flight.fly(6)

    def fail(*_: object) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(recorder.CapturePart, "append", fail)
        for _ in range(20):
            event = flight.event("undervoltage")
            flight.fly(1)
        if ends_before:
            flight.fly(7)
    for path in flight.captures():
        path.unlink()
    for _ in range(0 if ends_before else 5):
        flight.event("undervoltage")
        flight.fly(1)
    flight.fly(10)
    flight.it.close()
    flight.it.reports(0)
    [path] = flight.captures()
    with open_input(path) as found:
        assert isinstance(found, CaptureInput)
        kept = list(found.entries())
        list(found.frames())
        [damage] = found.damage
    remarks = [entry for entry in kept if entry.kind == EntryKind.LOST]
    [lost] = [read_numbers(entry.data)[0] for entry in remarks]
    begin = kept[0].time_ns
    end = max(kept[-1].time_ns, event + 4 * SECOND)
    put = [entry for entry in flight.put if begin <= entry.time_ns < end]
    captured = [entry for entry in kept if entry.kind not in REMARKS and entry.time_ns < end]
    assert len(put) - len(captured) > 1000
    missing = len(put) - len(captured)
    if ends_before:  # the loss lasts longer than the capture
        assert lost > missing
    else:
        assert lost == missing
    assert lost == flight.it.facts.lost
    assert damage.startswith(f"{lost} entries could not be recorded")
    assert (kept[-1] == remarks[0]) == ends_before


def test_line_for_the_log_names_the_file(tmp_path: Path) -> None:
    flight = Flight(tmp_path)
    flight.fly(1)
    flight.it.mark()
    assert flight.it.take_events() == []
    flight.fly(1)
    [path] = flight.captures()
    line = f"event: signal USR1: recording to {path}"
    assert flight.it.take_events() == [("event: signal USR1", line)]
    assert flight.it.take_events() == []
    flight.it.close()


# --- the ring


def items(begin_s: int, count: int, size: int = 20) -> list[Entry]:
    """Return a STATE entry and a number of entries within the second after it."""
    begin = begin_s * SECOND
    found = [Entry(begin, EntryKind.STATE, data=b"{}")]
    for number in range(count):
        data = bytes((number * 7919 + place * 104729 >> 3 & 255) for place in range(size))
        found.append(Entry(begin + number * MS, EntryKind.BYTES, data=data))
    return found


def test_ring_keeps_the_configured_time_in_whole_segments() -> None:
    ring = Ring(10 * SECOND, 1 << 30)
    for second in range(0, 60, 2):
        assert ring.add(items(second, 100), 0, ClockFacts()) in (0, 101)
        chunks = ring.unwritten(1 << 60)
        kept = second * SECOND - chunks[0].begin_ns
        assert min(second, 10) * SECOND <= kept <= 12 * SECOND
        assert chunks[0].segment.state == b"{}"


def test_ring_never_exceeds_its_size() -> None:
    ring = Ring(1000 * SECOND, 20_000)
    for second in range(50):
        ring.add(items(second, 100), 0, ClockFacts())
        assert 0 < ring.bytes <= 20_000
        assert ring.bytes == sum(len(chunk.payload.stored) for chunk in ring.unwritten(1 << 60))
    ring.add(items(50, 5000, 100), 0, ClockFacts())
    assert ring.bytes == 0, "a segment that does not fit is dropped"
    assert ring.add(items(51, 10)[1:], 0, ClockFacts()) == 10, "ignored without its beginning"
    assert ring.bytes == 0
    assert ring.add(items(52, 10), 0, ClockFacts()) == 0
    assert ring.bytes > 0


def test_ring_of_eight_escs_at_100_hz_fits_into_its_size(tmp_path: Path) -> None:
    """Two ESCs here: the size is proportional to their number."""
    flight = Flight(tmp_path, before_s=30)
    flight.fly(50)
    limit = event_recorder.ring_bytes(RecordConfig(before_s=30), 2)
    assert flight.it.facts.ring_bytes < limit / 2
    first = flight.it._ring.unwritten(1 << 60)[0]
    assert first.begin_ns <= flight.now - 42 * SECOND
    flight.it.close()
