"""The output of ``check`` as text and as JSON, and the places of an unnamed configuration."""

import json
from pathlib import Path

import pytest
from command_line import refused, run, written
from rights import modes_apply

from kontronik_can_gw.cli import arguments

pytestmark = pytest.mark.promise("all-mistakes")

LEAST = '[[esc]]\nport = "/dev/ttyUSB0"\n'


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Return the files that are used if no file is named: the folder's, and the machine's.

    Neither exists.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(arguments, "CONFIG_PLACES", (Path("gateway.toml"), tmp_path / "etc.toml"))
    return tmp_path / "gateway.toml", tmp_path / "etc.toml"


def test_json_contains_keys_and_warnings_or_the_mistakes(tmp_path: Path) -> None:
    done = run("check", "--json", written(tmp_path / "g.toml", LEAST))
    found = json.loads(done.out)
    assert done.code == 0
    assert done.err == ""
    assert found["mistakes"] == []
    assert found["warnings"] == []
    assert found["escs"] == [{"name": "esc1", "port": "/dev/ttyUSB0", "protocol": "kontronik"}]
    assert found["configuration"]["esc"][0]["telemetry_timeout_ms"] == 250
    assert 0.05 < found["bus_load"] < 0.1

    done = run("check", "--json", written(tmp_path / "g.toml", f"{LEAST}pole_pair = 7\nx = 1\n"))
    assert done.code == 2
    assert done.err == ""
    assert [".pole_pair" in line for line in json.loads(done.out)["mistakes"]] == [True, False]


def test_details_are_the_keys_in_effect_and_the_tables(tmp_path: Path) -> None:
    file = written(tmp_path / "g.toml", f"{LEAST}[dronecan]\nenabled = true\n")
    found = run("check", "-v", file).out.splitlines()
    short = run("check", file).out.splitlines()
    assert found[: len(short)] == short
    assert "telemetry_timeout_ms = 250" in found
    assert any(line.startswith("node-ID from an allocation server") for line in found), found
    rows = [line for line in run("describe", "-c", file).out.splitlines() if "Battery" in line]
    assert len(rows) > 3
    assert set(rows[:3]) <= set(found)


@pytest.mark.parametrize("command", ["check", "doctor", "run"])
def test_folders_configuration_is_preferred_to_the_machines(
    places: tuple[Path, Path], command: str
) -> None:
    own, machine = places
    assert "no configuration: neither " in refused(2, command)
    written(machine, "[[esc]]\nof_the_machine = 1\n")
    said = run(command)
    assert said.code == 2
    assert "of_the_machine" in said.out + said.err
    written(own, "[[esc]]\nof_the_folder = 1\n")
    said = run(command)
    assert said.code == 2
    assert "of_the_folder" in said.out + said.err
    assert "of_the_machine" not in said.out + said.err


def test_commands_report_the_configuration_that_they_found(places: tuple[Path, Path]) -> None:
    own, _ = places
    assert run("dbc").err == ""
    written(own, f'{LEAST}name = "left"\n[[esc]]\nname = "right"\nport = "x"\n')
    done = run("dbc")
    assert done.err.startswith("kontronik-can-gw: using gateway.toml\n")
    assert "EscSpeed_right" in done.out or "right" in done.out.lower()
    assert run("dbc", "--esc", 1).err == ""
    assert "using gateway.toml" in run("describe").err
    assert run("eds").err == "", "no nodes in it"
    with own.open("a") as file:
        file.write('[canopen]\nenabled = true\n[statistics]\nfile = "state.json"\n')
    assert "using gateway.toml" in run("eds").err
    assert "run -c gateway.toml" in refused(3, "status")


def test_fingerprint_identifies_the_layout_in_file_and_frames(
    places: tuple[Path, Path],
) -> None:
    own, _ = places

    def fingerprint() -> str:
        return str(json.loads(run("check", "--json").out)["layout"])

    written(own, LEAST)
    first = fingerprint()
    text = run("dbc", "-c", own).out
    assert text.startswith(f'VERSION "layout {first}"\n')
    written(own.with_name("sent.dbc"), text)
    written(own, f'[dbc]\nfile = "sent.dbc"\n{LEAST}')
    assert fingerprint() == first
    assert run("dbc", "-c", own).out == text
    written(own.with_name("sent.dbc"), text.replace("(0.01,", "(0.02,", 1))
    assert fingerprint() != first


@pytest.mark.rights
@pytest.mark.parametrize(
    ("code", "words"),
    [
        (2, "check"),
        (2, "decode gateway.toml"),
    ],
)
def test_unreadable_file_is_reported_in_one_line(
    places: tuple[Path, Path],
    code: int,
    words: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    own, _ = places
    monkeypatch.setattr(arguments, "CONFIG_PLACES", (own,))
    written(own, LEAST)
    own.parent.chmod(0)
    with modes_apply(own.parent):
        said = refused(code, *words.split())
    own.parent.chmod(0o700)
    assert "Permission denied" in said


def test_usual_and_the_worst_bus_load_are_shown(tmp_path: Path) -> None:
    """EscStatus of the shipped DBC is sent every 100 ms and on change; TPDO 4 on change."""
    file = written(tmp_path / "g.toml", f"{LEAST}[canopen]\nenabled = true\nstore = 'x'\n")
    found = json.loads(run("check", "--json", file).out)
    more = found["worst_frames_per_second"] - found["frames_per_second"]
    assert more >= 90 + 98
    assert found["worst_bus_load"] - found["bus_load"] == pytest.approx(more * 135 / 500_000)
    lines = run("check", file).out.splitlines()
    usual, worst = lines[-2:]
    assert usual.startswith("  bus load  ")
    assert f"{found['frames_per_second']:.0f} frames/s" in usual
    assert worst.startswith("  at worst  ")
    assert f"{found['worst_bus_load']:.1%}" in worst
    assert len(worst) <= 80


@pytest.mark.parametrize("text", [f"x = {'9' * 5000}", f"x = {'[' * 5000}"])
def test_toml_beyond_the_limits_of_python_is_explained_to_users(text: str, tmp_path: Path) -> None:
    said = refused(2, "check", written(tmp_path / "g.toml", text))
    assert said.endswith("is not valid TOML: a number is too long, or the nesting is too deep")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "the password cannot be read: No such file or directory"),
        (b"\xff", "the password is not UTF-8 text"),
    ],
)
def test_bad_password_file_is_explained_to_users(
    content: bytes | None,
    said: str,
    tmp_path: Path,
) -> None:
    if content is not None:
        written(tmp_path / "password", content)
    table = '[mqtt]\nbroker = "localhost"\nusername = "boat"\npassword_file = "password"\n'
    file = written(tmp_path / "g.toml", f'[can]\ninterface = "virtual"\n{table}{LEAST}')
    assert refused(2, "mqtt", "-c", file) == f"{tmp_path}/password: {said}"


@pytest.mark.parametrize(
    ("content", "said"),
    [(None, "cannot be read: No such file or directory"), (b"x", "cannot be used for TLS")],
)
def test_bad_certificate_is_explained_to_users(
    content: bytes | None,
    said: str,
    tmp_path: Path,
) -> None:
    if content is not None:
        written(tmp_path / "ca.pem", content)
    table = '[mqtt]\nbroker = "localhost"\ntls = true\nca_file = "ca.pem"\n'
    file = written(tmp_path / "g.toml", f'[can]\ninterface = "virtual"\n{table}{LEAST}')
    advice = "Certificates must be in PEM form, keys without passphrase."
    assert refused(2, "mqtt", "-c", file) == f"{tmp_path}/ca.pem: {said}. {advice}"


def test_check_shows_who_can_restart_the_interface(tmp_path: Path) -> None:
    text = "[can]\nrestart_after_s = 0.5\n[[esc]]\nport = '/dev/ttyS0'\n"
    done = run("check", "-c", written(tmp_path / "gateway.toml", text))
    assert done.code == 0
    assert "restarted after 0.5 s in which no frame has left,\n" in done.out
    assert "if root or the service's user runs the gateway\n" in done.out


def test_check_shows_one_time_until_a_restart(tmp_path: Path) -> None:
    text = "[can]\nrestart_after_s = 0.5\n[[esc]]\nport = '/dev/ttyS0'\n"
    done = run("check", "-c", written(tmp_path / "gateway.toml", text))
    assert done.out.count("restarted after") == 1


@pytest.mark.parametrize(("content", "warnings"), [("mine\n", 1), ("", 0), (None, 0)])
def test_check_warns_of_a_status_file_that_is_the_users(
    content: str | None, warnings: int, tmp_path: Path
) -> None:
    file = tmp_path / "notes.txt"
    if content is not None:
        written(file, content)
    text = f"[statistics]\nfile = '{file}'\n[[esc]]\nport = '/dev/ttyS0'\n"
    done = run("check", "-c", written(tmp_path / "gateway.toml", text))
    assert done.code == 0
    said = f"statistics.file: the status is not written to {file}: it exists and is not a status"
    assert done.err.count(said) == warnings
