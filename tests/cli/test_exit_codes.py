"""The same mistake has the same exit code in every command, and one line that names the file."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from command_line import run, written
from rights import modes_apply

pytestmark = pytest.mark.promise("one-line")

CONFIGURATION = (
    '[can]\ninterface = "virtual"\n[mqtt]\nbroker = "localhost"\n[[esc]]\nport = "nowhere"\n'
)
CONFIGURED = (
    "run -c {f}",
    "run {f}",
    "status -c {f}",
    "check {f}",
    "doctor -c {f}",
    "dbc -c {f}",
    "eds -c {f}",
    "describe -c {f}",
    "export -c {f} c out",
    "monitor -c {f}",
    "convert -c {f} x.bin out.csv",
    "report -c {f} x.bin -o out.html",
    "replay -c {f} x.bin --on can",
    "mqtt -c {f}",
    "metrics -c {f}",
)
BY_DBC = (
    "dbc --from {f}",
    "describe --dbc {f}",
    "export --dbc {f} c out",
    "monitor --dbc {f}",
    "convert --dbc {f} x.bin out.csv",
    "report --dbc {f} x.bin -o out.html",
    "replay --dbc {f} x.bin --on can --channel none",
    "mqtt --dbc {f} --broker localhost",
)
RECORDED = (
    "monitor {f}",
    "monitor --once {f}",
    "convert {f} out.csv",
    "report {f} -o out.html",
    "decode {f}",
    "replay {f} --on pty",
    "replay {f} --on can --channel none",
)
INPUTS = [
    *((command, "toml", "cann = 1\n") for command in CONFIGURED),
    *((command, "dbc", "no DBC") for command in BY_DBC),
    *((command, "bin", "no recording") for command in RECORDED),
]
OUTPUTS = (
    "init {f}",
    "schema -o {f}",
    "completion bash -o {f}",
    "dbc -o {f}",
    "eds -o {f}",
    "describe -o {f}",
    "export c {f}",
    "convert x.bin {f} --to csv",
    "decode x.bin -o {f}",
    "report x.bin -o {f}",
    "simulate --seconds 1 -o {f}",
    "simulate --seconds 1 --link {f}",
)


@pytest.fixture(scope="module")
def recording() -> bytes:
    done = run("simulate", "--seconds", 1, "-o", "-")
    assert done.code == 0
    return done.data


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, recording: bytes, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "x.bin", recording)
    return tmp_path


@cache
def import_modules() -> None:
    """Import modules while they can be read. Once is enough for all tests."""
    for words in ("describe", "convert x.bin - --to csv", "replay x.bin --on pty --delay 0"):
        run(*words.split())


@pytest.fixture
def no_rights(folder: Path) -> Iterator[None]:
    """Run a command while nothing in the folder can be opened or created."""
    import_modules()
    for path in folder.iterdir():
        path.chmod(0)
    folder.chmod(0o555)
    with modes_apply(folder):
        yield
    folder.chmod(0o700)


def refused(code: int, words: str, name: str) -> None:
    done = run(*words.split())
    assert done.code == code, done
    assert "Traceback" not in done.err, done
    said = done.err + (done.out if words.startswith("doctor") else "")
    assert name in said, said
    assert words.startswith("doctor") or done.out == ""


@pytest.mark.parametrize(("command", "kind", "_wrong"), INPUTS)
def test_input_that_does_not_exist_has_exit_code_2(command: str, kind: str, _wrong: str) -> None:
    refused(2, command.format(f=f"none.{kind}"), f"none.{kind}")


@pytest.mark.parametrize(("command", "kind", "wrong"), INPUTS)
def test_input_of_another_kind_has_exit_code_2(
    command: str,
    kind: str,
    wrong: str,
    folder: Path,
) -> None:
    written(folder / f"wrong.{kind}", wrong)
    refused(2, command.format(f=f"wrong.{kind}"), "wrong")


@pytest.mark.parametrize(("command", "kind", "_wrong"), INPUTS)
def test_input_that_is_a_folder_has_exit_code_2(
    command: str,
    kind: str,
    _wrong: str,
    folder: Path,
) -> None:
    (folder / f"folder.{kind}").mkdir()
    refused(2, command.format(f=f"folder.{kind}"), "folder")


@pytest.mark.parametrize(("command", "kind", "_wrong"), INPUTS)
def test_input_without_read_permission_has_exit_code_2(
    command: str,
    kind: str,
    _wrong: str,
    folder: Path,
    request: pytest.FixtureRequest,
) -> None:
    written(folder / f"closed.{kind}", CONFIGURATION)
    if command.startswith("doctor"):
        run("doctor", "-c", f"closed.{kind}")
    if command.startswith(("mqtt", "metrics")):
        run(*command.format(f=f"none.{kind}").split())  # imports libraries while they can be read
    if command.startswith("run"):
        from kontronik_can_gw.runtime import loop  # noqa: F401  cannot be read later
    request.getfixturevalue("no_rights")
    refused(2, command.format(f=f"closed.{kind}"), f"closed.{kind}")


@pytest.mark.parametrize("command", OUTPUTS)
def test_output_that_cannot_be_written_has_exit_code_1(command: str) -> None:
    refused(1, command.format(f="x.bin/out"), "x.bin")
    if not command.startswith("export"):
        refused(1, command.format(f="none/out"), "none/out")
