"""The C core plays recordings at full speed, and gives the same results as Python."""

import random
from pathlib import Path
from typing import Any

import offline_equality
import pytest
from capture_bench import Bench, capture, made, samples

from kontronik_can_gw.desk.recordings import bytes_input
from kontronik_can_gw.desk.recordings.inputs import open_input
from kontronik_can_gw.desk.recordings.recording import PlayedBlock

pytestmark = pytest.mark.promise("both-cores")


@pytest.fixture(autouse=True)
def reads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Restore after each test the setting that a run changes."""
    monkeypatch.setattr(bytes_input, "CHUNK", 0)


@pytest.mark.parametrize("group", range(4))
def test_rows_frames_damage_and_text_equal_those_of_python(
    native_library: Any,
    tmp_path: Path,
    group: int,
) -> None:
    counts = [offline_equality.run(native_library, seed, tmp_path) for seed in range(group, 12, 4)]
    assert sum(counts) > 200


@pytest.mark.extended
@pytest.mark.parametrize("group", range(10))
def test_many_more_recordings_equal_those_of_python(
    native_library: Any,
    tmp_path: Path,
    group: int,
) -> None:
    seeds = range(1_000 + group, 1_040, 10)
    assert sum(offline_equality.run(native_library, seed, tmp_path) for seed in seeds) > 200


def test_recordings_that_c_cannot_play_are_played_by_python(
    native_library: Any,
    tmp_path: Path,
) -> None:
    """These are captures of 0.5.0, and the frames of CANopen nodes. C plays the rows of nodes."""
    bench = Bench(*made(2, canopen=True)).live(3, 2)
    nodes = capture(tmp_path / "nodes.kcap", bench.setup, bench.entries)
    old = offline_equality.write_capture(random.Random(1), tmp_path / "old.kcap", version=1)
    with offline_equality.core(native_library):
        for path in (nodes, old):
            with open_input(path) as recording:
                blocks = list(recording.blocks())
                assert all(isinstance(block, PlayedBlock) is (path == nodes) for block in blocks)
                assert list(samples(recording))
                assert all(isinstance(frames, list) for frames in recording.batches())
