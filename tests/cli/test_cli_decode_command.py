"""``kontronik-can-gw decode``: the table that ``convert`` makes of recorded UART bytes, on standard output."""

import os
from pathlib import Path

import pytest
from command_line import refused, run, written

from kontronik_can_gw.esc.kontronik.simulator import SimulatedEsc

# Recorded from a JIVE PRO 120, firmware 1.14, idle.
LIVE = bytes.fromhex("4B4F444C000000008A0900000000000000000000581FE90300001D20000002000C0039234C14")


@pytest.mark.parametrize(("option", "form"), [([], "jsonl"), (["--csv"], "csv")])
def test_it_gives_what_convert_gives(tmp_path: Path, option: list[str], form: str) -> None:
    flight = b"".join(sent.wire for sent in SimulatedEsc().frames_until(20 * 10**9))
    file = written(tmp_path / "flight.bin", flight)
    decoded = run("decode", file, *option)
    assert decoded.code == 0
    assert decoded.out == run("convert", file, "-", "--to", form).out
    assert decoded.out.count("\n") == 2001 + (form == "csv")
    assert "2001 rows" in decoded.err


def test_every_file_is_taken_for_bytes_and_a_line_says_what_they_look_like(tmp_path: Path) -> None:
    inverted = bytes(255 - byte for byte in LIVE) * 9
    done = run("decode", written(tmp_path / "a.log", inverted))
    assert (done.code, done.out) == (1, "")
    assert "bytes but never KOD" in done.err
    assert "24.42" in run("decode", written(tmp_path / "b.log", b"(1.5) can0 123#00\n" + LIVE)).out


def test_an_unreadable_file_gives_one_clear_line_and_exit_code_1(tmp_path: Path) -> None:
    """Within this process, so that root can lay its rights down for the moment: root may read everything."""
    file = tmp_path / "secret"
    file.touch(0)
    run("decode", os.devnull)  # imports what it needs, while that can be read
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    try:
        said = refused(1, "decode", file)
    finally:
        os.seteuid(user)
    assert "Permission denied" in said
