"""All intact frames of a damaged log are read, and the damage is reported.

Of BLF and MF4 only the frames before the damage are read. The only exception is UserError.
"""

import random
import re
import struct
from pathlib import Path

import can
import pytest
from log_files import SUFFIX, Item, at_wall, message_of, read_log, some_frames, write_log

from kontronik_can_gw.errors import UserError

pytestmark = pytest.mark.promise("damaged-logs")

OWN = ["candump", "asc", "trc", "blf"]
TEXT = ["candump", "asc", "trc"]


def _log(tmp_path: Path, format_: str, count: int) -> tuple[Path, list[Item], bytes]:
    items = some_frames(count)
    path = tmp_path / f"log{SUFFIX[format_]}"
    write_log(path, format_, items)
    return path, at_wall(items), path.read_bytes()


def _is_part(found: list[Item], items: list[Item]) -> bool:
    """Return True if ``found`` is ``items`` without some of them, in the same order."""
    rest = iter(items)
    return all(any(item == other for other in rest) for item in found)


@pytest.mark.parametrize("format_", OWN)
def test_cut_file_gives_all_frames_before_the_cut(tmp_path: Path, format_: str) -> None:
    path, items, content = _log(tmp_path, format_, 8)
    others = content.count(b"\n") - len(items) - (format_ == "asc")
    for cut in range(len(content)):
        path.write_bytes(content[:cut])
        try:
            found, damage = read_log(path)
        except UserError:  # not even its first line
            continue
        if format_ in TEXT:
            assert len(found) >= min(content[:cut].count(b"\n") - others, len(items))
            if not content[:cut].endswith(b"\n"):
                # the last number of a cut line may be shorter, which cannot be detected
                found = found[:-1]
        else:
            assert damage
        expected = items[: len(found)]
        assert [item[1:] for item in found] == [item[1:] for item in expected]


@pytest.mark.parametrize("format_", TEXT)
@pytest.mark.parametrize(
    "rubbish", [b"\0" * 10_000, b"hello\n", bytes(range(256)) * 3 + b"\n", b"\n\n", b"(1.5) \n"]
)
def test_rubbish_between_lines_loses_no_frame(tmp_path: Path, format_: str, rubbish: bytes) -> None:
    path, items, content = _log(tmp_path, format_, 40)
    at = content.index(b"\n", len(content) // 2) + 1
    path.write_bytes(content[:at] + rubbish + content[at:])
    found, damage = read_log(path)
    assert len(found) >= len(items) - (not rubbish.endswith(b"\n"))
    assert _is_part(found, items)
    if rubbish.strip():
        assert len(damage) == 1
        assert "damaged line" in damage[0]


@pytest.mark.parametrize(
    ("place", "bits", "lost", "told"),
    [
        (35, b"\x10", slice(9, 10), "1 damaged frame left out"),
        (8, struct.pack("<L", 5000), slice(9, 30), "the last frame is cut off"),
        *(
            (8, struct.pack("<L", n), slice(9, 30),
             f"damaged after 9 frames (an object of {n} bytes)")
            for n in (0, 31, (1 << 20) + 1, 0xFFFFFFFF)
        ),
    ],
)  # fmt: skip
def test_frames_before_the_damage_of_a_blf_file_are_read(
    tmp_path: Path,
    place: int,
    bits: bytes,
    lost: slice,
    told: str,
) -> None:
    """python-can alone never ends at an object of size 0, and accepts a frame with a DLC of 16."""
    items = at_wall(some_frames(30))
    path = tmp_path / "log.blf"
    with can.BLFWriter(path, compression_level=0) as writer:
        for item in items:
            writer.on_message_received(message_of(item))
    content = bytearray(path.read_bytes())
    objects = [found.start() for found in re.finditer(b"LOBJ", content)]
    at = objects[10]  # the tenth frame, because the first object is the container
    content[at + place : at + place + len(bits)] = bits
    path.write_bytes(content)
    found, damage = read_log(path)
    frames = [item[1] for item in items]
    del frames[lost]
    assert [item[1] for item in found] == frames
    assert damage == [told]


@pytest.mark.parametrize("format_", [*OWN, "mf4"])
def test_no_damage_raises_anything_but_a_user_error(tmp_path: Path, format_: str) -> None:
    path, _, content = _log(tmp_path, format_, 40)
    chance = random.Random(7)
    for _ in range(15 if format_ == "mf4" else 200):
        damaged = bytearray(content)
        for _ in range(chance.choice((1, 1, 3, 20))):
            at = chance.randrange(len(damaged))
            most = chance.randrange(40)
            flipped = bytes((damaged[at] ^ 1 << chance.randrange(8),))
            instead = chance.choice((flipped, chance.randbytes(most), b""))
            replaced = chance.choice((1, 0, most))
            damaged[at : at + replaced] = instead
        path.write_bytes(damaged)
        problem = ""
        try:
            read_log(path)
        except UserError as error:  # the head of the file is damaged
            problem = str(error)
        assert "\n" not in problem


@pytest.mark.parametrize(
    ("moved", "lost"),
    [
        ({0: 400, 10: 900, 11: 950, 20: 1400}, [0, 10, 11, 20]),
        (dict.fromkeys(range(15, 30), 9999), []),
    ],
    ids=["damaged times are left out", "a clock that was set leaves nothing out"],
)
def test_time_far_away_is_accepted_if_the_next_time_agrees(
    tmp_path: Path,
    moved: dict[int, int],
    lost: list[int],
) -> None:
    """``moved`` has the days by which the times of frames are wrong."""
    items = at_wall(some_frames(30))
    for number, days in moved.items():
        time_ns, *rest = items[number]
        items[number] = (time_ns + days * 86_400 * 10**9, *rest)  # type: ignore[assignment]
    path = tmp_path / "log.log"
    write_log(path, "candump", items, 0)
    found, damage = read_log(path)
    assert [number for number, item in enumerate(items) if item not in found] == lost
    assert damage == ["4 frames with an impossible time left out"] * bool(lost)


@pytest.mark.parametrize("size", [15, 0x7FFFFFFF, 0xFFFFFFFF])
def test_container_of_an_impossible_size_is_reported_as_damage(tmp_path: Path, size: int) -> None:
    """python-can reads the rest of the file as one container, and unpacks the first one in it."""
    items = at_wall(some_frames(9_000))
    path = tmp_path / "log.blf"
    write_log(path, "blf", some_frames(9_000))
    content = bytearray(path.read_bytes())
    assert content.count(b"LOBJ", 144) > 2
    content[152:156] = struct.pack("<L", size)
    path.write_bytes(content)
    found, damage = read_log(path)
    assert found == items[: len(found)]
    assert 1000 < len(found) < len(items)
    assert damage[0] == f"the container at byte 144 has the impossible size {size}"


TRC = ";$FILEVERSION={}\n;$STARTTIME=45244.0\n;$COLUMNS=N,O,T,I,d,L,D\n{}\n"


@pytest.mark.parametrize(
    "line",
    [
        *(f"2 {time} DT 0123 Rx 1 22" for time in ("1e999", "-inf", "nan", "1e300")),
        "2 2.0 DT 0123 Rx 2 11 22 33 44 55 66 77 88",
        "2 2.0 DT 0123 Rx 8 11 22 33",
        "2 2.0 FD 0123 Rx 15 " + "11 " * 48,
        "2 2.0 FD 0123 Rx 9 " + "11 " * 9,
    ],
)
def test_trc_line_with_an_impossible_time_or_length_is_damaged(tmp_path: Path, line: str) -> None:
    path = tmp_path / "log.trc"
    last = "3 3.0 FD 0124 Rx 15 " + "22 " * 64
    lines = f"1 1.0 DT 0123 Rx 1 11\n{line}\n{last}"
    path.write_text(TRC.format("2.1", lines))
    found, damage = read_log(path)
    assert [item[1].data for item in found] == [b"\x11", b"\x22" * 64]
    assert damage == ["1 damaged line: 5"]


@pytest.mark.parametrize(
    ("version", "count", "damage"), [("1.0", 2, []), ("1.2", 0, ["its file version is unknown"])]
)
def test_trc_of_version_1_0_is_read_if_its_header_names_the_version(
    tmp_path: Path,
    version: str,
    count: int,
    damage: list[str],
) -> None:
    path = tmp_path / "log.trc"
    lines = "  1)    1.0  0123  2  00 11\n  2)    2.0  0123  1  RTR\n  3)    3.0  00000124  1  22"
    path.write_text(TRC.format(version, lines))
    found, said = read_log(path)
    assert len(found) == count
    assert said == damage
