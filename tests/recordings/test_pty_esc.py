"""The pseudo terminal of a simulated ESC: bytes pass unchanged, and an echo is noticed.

Bytes that a gateway sends to the ESC are tested in tests/cli.
"""

import os
import termios
from collections.abc import Iterator
from pathlib import Path

import pytest

from kontronik_can_gw.desk.pty import PtyEsc

pytestmark = pytest.mark.promise("silent-to-esc")

ALL_BYTES = bytes(range(256))


@pytest.fixture
def esc() -> Iterator[PtyEsc]:
    with PtyEsc() as terminal:
        yield terminal


def read_exactly(path: str | Path, size: int) -> bytes:
    fd = os.open(path, os.O_RDONLY | os.O_NOCTTY)
    try:
        data = b""
        while len(data) < size:
            data += os.read(fd, size - len(data))
        return data
    finally:
        os.close(fd)


def test_every_byte_passes_and_an_echo_is_noticed(
    esc: PtyEsc,
) -> None:
    assert esc.write(ALL_BYTES)
    assert read_exactly(esc.path, 256) == ALL_BYTES
    assert esc.check() == 0
    fd = os.open(esc.path, os.O_RDWR | os.O_NOCTTY)
    mode = termios.tcgetattr(fd)
    mode[3] |= termios.ECHO
    termios.tcsetattr(fd, termios.TCSANOW, mode)
    esc.write(b"KODL")
    assert read_exactly(esc.path, 4) == b"KODL"
    os.close(fd)
    assert esc.check() == esc.received == 4


def test_unread_bytes_are_dropped_and_counted_and_never_block(esc: PtyEsc) -> None:
    written = refused = 0
    while refused < 20:
        # the kernel moves bytes between its buffers, so it may accept some after a refusal
        refused += not esc.write(bytes(1000))
        written += 1000
        assert written < 10_000_000
    assert 0 < esc.dropped_bytes < written
    assert read_exactly(esc.path, written - esc.dropped_bytes) == bytes(written - esc.dropped_bytes)
    assert esc.write(b"again")
    assert read_exactly(esc.path, 5) == b"again"


def test_link_leads_to_its_terminal_and_is_removed_with_it(
    tmp_path: Path,
) -> None:
    link = tmp_path / "esc1"
    link.symlink_to("/nowhere/at/all")
    with PtyEsc(link) as terminal:
        assert str(link.readlink()) == terminal.path
        terminal.write(b"x")
        assert read_exactly(link, 1) == b"x"
        second = PtyEsc(link)
    assert str(link.readlink()) == second.path
    second.close()
    assert list(tmp_path.iterdir()) == []
