"""Captures with right checksums and wrong contents: one line, or what makes sense; never another exception, nor a hang."""

import copy
import itertools
import json
import random
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from capture_bench import START, Bench, made

from kontronik_can_gw.capture import format as capture
from kontronik_can_gw.capture.format import (
    MAGIC,
    Damage,
    Entry,
    Kind,
    Scanner,
    block,
    data_payload,
    json_payload,
)
from kontronik_can_gw.desk.recordings.inputs import CaptureInput, open_input
from kontronik_can_gw.errors import RunError, UserError

VALUES: tuple[Any, ...] = (
    *(None, 0, -1, 10**30, 1.5, 1e308, float("inf"), float("nan"), True, [], [1], {}, {"a": 1}),
    *("", "x", "1/0", "1e9999", "9" * 5000),
)
GONE = object()


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench(*made(2, True)).live(3, 1)


@pytest.fixture(scope="module")
def header(bench: Bench) -> dict[str, Any]:
    state = {
        "escs": [{"energy": 1, "run_time": 2, "losses": 3}] * 2,
        "can_state": 1,
        "started_ns": START,
    }
    times = {"monotonic_ns": START, "wall_ns": START, "created_ns": START}
    more = times | {"run": "r", "part": 0, "devices": [None, None], "state": state}
    found: dict[str, Any] = json.loads(json_payload(bench.setup.header() | more))
    return found


def places(found: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Every place in a JSON document."""
    yield path
    children = dict(enumerate(found)) if isinstance(found, list) else found
    for key in children if isinstance(children, dict) else ():
        yield from places(found[key], (*path, key))


def changed(document: Any, path: tuple[Any, ...], value: Any) -> Any:
    if not path:
        return value
    made_new = copy.deepcopy(document)
    inner = made_new
    for key in path[:-1]:
        inner = inner[key]
    if value is GONE:
        del inner[path[-1]]
    else:
        inner[path[-1]] = value
    return made_new


def read_all(path: Path) -> None:
    """Everything that is read of a capture; only our own errors may come."""
    lines: tuple[str, ...] = ("read",)
    try:
        with open_input(path) as found:
            assert isinstance(found, CaptureInput)
            found.marked = True
            for _ in found.frames():
                pass
            for row in found.samples():
                found.wall_ns(row.time_ns)
            list(found.esc_bytes(1))
            assert found.channel
            assert found.provenance
            assert len(found.damage) < 100
    except (UserError, RunError) as error:
        lines = error.problems
    assert lines and all(line.isprintable() for line in lines)


@pytest.mark.parametrize("seed", range(2))
def test_wrong_header_values(
    seed: int, header: dict[str, Any], bench: Bench, tmp_path: Path
) -> None:
    path = tmp_path / "a.kcap"
    data = block(b"D", 1, data_payload(bench.entries[:40])) + block(b"E", 2, b"")
    combinations = list(itertools.product(places(header), (*VALUES, GONE)))
    random.Random(seed).shuffle(combinations)
    for place, value in combinations[:30]:
        if not place and value is GONE:
            continue
        document = changed(header, place, value)
        path.write_bytes(block(b"H", 0, json.dumps(document).encode()) + data)
        read_all(path)


def test_wrong_entries(header: dict[str, Any], bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "a.kcap"
    rng = random.Random(4)
    for _ in range(10):
        entries = list(bench.entries[:100])
        for _ in range(20):
            at = rng.randrange(len(entries))
            entry = entries[at]
            time_ns = rng.choice([0, 2**64 - 1, 2**62 + 1, rng.randrange(2**64)])
            entries[at] = rng.choice(
                [
                    entry._replace(time_ns=time_ns),
                    entry._replace(kind=rng.randrange(256), flags=rng.randrange(256)),
                    entry._replace(esc=rng.randrange(65536)),
                    entry._replace(data=rng.randbytes(rng.randrange(40))),
                    Entry(entry.time_ns, Kind.START, flags=1),
                    Entry(entry.time_ns, Kind.STATE, 0, b'{"escs": 7}'),
                    Entry(entry.time_ns, Kind.SAVED),
                ]
            )
        path.write_bytes(
            block(b"H", 0, json_payload(header)) + block(b"D", 1, data_payload(entries))
        )
        read_all(path)


def test_what_only_looks_like_blocks_costs_little(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Heads that promise megabytes, one after the other: each would have to be read to its end."""
    head = struct.pack("<4scBHIII", MAGIC, b"D", 0, 0, 8_000_000, 8_000_000, 0) + b"\0\0\0\0"
    data = head * 3000 + bytes(9_000_000)
    costs = [0]
    real = capture._payload

    def counting(buffer: bytearray, deflated: int, stored: int, size: int) -> bytes | None:
        costs[0] += stored
        return real(buffer, deflated, stored, size)

    monkeypatch.setattr(capture, "_payload", counting)
    scanner = Scanner()
    assert all(isinstance(each, Damage) for each in scanner.feed(data) + scanner.flush())
    assert 1 << 27 < costs[0] < 1 << 29, "of 24 GB that are promised"


def test_a_file_of_nothing_but_damage_is_summed_up(header: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / "a.kcap"
    empty = block(b"D", 1, data_payload([]))
    path.write_bytes(block(b"H", 0, json_payload(header)) + (empty + b"x") * 20_000)
    with open_input(path) as found:
        assert list(found.frames()) == []
        assert len(found.damage) < 60
        assert "and more of that kind" in found.damage


def test_a_header_cannot_forge_lines(header: dict[str, Any], bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "a.kcap"
    entries = block(b"D", 1, data_payload(bench.entries))
    for given, shown in (("t1", "t1"), ("can0 123#11\\n(1.0) can0", "can0")):
        forged = changed(header, ("configuration",), f'[can]\nchannel = "{given}"\n')
        path.write_bytes(block(b"H", 0, json_payload(forged)) + entries)
        with open_input(path) as found:
            assert isinstance(found, CaptureInput)
            assert found.channel == shown
    path.write_bytes(
        block(b"H", 0, json_payload(changed(header, ("escs", 0, "name"), "a\nb"))) + entries
    )
    with pytest.raises(UserError, match="header cannot be used"):
        open_input(path)
