"""The judge of files after a power loss, with files made by hand."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from plug_judge import (
    HEARTBEAT,
    LOWEST,
    NODE,
    TIMEOUT,
    Verdict,
    capture_of,
    judge_captures,
    judge_parameters,
    judge_start,
    judge_statistics,
    read_blocks,
)

from kontronik_can_gw.canopen.storage import Stored, encode
from kontronik_can_gw.capture.format import block, data_payload, json_payload
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.runtime.files import recorder
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("sharp-tests")

NAME = "20260101T000000Z-abcdef-00000.kcap"


def data_block(number: int, *times: int) -> bytes:
    return block(b"D", number, data_payload([(time, 1, 0, b"\x00", 0, None) for time in times]))


WRITTEN = [
    block(b"H", 0, json_payload({"format": "test"})),
    data_block(1, 10 * SECOND, 10 * SECOND + 500 * MS),
    data_block(2, 11 * SECOND),
    data_block(3, 11 * SECOND + 500 * MS),
]


def judged(folder: Path, content: bytes, cut_ns: int, flushed: int = 0) -> Verdict:
    path = folder / NAME
    path.write_bytes(b"".join(WRITTEN))
    written = {NAME: capture_of(read_blocks(path))}
    path.write_bytes(content)
    verdict = Verdict()
    judge_captures(verdict, folder, written, cut_ns, {NAME: flushed})
    return verdict


@pytest.mark.parametrize(
    ("content", "cut_ns", "blocks", "loss_ns"),
    [
        (b"".join(WRITTEN), 20 * SECOND, 4, 0),
        (b"".join(WRITTEN[:3]), 11 * SECOND + 400 * MS, 3, 400 * MS),
        (b"".join(WRITTEN[:3]), 20 * SECOND, 3, 500 * MS),  # nothing was written after that
        (b"".join(WRITTEN[:2]) + WRITTEN[2][:-1], 11 * SECOND, 2, 500 * MS),
        (b"".join(WRITTEN[:2]) + bytes(4096), 11 * SECOND, 2, 500 * MS),
        (b"".join(WRITTEN[:2]) + bytes(50) + WRITTEN[3], 11 * SECOND, 2, 500 * MS),
        (b"", 10 * SECOND + 900 * MS, 0, 900 * MS),
        (b"", 9 * SECOND, 0, 0),
    ],
    ids=["whole", "shorter", "ended", "torn", "zeros", "gap", "empty", "not begun"],
)
def test_capture_that_ends_within_a_second_before_the_cut_is_good(
    content: bytes, cut_ns: int, blocks: int, loss_ns: int, tmp_path: Path
) -> None:
    verdict = judged(tmp_path, content, cut_ns, blocks)
    assert verdict == Verdict([], {NAME: blocks}, loss_ns)


@pytest.mark.parametrize(
    ("content", "flushed", "problem"),
    [
        (WRITTEN[0], 0, "1.50 s of input are lost"),
        (b"".join(WRITTEN[:3]), 4, "3 blocks are readable, but 4 were flushed"),
        (b"".join(WRITTEN[:3]) + data_block(3, 7), 0, "block 3 was never written"),
        (b"".join(WRITTEN) + data_block(4, 7), 0, "block 4 was never written"),
        (b"", 0, "1.50 s of input are lost"),
    ],
    ids=["header only", "flushed block missing", "other block", "further block", "empty"],
)
def test_capture_that_misses_or_invents_data_is_refused(
    content: bytes, flushed: int, problem: str, tmp_path: Path
) -> None:
    verdict = judged(tmp_path, content, 11 * SECOND + 800 * MS, flushed)
    assert f"{NAME}: {problem}" in verdict.problems


def test_reference_with_a_missing_block_is_refused(tmp_path: Path) -> None:
    (tmp_path / NAME).write_bytes(WRITTEN[0] + WRITTEN[2])
    with pytest.raises(ValueError, match="a block is missing"):
        capture_of(read_blocks(tmp_path / NAME))


def parameters(timeout: int, heartbeat: int) -> bytes:
    numbers = {HEARTBEAT: heartbeat, TIMEOUT: timeout}
    values = {key: (LOWEST + number).to_bytes(2, "little") for key, number in numbers.items()}
    return encode(Stored(None, values))


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (parameters(3, 3), ""),
        (parameters(4, 4), ""),
        (parameters(2, 2), "parameters: set 2 instead of range(3, 5)"),
        (parameters(5, 5), "parameters: set 5 instead of range(3, 5)"),
        (None, "parameters: set 0 instead of range(3, 5)"),
        (parameters(3, 4), "parameters: a mixture of the sets [3, 4]"),
        (parameters(3, 3)[:-5], "damaged or truncated"),
        (b"", "the file is empty"),
        (bytes(200), "not the header of a parameter file"),
    ],
    ids=["old", "new", "too old", "too new", "gone", "mixed", "cut", "empty", "zeros"],
)
def test_parameters_must_be_the_old_or_the_new_set(
    content: bytes | None, problem: str, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / f"{NODE}.params").write_bytes(content)
    verdict = Verdict()
    judge_parameters(verdict, tmp_path, range(3, 5))
    assert bool(verdict.problems) == bool(problem)
    assert problem in "".join(verdict.problems)


@pytest.mark.parametrize(
    ("content", "is_good"),
    [
        (None, True),
        (json.dumps({"program": "kontronik-can-gw"}).encode() + b"\n", True),
        (json.dumps({"program": "kontronik-can-gw"}).encode(), False),
        (b"", False),
        (bytes(100), False),
        (b'{"program": "kontronik-c', False),
        (b'{"other": 1}\n', False),
        (b"[{}\n", False),
    ],
)
def test_statistics_must_be_whole_or_missing(
    content: bytes | None, is_good: bool, tmp_path: Path
) -> None:
    file = tmp_path / "status.json"
    if content is not None:
        file.write_bytes(content)
    verdict = Verdict()
    judge_statistics(verdict, file)
    assert (verdict.problems == []) == is_good


def test_statistics_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    verdict = Verdict()
    judge_statistics(verdict, tmp_path)
    assert "statistics: [Errno" in "".join(verdict.problems)


def test_start_records_in_a_new_or_an_old_folder(tmp_path: Path) -> None:
    verdict = Verdict()
    judge_start(verdict, tmp_path / "captures")
    judge_start(verdict, tmp_path / "captures")
    assert verdict.problems == []
    assert len(list((tmp_path / "captures").iterdir())) == 2


def fail_to_start(*_: object) -> None:
    raise RunError("captures: no")


@pytest.mark.parametrize(
    ("name", "replacement", "problem"),
    [
        ("start", fail_to_start, "start: captures: no"),
        ("put", lambda *_: None, "start: the new capture has the blocks [b'H', b'E']"),
    ],
)
def test_start_without_a_whole_capture_is_refused(
    name: str,
    replacement: Callable[..., None],
    problem: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(recorder.Recorder, name, replacement)
    verdict = Verdict()
    judge_start(verdict, tmp_path)
    assert problem in "".join(verdict.problems)
