"""The look through an open port, on pseudo terminals: nothing is written, and what others set up stays."""

import ast
import os
import termios
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from kontronik_can_gw.desk.doctor import ports
from kontronik_can_gw.desk.doctor.ports import look

PACKAGE = Path(ports.__file__).parent


@pytest.fixture
def terminal() -> Iterator[tuple[int, int, str]]:
    """Both ends of a pseudo terminal as it is made, with echo, and its name."""
    master, slave = os.openpty()
    os.set_blocking(master, False)
    yield master, slave, os.ttyname(slave)
    os.close(master)
    os.close(slave)


def received(master: int) -> bytes:
    try:
        return os.read(master, 100)
    except BlockingIOError:
        return b""


def test_nothing_is_written_and_no_echo_stays(terminal: tuple[int, int, str]) -> None:
    master, slave, name = terminal
    assert look(name, alone=True)[0] == "none", "a pseudo terminal has no parity"
    os.write(master, b"KODL\r\n")
    assert received(master) == b""
    assert not termios.tcgetattr(slave)[3] & (termios.ECHO | termios.ICANON)


def test_a_port_that_somebody_may_have_set_up_is_not_touched(
    terminal: tuple[int, int, str],
) -> None:
    _, slave, name = terminal
    tty.setraw(slave)
    before = termios.tcgetattr(slave)
    assert look(name, alone=False)[0] == "set_up"
    assert termios.tcgetattr(slave) == before


def test_what_cannot_be_opened_is_reported(tmp_path: Path) -> None:
    assert look(str(tmp_path / "none"), alone=True)[0] == "No such file or directory"
    assert "not a working serial port" in look(os.devnull, alone=True)[0]


def test_no_module_of_doctor_can_write_to_a_device() -> None:
    """No call of a write method; the one place that opens a device opens it for reading."""
    modules = sorted(PACKAGE.glob("*.py"))
    assert len(modules) > 5
    for path in modules:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        calls = [node.func for node in ast.walk(tree) if isinstance(node, ast.Call)]
        methods = {call.attr for call in calls if isinstance(call, ast.Attribute)}
        assert not any(name.startswith(("write", "send", "tcsend")) for name in methods), path.name
        names = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
        assert not names & {"O_RDWR", "O_WRONLY", "O_CREAT"}, path.name
        if "open" in methods or any(
            isinstance(call, ast.Name) and call.id == "open" for call in calls
        ):
            assert path.name == "ports.py"


def test_even_parity_is_known_by_what_is_read_back() -> None:
    eight_even = termios.CS8 | termios.PARENB | termios.CREAD
    wrong = (
        (termios.CS8, termios.B115200),
        (termios.CS7 | termios.PARENB, termios.B115200),
        (eight_even | termios.PARODD, termios.B115200),
        (eight_even | termios.CSTOPB, termios.B115200),
        (eight_even, termios.B9600),
    )
    assert ports._is_ours([0, 0, eight_even, 0, termios.B115200, termios.B115200])
    assert not any(ports._is_ours([0, 0, flags, 0, speed, speed]) for flags, speed in wrong)
