"""ASC files as written by the tools of Vector."""

from datetime import datetime
from pathlib import Path

import pytest
from command_line import run
from log_files import opened

from kontronik_can_gw.frames import CanFrame

pytestmark = pytest.mark.promise("logs")

MS = 1_000_000
HEAD = "date Tue Mar 07 10:15:42.400 AM 2023\nbase {} timestamps absolute\ninternal events logged\n"
FD_TAIL = "  0  0   200000 0 0 0 0 0"
LIVE = bytes.fromhex("000000C409001400")


def _read(path: Path, *lines: str, base: str = "hex") -> list[tuple[int, CanFrame, bool]]:
    path.write_text(HEAD.format(base) + "".join(f"   {line}\n" for line in lines))
    with opened(path) as log:
        found = [(item.time_ns // MS, item.frame, item.received) for item in log.frames()]
        assert log.damage == []
    return found


def test_start_line_of_a_can_fd_measurement_is_not_a_frame(tmp_path: Path) -> None:
    path = tmp_path / "fd.asc"
    found = _read(
        path,
        "0.000000 CANFD   Start of measurement",
        "0.010000 CANFD   1 Rx        688                                   "
        "0 0 8 8 00 00 00 C4 09 00 14 00" + FD_TAIL,
        "0.020000 CANFD   1 Tx        12345x  EscLive                       "
        "1 0 9 12 00 01 02 03 04 05 06 07 08 09 0A 0B" + FD_TAIL,
    )
    assert found == [
        (10, CanFrame(0x688, LIVE, fd=True), True),
        (20, CanFrame(0x12345, bytes(range(12)), True, True), False),
    ]
    done = run("convert", path, tmp_path / "out.csv")
    assert done.code == 0, done.err
    assert "damaged" not in done.err, done.err


@pytest.mark.parametrize("base", ["hex", "dec"])
def test_id_of_a_symbolic_name_is_at_the_end_of_the_line(tmp_path: Path, base: str) -> None:
    """The id at the end is decimal in both bases. A name may look like a number, or end with x."""
    data = "00 00 00 C4 09 00 14 00" if base == "hex" else "0 0 0 196 9 0 20 0"
    tail = "  Length = 230000 BitCount = 119 ID = "
    names = [
        ("EscLive", "1672"),
        ("Face", "1673"),
        ("Matrix", "1674"),
        ("Far.Away", "74565x"),
    ]
    found = _read(
        tmp_path / "names.asc",
        *(
            f"0.0{n}0000 1  {name}             Rx   d 8 {data}{tail}{number}"
            for n, (name, number) in enumerate(names)
        ),
        base=base,
    )
    assert found == [
        (0, CanFrame(1672, LIVE), True),
        (10, CanFrame(1673, LIVE), True),
        (20, CanFrame(1674, LIVE), True),
        (30, CanFrame(74565, LIVE, True), True),
    ]


def test_id_is_read_once_when_the_line_repeats_it(tmp_path: Path) -> None:
    tail = "  Length = 230000 BitCount = 119 ID = "
    found = _read(
        tmp_path / "ids.asc",
        f"0.000000 1  688             Rx   d 1 11{tail}1672",
        f"0.001000 1  18EBFF00x       Rx   d 1 22{tail}418119424x",
        f"0.002000 1  123x            Rx   d 1 33{tail}291",
    )
    assert [frame for _, frame, _ in found] == [
        CanFrame(0x688, b"\x11"),
        CanFrame(0x18EBFF00, b"\x22", True),
        CanFrame(0x123, b"\x33", True),
    ]


def test_request_to_send_is_not_a_second_frame(tmp_path: Path) -> None:
    found = _read(
        tmp_path / "requests.asc",
        "0.010000 1  688             TxRq d 8 00 00 00 C4 09 00 14 00",
        "0.010250 1  688             Tx   d 8 00 00 00 C4 09 00 14 00",
        "0.020000 CANFD   1 TxRq      688   0 0 8 8 00 00 00 C4 09 00 14 00" + FD_TAIL,
        "0.021000 CANFD   1 Tx        688   0 0 8 8 00 00 00 C4 09 00 14 00" + FD_TAIL,
    )
    assert found == [
        (10, CanFrame(0x688, LIVE), False),
        (21, CanFrame(0x688, LIVE, fd=True), False),
    ]


@pytest.mark.parametrize(
    ("block", "first", "expected"),
    [
        ("10:15:42.400 AM", "36942.900000", "10:15:42.900"),  # since midnight
        ("10:15:42.400 AM", "36900.000000", "10:15:00.000"),  # before the beginning of the block
        ("10:15:42.400 AM", "0.500000", "10:15:42.900"),
        ("10:15:42.400 AM", "1200.000000", "10:35:42.400"),  # the first frame after 20 min
        ("10:20:42.400 AM", "297.000000", "10:20:39.400"),  # since the date, not the trigger
        ("10:16:12.400 AM", "0.250000", "10:16:12.650"),  # since the beginning of the block
    ],
)
def test_times_count_from_the_moment_that_fits(
    tmp_path: Path,
    block: str,
    first: str,
    expected: str,
) -> None:
    path = tmp_path / "start.asc"
    later = f"{float(first) + 0.01:.6f}"
    begin = f"Begin Triggerblock Tue Mar 07 {block} 2023\n"
    frames = [f"   {at} 1  688   Rx   d 1 11\n" for at in (first, later)]
    path.write_text(HEAD.format("hex") + begin + "".join(frames))
    clock = datetime.strptime(f"2023-03-07 {expected}", "%Y-%m-%d %H:%M:%S.%f")  # noqa: DTZ007
    with opened(path) as log:
        found = list(log.frames())
        wall_ns = log.wall_ns(found[0].time_ns)
    assert found[1].time_ns - found[0].time_ns == 10 * MS
    assert wall_ns is not None
    assert wall_ns // MS == round(clock.timestamp() * 1000)
