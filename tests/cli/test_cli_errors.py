"""The command line as a process: bad input gives one clear line with the remedy, the right exit code and nothing else."""

import contextlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import cantools.database
import jsonschema
import pytest

from kontronik_can_gw import __version__
from kontronik_can_gw.cli import COMMANDS, main
from kontronik_can_gw.config import load, schema, shipped
from kontronik_can_gw.offline.pty import PtyEsc

PROGRAM = [sys.executable, "-m", "kontronik_can_gw"]
DBC = shipped("dbc/kontronik_esc.dbc")
Done = subprocess.CompletedProcess[str]


def program(*words: object, before: Sequence[str] = (), cwd: Path | None = None) -> Done:
    command = [*before, *PROGRAM, *map(str, words)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "COLUMNS": "200"}
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, cwd=cwd, env=environment)


def inside(*words: object) -> Done:
    """The same within this process, where no process of its own is needed: an exception fails the test."""
    out, talk = io.StringIO(), io.StringIO()
    code: object
    with redirect_stdout(out), redirect_stderr(talk):
        try:
            code = main(list(map(str, words)))
        except SystemExit as end:
            code = end.code
    return Done([], code if isinstance(code, int) else 0, out.getvalue(), talk.getvalue())


def one_line(done: Done, code: int) -> str:
    """What a failed program said: one line, and nothing on standard output."""
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1, done.stderr
    assert done.returncode == code, done.stderr
    return done.stderr.strip()


def configuration(tmp_path: Path, port: object = "/dev/ttyUSB0", **more: str) -> Path:
    """A file with the virtual interface and one ESC; ``more``: table name = lines."""
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


def test_no_command_is_told_with_the_usage() -> None:
    done = program()
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.splitlines()[-1].endswith("error: the following arguments are required: COMMAND")


def test_an_unknown_command_is_told_with_those_there_are() -> None:
    done = program("rum")
    assert (done.returncode, done.stdout) == (2, "")
    assert "invalid choice: 'rum'" in done.stderr
    assert all(name in done.stderr for name in COMMANDS)


@pytest.mark.parametrize("command", list(COMMANDS))
def test_an_unknown_option_is_named(command: str) -> None:
    needed = {
        "run": ["-c", "x"],
        "check": ["-c", "x"],
        "doctor": ["-c", "x"],
        "decode": ["-"],
        "convert": ["x", "y.csv"],
        "report": ["x"],
        "replay": ["x", "--to", "log"],
        "service": ["status"],
        "completion": ["bash"],
    }.get(command, [])
    done = inside(command, *needed, "--no-such-option")
    assert (done.returncode, done.stdout) == (2, "")
    assert "Traceback" not in done.stderr
    assert "unrecognized arguments: --no-such-option" in done.stderr.splitlines()[-1]


@pytest.mark.parametrize("command", ["run", "check", "doctor"])
def test_a_configuration_is_required(command: str) -> None:
    done = inside(command)
    assert (done.returncode, done.stdout) == (2, "")
    assert "-c/--config" in done.stderr.splitlines()[-1]


OPTIONS = {
    "demo": ["--seconds", "--seed"],
    "run": ["-c", "--config", "--wait", "--status", "--record"],
    "check": ["-c", "--config"],
    "init": ["FILE", "--force"],
    "dbc": [
        *("-c", "--config", "--canopen", "--from", "--esc", "--name", "--base-id", "--id-step", "--node"),
        *("-o", "--output"),
    ],
    "eds": ["-c", "--config", "--node-id", "-o", "--output"],
    "convert": [
        *("IN", "OUT", "--to", "--force", "-q", "--quiet", "-c", "--config", "--dbc", "--from", "--until", "--esc"),
        *("--signals", "--rate", "--frames", "--units-line", "--live-rate"),
    ],
    "report": [
        *(
            "IN",
            "-o",
            "--output",
            "--png",
            "--force",
            "-c",
            "--config",
            "--dbc",
            "--points",
            "--title",
            "--from",
            "--to",
            "--until",
        ),
    ],
    "decode": ["FILE", "--csv", "--stats"],
    "replay": [
        *("FILE", "--to", "-c", "--config", "--dbc", "--speed", "--interface", "--channel", "--unmarked", "--link"),
        *("--delay", "-o", "--output", "--force"),
    ],
    "simulate": [
        *("--esc", "--device", "--layout", "--variant", "--firmware", "--cells", "--rate", "--info-every"),
        *("--info-replaces", "--idle", "--seconds", "--seed", "--link", "--out", "--noise", "--lose-bytes"),
        *("--flip-bits", "--dropout", "--error", "--swap-device"),
    ],
    "mqtt": [
        *(
            "FILE",
            "-c",
            "--config",
            "--dbc",
            "--interface",
            "--channel",
            "--broker",
            "--tls",
            "--ca-file",
            "--cert-file",
        ),
        *("--key-file", "--username", "--password-file", "--gateway", "--topic", "--rate", "--retain", "--discovery"),
        "--remove-discovery",
    ],
    "schema": ["-h"],
    "describe": ["-c", "--config", "--dbc", "--format", "-o", "--output"],
    "completion": ["SHELL"],
    "service": ["ACTION"],
    "doctor": ["-c", "--config", "--json"],
    "status": ["-c", "--config", "--file", "--json", "--once", "--interval"],
    "monitor": [
        *(
            "FILE",
            "-c",
            "--config",
            "--dbc",
            "--interface",
            "--channel",
            "--speed",
            "--once",
            "--timeout",
            "--interval",
        ),
    ],
}


def test_the_help_lists_the_commands() -> None:
    done = program("--help")
    assert (done.returncode, done.stderr) == (0, "")
    for name, line in COMMANDS.items():
        assert re.search(rf"^ +{name} +{re.escape(line)}", done.stdout, re.MULTILINE)


@pytest.mark.parametrize("command", list(COMMANDS))
def test_the_help_of_a_command_mentions_each_option_and_no_other(command: str) -> None:
    done = inside(command, "--help")
    assert (done.returncode, done.stderr) == (0, "")
    for option in OPTIONS[command]:
        assert re.search(rf"(?<!\S){option}\b", done.stdout), option
    listed = set(re.findall(r"^ +(--?[a-z-]+)|, (--[a-z-]+)", done.stdout, re.MULTILINE))
    found = {a or b for a, b in listed} - {"-h", "--help"}
    assert found <= set(OPTIONS[command])


def test_the_version_is_that_of_the_package() -> None:
    done = program("--version")
    assert (done.returncode, done.stdout, done.stderr) == (0, f"kontronik-can-gw {__version__}\n", "")


# --- ports


def test_a_missing_port_is_named_with_where_to_look(tmp_path: Path) -> None:
    said = one_line(program("run", "-c", configuration(tmp_path, tmp_path / "ttyUSB9")), 1)
    assert f"esc1: {tmp_path}/ttyUSB9: no such serial port." in said
    assert "/dev/serial/by-id" in said


@pytest.mark.parametrize("kind", ["file", "directory", "pipe", "null"])
def test_what_is_no_serial_port_is_told_so_with_where_to_look(tmp_path: Path, kind: str) -> None:
    port = tmp_path / "port"
    if kind == "file":
        port.write_bytes(b"x")
    elif kind == "directory":
        port.mkdir()
    elif kind == "pipe":
        os.mkfifo(port)
    else:
        port = Path("/dev/null")
    said = one_line(program("run", "-c", configuration(tmp_path, port)), 1)
    assert f"esc1: {port}: is not a serial port" in said
    assert "/dev/serial/by-id" in said


def test_a_second_gateway_on_a_port_is_told_who_has_it(tmp_path: Path, terminal: PtyEsc) -> None:
    file = configuration(tmp_path, terminal.path)
    first = subprocess.Popen([*PROGRAM, "run", "-c", str(file)], stderr=subprocess.PIPE, text=True)
    try:
        assert first.stderr is not None
        while line := first.stderr.readline():
            if f"{terminal.path} is open" in line:
                break
        assert first.poll() is None
        said = one_line(program("run", "-c", file), 1)
        assert f"esc1: {terminal.path}: is in use by another program" in said
        assert f"(pid {first.pid})" in said
        assert first.poll() is None
    finally:
        first.terminate()
        assert first.wait(10) == 0
        if first.stderr is not None:
            first.stderr.close()


def forbidden(path: str, mode: int) -> list[str]:
    """Take the right to open a terminal from the program that is started with the words returned.

    A user is kept out by the owner's bits of his own terminal; root by another owner, without root's power to override that.
    """
    if os.geteuid():
        os.chmod(path, mode & 0o077)
        return []
    os.chown(path, 65534, os.stat(path).st_gid)
    os.chmod(path, mode)
    assert shutil.which("setpriv"), "util-linux is needed"
    return ["setpriv", "--clear-groups", "--regid=65533", "--bounding-set=-dac_override,-dac_read_search"]


def test_a_port_without_permission_names_the_group_to_join(tmp_path: Path, terminal: PtyEsc) -> None:
    with contextlib.suppress(LookupError, PermissionError):
        shutil.chown(terminal.path, group="tty")
    group = Path(terminal.path).group()
    before = forbidden(terminal.path, 0o660)
    said = one_line(program("run", "-c", configuration(tmp_path, terminal.path), before=before), 1)
    assert f"esc1: {terminal.path}: permission denied. Join its group: sudo usermod -aG {group} $USER" in said


def test_a_port_that_its_group_may_not_use_either_is_not_told_to_join_the_group(
    tmp_path: Path, terminal: PtyEsc
) -> None:
    before = forbidden(terminal.path, 0o600)
    said = one_line(program("run", "-c", configuration(tmp_path, terminal.path), before=before), 1)
    assert f"esc1: {terminal.path}: permission denied" in said
    assert "usermod" not in said
    assert "chmod g+rw" in said


def test_one_missing_port_of_two_leaves_nothing_running(tmp_path: Path, terminal: PtyEsc) -> None:
    file = configuration(tmp_path, terminal.path)
    file.write_text(file.read_text() + f'[[esc]]\nport = "{tmp_path}/none"\n')
    said = one_line(program("run", "-c", file), 1)
    assert f"esc2: {tmp_path}/none: no such serial port" in said
    assert terminal.check() == 0


# --- CAN interface


def test_socketcan_that_is_not_there_is_told_with_the_command_that_makes_it(tmp_path: Path, terminal: PtyEsc) -> None:
    file = configuration(tmp_path, terminal.path, can='channel = "nocan7"')
    said = one_line(program("run", "-c", file), 1)
    assert "CAN interface nocan7: " in said
    no_socketcan = "this kernel has no SocketCAN. Try: sudo modprobe -a can_raw vcan" in said
    assert no_socketcan or ("there is none" in said and "ip link set nocan7 up type can bitrate 500000" in said)


def test_an_interface_python_can_does_not_know_is_a_mistake_of_the_configuration(
    tmp_path: Path, terminal: PtyEsc
) -> None:
    said = one_line(program("run", "-c", configuration(tmp_path, terminal.path, can='interface = "sockecan"')), 2)
    assert "sockecan" in said
    assert "Did you mean socketcan?" in said


# --- configuration and DBC


@pytest.mark.parametrize("command", ["run", "check", "dbc"])
def test_bad_configurations_are_one_line_each(tmp_path: Path, command: str) -> None:
    file = tmp_path / "a.toml"
    for content, expected in (
        (b"", "at least one [[esc]]"),
        (b"\x7fELF\xff\xfe\0", "is not a text file in UTF-8"),
        (b"\0\0", "is not valid TOML"),
        (b"[can]\nchannel = can0", "(at line 2, "),
        (b"a = " + b"1" * 5000, "is not valid TOML"),
    ):
        file.write_bytes(content)
        said = one_line(inside(command, "-c", file), 2)
        assert said.startswith(f"kontronik-can-gw {command}: {file}: ")
        assert expected in said
    said = one_line(inside(command, "-c", tmp_path / "none.toml"), 2)
    assert "none.toml: cannot be read: No such file or directory. `kontronik-can-gw init` writes an example." in said
    assert "Is a directory" in one_line(inside(command, "-c", tmp_path), 2)


def test_a_bad_configuration_ends_the_gateway_with_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_bytes(b"\x7fELF\xff\xfe\0")
    assert "is not a text file" in one_line(program("run", "-c", tmp_path / "a.toml"), 2)


def test_all_mistakes_of_a_configuration_are_told_line_by_line(tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    file.write_text('[can]\nbitrte = 1\n[[esc]]\nprot = "x"\n')
    done = program("run", "-c", file)
    assert (done.returncode, done.stdout) == (2, "")
    assert [line.split(": ")[2] for line in done.stderr.splitlines()] == ["can.bitrte", "esc[1].prot", "esc[1].port"]


FOREIGN = 'VERSION ""\nBU_: Other Gw\nBO_ 100 Foreign: 8 {sender}\n SG_ Speed : 0|8@1+ (1,0) [0|255] "" Gw\n'
DBCS: list[tuple[bytes | None, str, str]] = [
    (None, "", "cannot be read: No such file or directory"),
    (b"", "", "DBC"),
    (b"\x7fELF\0\0", "", "is a binary file, not a DBC"),
    (b"hello, world\n", "", "is not a DBC that can be read"),
    (b'{"a": 1}', "", "is not a DBC that can be read"),
    (FOREIGN.format(sender="Other").encode(), 'node = "Gw"', "no message is sent by node 'Gw'; nodes that send: Other"),
    (FOREIGN.format(sender="Vector__XXX").encode(), "", ""),
]


@pytest.mark.parametrize(("content", "more", "expected"), DBCS)
def test_a_file_that_is_no_dbc_of_ours_is_told_so(
    tmp_path: Path, content: bytes | None, more: str, expected: str
) -> None:
    if content is not None:
        (tmp_path / "my.dbc").write_bytes(content)
    file = configuration(tmp_path, dbc=f'file = "my.dbc"\n{more}')
    for command in ("run", "check"):
        said = one_line(inside(command, "-c", file), 2)
        assert f"{tmp_path}/my.dbc: " in said
        assert expected in said


def test_a_dbc_path_that_is_a_directory_is_told_so(tmp_path: Path) -> None:
    assert "Is a directory" in one_line(inside("check", "-c", configuration(tmp_path, dbc='file = "."')), 2)


def test_more_than_the_bus_can_carry_is_refused_and_more_than_half_is_warned_of(tmp_path: Path) -> None:
    file = configuration(tmp_path, can='interface = "virtual"\nbitrate = 20_000')
    for command in ("run", "check", "dbc"):
        said = one_line(inside(command, "-c", file), 2)
        assert re.search(r"need \d{3}% of 20 kbit/s", said)
        assert "can.bitrate" in said
    done = inside("check", "-c", configuration(tmp_path, can='interface = "virtual"\nbitrate = 50_000'))
    assert done.returncode == 0
    assert re.fullmatch(r"kontronik-can-gw: warning: .* need \d\d% of 50 kbit/s; .*\n", done.stderr)


@pytest.mark.parametrize("constant", ["inf", "nan", "1e400"])
def test_an_infinite_constant_is_refused_as_any_other_wrong_value(tmp_path: Path, constant: str) -> None:
    file = configuration(tmp_path, **{"dbc.bind": f'"EscShaft.MotorSpeed" = {constant}'})
    said = one_line(inside("check", "-c", file), 2)
    assert "EscShaft.MotorSpeed" in said


# --- init, check, schema


def test_init_writes_the_example_once_and_replaces_it_only_when_forced(tmp_path: Path) -> None:
    done = program("init", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, "")
    assert "kontronik-can-gw check -c gateway.toml" in done.stderr
    file = tmp_path / "gateway.toml"
    assert load(file).esc[0].pole_pairs == 7
    file.write_text("mine")
    said = one_line(program("init", cwd=tmp_path), 2)
    assert "gateway.toml: exists. Give another name, or --force to replace it." in said
    assert file.read_text() == "mine"
    assert program("init", "--force", cwd=tmp_path).returncode == 0
    example = file.read_text()
    assert program("init", "-").stdout == example
    assert os.listdir(tmp_path) == ["gateway.toml"]


def test_init_where_nothing_can_be_written_is_one_line(tmp_path: Path) -> None:
    said = one_line(inside("init", tmp_path / "none" / "a.toml"), 1)
    assert f"{tmp_path}/none/a.toml: cannot be written: No such file or directory" in said
    assert "Is a directory" in one_line(inside("init", "--force", tmp_path), 1)
    closed = tmp_path / "closed"
    closed.mkdir()
    before = forbidden(str(closed), 0o755) if not os.geteuid() else []
    closed.chmod(0o755 if not os.geteuid() else 0o555)
    assert "Permission denied" in one_line(program("init", closed / "a.toml", before=before), 1)


def test_check_shows_the_effective_configuration_the_messages_and_the_bus_load(tmp_path: Path) -> None:
    file = tmp_path / "gateway.toml"
    inside("init", file)
    done = inside("check", "-c", file)
    assert (done.returncode, done.stderr) == (0, "")
    effective, _, rest = done.stdout.partition("\n# messages of ")
    assert tomllib.loads(effective)["esc"][0]["telemetry_timeout_ms"] == 250
    for message in cantools.database.load_file(DBC).messages:  # type: ignore[union-attr]
        line = re.search(rf"^{message.name} +{message.frame_id:X}h +(\S.*)$", rest, re.MULTILINE)
        assert line, message.name
        assert all(re.search(rf"\b{signal.name}\b", rest) for signal in message.signals)
    assert re.search(r"^# bus load \d+\.\d% of 500 kbit/s", rest, re.MULTILINE)


def test_check_of_two_escs_says_whose_value_each_signal_is(tmp_path: Path) -> None:
    file = configuration(tmp_path)
    file.write_text(file.read_text() + 'name = "left"\n[[esc]]\nport = "y"\nname = "right"\n')
    done = inside("check", "-c", file)
    assert (done.returncode, done.stderr) == (0, "")
    for name in ("left", "right"):
        assert re.search(rf"{name.title()}ElectricalSpeed +{name}\.electrical_speed 1/min", done.stdout)
    assert len(re.findall(r"^GatewayStatus ", done.stdout, re.MULTILINE)) == 1


def test_names_with_which_a_value_would_be_taken_from_the_wrong_esc_are_refused(tmp_path: Path) -> None:
    file = configuration(tmp_path)
    file.write_text(file.read_text() + 'name = "a"\n[[esc]]\nport = "y"\nname = "a_max"\n')
    assert "ambiguous" in one_line(inside("check", "-c", file), 2)
    assert "ambiguous" in one_line(inside("dbc", "--name", "a", "--name", "a_max"), 2)


def test_schema_is_the_json_schema_of_the_configuration() -> None:
    done = program("schema")
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout) == schema()
    jsonschema.Draft202012Validator.check_schema(json.loads(done.stdout))


# --- dbc


@pytest.mark.parametrize("count", [1, 2, 8])
def test_the_dbc_of_several_escs_is_read_by_cantools_at_its_strictest(tmp_path: Path, count: int) -> None:
    file = tmp_path / "out.dbc"
    done = inside("dbc", "--esc", count, "-o", file)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", f"kontronik-can-gw: {file} written\n")
    database = cantools.database.load_file(file, strict=True)
    assert isinstance(database, cantools.database.can.Database)
    of_one = cantools.database.load_file(DBC, strict=True)
    assert isinstance(of_one, cantools.database.can.Database)
    assert len(database.messages) == 11 * count + 2
    assert len(of_one.messages) == 13
    assert len({message.frame_id for message in database.messages}) == len(database.messages)
    assert all(0x680 <= message.frame_id <= 0x6DF for message in database.messages)
    assert inside("dbc", "--esc", count).stdout == file.read_text()
    assert os.listdir(tmp_path) == ["out.dbc"]


def test_the_dbc_of_a_configuration_is_what_its_gateway_sends(tmp_path: Path) -> None:
    file = configuration(tmp_path, dbc="base_id = 0x100\nid_step = 128")
    file.write_text(file.read_text() + 'name = "left"\n[[esc]]\nport = "y"\nname = "right"\n')
    done = inside("dbc", "-c", file)
    assert (done.returncode, done.stderr) == (0, "")
    database = cantools.database.load_string(done.stdout, "dbc", strict=True)
    assert isinstance(database, cantools.database.can.Database)
    checked = dict(re.findall(r"^(\w+) +([0-9A-F]{3})h ", inside("check", "-c", file).stdout, re.MULTILINE))
    assert checked == {message.name: f"{message.frame_id:03X}" for message in database.messages}
    assert database.get_message_by_name("LeftStatus").frame_id == 0x100


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--esc", "2", "--name", "a"], "--name is given 1 times for 2 ESCs"),
        (["--name", "a", "--name", "A"], "--name: "),
        (["--from", "/none.dbc"], "/none.dbc: cannot be read"),
        (["--node", "Nobody"], "no message is sent by node 'Nobody'"),
        (["--esc", "2", "--id-step", "8"], "Take another step"),
        (["--esc", "128"], ""),
    ],
)
def test_bad_wishes_for_a_dbc_are_one_line(words: list[str], expected: str) -> None:
    done = inside("dbc", *words)
    assert (done.returncode, done.stdout) == (2, "")
    assert "Traceback" not in done.stderr
    assert all(line.startswith("kontronik-can-gw dbc: ") for line in done.stderr.splitlines())
    assert expected in done.stderr


@pytest.mark.parametrize(
    "words",
    [
        ["--esc", "0"],
        ["--esc", "129"],
        ["--esc", "two"],
        ["--name", "1a"],
        ["--name", "a b"],
        ["--base-id", "x"],
        ["--base-id", "0x20000000"],
        ["--id-step", "-1"],
    ],
)
def test_arguments_of_the_wrong_kind_are_named_with_their_option(words: list[str]) -> None:
    done = inside("dbc", *words)
    assert (done.returncode, done.stdout) == (2, "")
    assert f"{words[0]}: " in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr


def test_options_that_a_configuration_says_already_are_refused_beside_it(tmp_path: Path) -> None:
    said = one_line(inside("dbc", "-c", configuration(tmp_path), "--esc", "2", "--base-id", "1"), 2)
    assert "--esc and --base-id cannot be combined with --config" in said


def test_ids_that_do_not_fit_are_one_line() -> None:
    said = one_line(inside("dbc", "--base-id", "0x7ff"), 2)
    assert "12 of 13 messages lie outside 0..7FFh" in said


def test_a_dbc_that_cannot_be_written_is_one_line_and_leaves_nothing_behind(tmp_path: Path) -> None:
    said = one_line(inside("dbc", "-o", tmp_path / "none" / "out.dbc"), 1)
    assert f"{tmp_path}/none/out.dbc: cannot be written: No such file or directory" in said
    (tmp_path / "dir").mkdir()
    assert "Is a directory" in one_line(inside("dbc", "-o", tmp_path / "dir"), 1)
    assert sorted(os.listdir(tmp_path)) == ["dir"]


def test_a_dbc_goes_into_a_pipe_and_through_a_link_without_replacing_them(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = subprocess.Popen(["cat", str(pipe)], stdout=subprocess.PIPE, text=True)
    try:
        assert program("dbc", "-o", pipe).returncode == 0
        assert pipe.is_fifo()
        assert reader.communicate(timeout=10)[0].startswith("VERSION")
    finally:
        reader.kill()
    link, target = tmp_path / "link", tmp_path / "target"
    link.symlink_to(target)
    assert program("dbc", "-o", link).returncode == 0
    assert link.is_symlink()
    assert target.read_text().startswith("VERSION")


# --- standard output


@pytest.mark.parametrize("words", [["schema"], ["init", "-"], ["dbc"]])
def test_a_full_disk_behind_standard_output_is_one_line(words: list[str]) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run([*PROGRAM, *words], stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1, done.stderr
    assert "standard output: cannot be written: No space left on device" in done.stderr


def test_a_closed_standard_output_is_no_reason_for_a_traceback(tmp_path: Path) -> None:
    command = f"exec {sys.executable} -m kontronik_can_gw init {tmp_path}/a.toml >&-"
    done = subprocess.run(["sh", "-c", command], stderr=subprocess.PIPE, text=True, check=False)
    assert "Traceback" not in done.stderr
    assert done.returncode == 0


def test_a_reader_that_goes_away_is_not_told_about_it() -> None:
    done = subprocess.run(
        ["sh", "-c", f"{sys.executable} -m kontronik_can_gw dbc --esc 8 | head -c 10"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.stdout, done.stderr) == ('VERSION ""', "")


def test_check_tells_where_captures_go(tmp_path: Path) -> None:
    file = configuration(tmp_path, record='directory = "captures"\nkeep_mb = 500\ncan_log = "blf"')
    done = inside("check", "-c", file)
    assert done.returncode == 0
    words = "parts of 64 MB or 60 min, 500 MB in all, a CAN log (blf) beside"
    assert f"# captures: {tmp_path}/captures, {words}\n" in done.stdout
    assert "# captures" not in inside("check", "-c", configuration(tmp_path)).stdout


def test_a_folder_without_a_name_is_refused(tmp_path: Path) -> None:
    done = inside("run", "-c", configuration(tmp_path), "--record", " ")
    assert done.returncode == 2
    assert "--record: is empty. Give a folder" in done.stderr
    done = inside(
        "check", "-c", configuration(tmp_path, can='fd = true\ninterface = "virtual"', record='can_log = "trc"')
    )
    assert done.returncode == 2
    assert "record.can_log: a TRC log knows no CAN FD frames" in done.stderr
