"""The command line as a process: bad input is answered with one clear line and an exit code.

The line names the remedy, and nothing else is written.
"""

import contextlib
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import refused, run

from kontronik_can_gw.cli import make_parser
from kontronik_can_gw.cli.arguments import REMOVED_OPTIONS
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.desk.pty import PtyEsc

pytestmark = pytest.mark.promise("one-line")

PROGRAM = [sys.executable, "-m", "kontronik_can_gw"]
Done = subprocess.CompletedProcess[str]


def configuration(tmp_path: Path, port: object = "/dev/ttyUSB0", **more: str) -> Path:
    """Write a file with the virtual interface and one ESC. ``more`` has lines by table name."""
    file = tmp_path / "gateway.toml"
    tables = {"can": 'interface = "virtual"'} | more
    text = "".join(f"[{name}]\n{lines}\n" for name, lines in tables.items())
    file.write_text(text + f'[[esc]]\nport = "{port}"\n')
    return file


@pytest.fixture
def terminal() -> Iterator[PtyEsc]:
    with PtyEsc() as esc:
        yield esc


# --- usage


@pytest.mark.promise("removed")
@pytest.mark.parametrize("words", ["replay a --on=tape --to=tape", "replay -h --to tape"])
def test_removed_option_is_refused_with_its_replacement(words: str) -> None:
    assert refused(2, *words.split()).startswith("--to: was removed. Type --on can or --on pty. ")
    assert "unrecognized arguments: --to" in refused(2, "schema", "--to")
    assert "does not exist" in refused(2, "decode", "--", "--stats")


@pytest.mark.parametrize("words", ["describe --form json", "service install --root . --chan can1"])
def test_abbreviated_option_is_refused(words: str) -> None:
    """In a script an abbreviation could mean another option after an update."""
    assert f"unrecognized arguments: {words.split()[-2]}" in refused(2, *words.split())


def test_removed_options_are_not_in_use_again() -> None:
    for (command, option), advice in REMOVED_OPTIONS.items():
        name, _, choice = option.partition(" ")
        usage = run(command, "--help").out
        assert not re.search(
            rf"{name}\b" if not choice else rf"{name} {{[^}}]*\b{choice}\b", usage
        ), option
        assert advice.endswith("."), option


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("monitor gateway.toml", "is a configuration, not a recording. Give it with -c gateway"),
        ("monitor my.dbc", "is a DBC, not a recording. Give it with --dbc my.dbc."),
    ],
)
def test_file_that_needs_an_option_names_the_option(words: str, said: str) -> None:
    assert said in refused(2, *words.split())


def test_status_takes_a_configuration_as_run_check_and_doctor_do(tmp_path: Path) -> None:
    file = configuration(tmp_path, tmp_path / "port")
    named = refused(3, "status", file)
    assert named == refused(3, "status", "-c", file)
    assert "no gateway runs with this configuration" in named


# --- ports


def forbidden(path: str, mode: int) -> list[str]:
    """Remove the right to open a terminal from a program started with the returned words.

    A user lacks the right because the bits of the owner are removed from the terminal. Root does
    because the terminal gets another owner, and the words remove the power of root to ignore it.
    """
    if os.geteuid():
        os.chmod(path, mode & 0o077)
        return []
    os.chown(path, 65534, os.stat(path).st_gid)
    os.chmod(path, mode)
    assert shutil.which("setpriv"), "util-linux is needed"
    no_override = "--bounding-set=-dac_override,-dac_read_search"
    return ["setpriv", "--clear-groups", "--regid=65533", no_override]


@pytest.mark.rights
@pytest.mark.parametrize(
    ("mode", "remedy"),
    [(0o660, "Join its group: sudo usermod -aG {} $USER"), (0o600, "chmod g+rw")],
)
def test_port_without_permission_is_reported_with_the_group_to_join(
    tmp_path: Path,
    terminal: PtyEsc,
    mode: int,
    remedy: str,
) -> None:
    with contextlib.suppress(LookupError, PermissionError):
        shutil.chown(terminal.path, group="tty")
    group = Path(terminal.path).group()
    before = forbidden(terminal.path, mode)
    command = [*before, *PROGRAM, "run", "-c", str(configuration(tmp_path, terminal.path))]
    path = os.pathsep.join(filter(None, sys.path))
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": path},
    )
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert f"esc1: {terminal.path}: permission denied" in done.stderr
    assert remedy.format(group) in done.stderr
    assert ("usermod" in done.stderr) == (mode == 0o660)


@pytest.mark.promise("one-device")
def test_two_names_of_one_device_are_refused(tmp_path: Path, terminal: PtyEsc) -> None:
    link = tmp_path / "by-id"
    link.symlink_to(terminal.path)
    file = configuration(tmp_path, terminal.path)
    file.write_text(file.read_text() + f'[[esc]]\nport = "{link}"\n')
    device = os.path.realpath(terminal.path)
    for command in ("check", "run"):
        assert (
            refused(2, command, "-c", file)
            == f"{file}: the ports of esc1 and esc2 are the same device, {device}"
        )


LONG = "x" * 300


@pytest.mark.parametrize(
    "words",
    [
        *(f"convert a {LONG}.csv", f"convert {LONG} a.csv", f"report a -o {LONG}"),
        *(f"monitor {LONG}", f"dbc -o {LONG}", f"check {LONG}", f"service install --root {LONG}"),
    ],
)
def test_name_that_is_too_long_is_reported_in_one_line(
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    done = run(*words.split())
    assert done.code in (1, 2)
    assert done.err.count("\n") == 1
    assert "File name too long" in done.err


def test_missing_can_interface_is_reported_with_the_command_to_create_it(
    tmp_path: Path, terminal: PtyEsc
) -> None:
    file = configuration(tmp_path, terminal.path, can='channel = "nocan7"')
    said = refused(1, "run", "-c", file)
    assert "CAN interface nocan7: " in said
    no_socketcan = "this kernel has no SocketCAN. Try: sudo modprobe -a can_raw vcan" in said
    assert no_socketcan or (
        "does not exist" in said and "ip link set nocan7 up type can bitrate 500000" in said
    )


# --- dbc


def test_dbc_is_written_into_a_pipe_and_replaces_a_link_with_force(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = subprocess.Popen(["cat", str(pipe)], stdout=subprocess.PIPE, text=True)
    try:
        assert run("dbc", "-o", pipe).code == 0
        assert pipe.is_fifo()
        assert reader.communicate(timeout=60)[0].startswith("VERSION")
    finally:
        reader.kill()
    link = tmp_path / "link"
    target = tmp_path / "target"
    link.symlink_to(target)
    for content in (None, "mine"):
        link.unlink(missing_ok=True)
        link.symlink_to(target)
        if content is not None:
            target.write_text(content)
        assert refused(2, "dbc", "-o", link).startswith(f"{link}: exists.")
        assert link.is_symlink()
        assert run("dbc", "-o", link, "--force").code == 0
        assert not link.is_symlink()
        assert link.read_text().startswith("VERSION")
        assert target.exists() == (content is not None)
    assert target.read_text() == "mine"


# --- standard output


def shell(command: str) -> Done:
    command = command.replace("PROGRAM", " ".join(PROGRAM))
    return subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False)


@pytest.mark.promise("closed-ends")
@pytest.mark.parametrize("words", ["schema", "init -", "dbc --esc 1"])
def test_full_disk_at_standard_output_is_reported_in_one_line(words: str) -> None:
    done = shell(f"PROGRAM {words} >/dev/full")
    assert done.returncode == 1, done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    assert "standard output: cannot be written: No space left on device" in done.stderr


def test_closed_standard_output_causes_no_traceback(
    tmp_path: Path,
) -> None:
    done = shell(f"exec PROGRAM init {tmp_path}/a.toml >&-")
    assert done.returncode == 0
    assert "Traceback" not in done.stderr
    done = shell("PROGRAM dbc --esc 8 | head -c 10")
    assert done.stdout == 'VERSION "l'
    assert done.stderr == ""


# --- advice


@pytest.mark.promise("removed")
def test_lines_that_replace_removed_options_are_accepted() -> None:
    advice = " ".join(REMOVED_OPTIONS.values())
    lines = set(
        re.findall(r"(?:[Tt]ype|by) kontronik-can-gw ([a-z](?:'[^']*'|\.\w|[^.:;,'])*)", advice)
    )
    assert len(lines) >= 5
    for line in lines:
        command, *words = shlex.split(line)
        make_parser([command]).parse_args([command, *words])
    keys = set(re.findall(r"Write (\w+ = \S+) into the table \[(\w+)\]", advice))
    assert len(keys) >= 13
    for key, table in keys:
        number = re.sub(r"= [A-Z]+$", "= 5", key)
        parse(tomllib.loads(f'[{table}]\n{number}\n[[esc]]\nport = "a"\n'), "")


# --- CAN adapters


@pytest.mark.promise("one-device")
@pytest.mark.parametrize("words", ["mqtt --broker x", "replay x.bin --on can"])
def test_port_of_an_esc_is_never_opened_as_a_can_adapter(
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Opening some adapters writes to them, and nothing may be written to an ESC."""
    monkeypatch.chdir(tmp_path)
    port = tmp_path / "ttyESC"
    port.touch()
    (tmp_path / "x.bin").write_bytes(b"KODL")
    file = configuration(tmp_path, port)
    adapter = ["--interface", "slcan", "--channel", f"{port}@115200"]
    assert "Nothing may be sent to an ESC" in refused(2, *words.split(), "-c", file, *adapter)
    assert port.read_bytes() == b""


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("simulate --seconds 1000000h", "'1000000h' is too long. Give at most 999999h"),
        ("simulate --seconds 99999999999", "'99999999999' is too long. Give at most 999999h"),
        ("simulate --seconds 1e9", "'1e9' is not a time. Give for example 5s, 200ms or 2min"),
        (
            "convert a b --from 1000000000",
            "'1000000000' is not a number of seconds from 0 to 999999999",
        ),
    ],
)
def test_time_that_is_too_long_is_refused(words: str, said: str) -> None:
    assert f": {said}. Help: " in refused(2, *words.split())


def test_export_that_cannot_be_written_has_a_remedy(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    folder = tmp_path / "file" / "out"
    said = refused(1, "export", "c", folder)
    assert said.endswith(": cannot be written: Not a directory. Give another folder.")
