"""Every command replaces an existing output only with --force, and never replaces an input."""

import fcntl
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command_line import run, written

pytestmark = pytest.mark.promise("outputs-of-commands")

PROGRAM = [sys.executable, "-m", "kontronik_can_gw"]
CONFIGURATION = '[can]\ninterface = "virtual"\n[dbc]\nfile = "own.dbc"\n[[esc]]\nport = "x"\n'
COMMANDS = (
    "init {o}",
    "init -o {o}",
    "schema -o {o}",
    "completion bash -o {o}",
    "dbc -o {o}",
    "eds -o {o}",
    "describe -o {o}",
    "convert x.bin {o} --to csv",
    "convert x.bin -o {o} --to csv",
    "convert --to csv x.bin -q {o}",
    "decode x.bin -o {o}",
    "report x.bin -o {o}",
    "simulate --seconds 1 -o {o}",
    "simulate --seconds 1 --out {o}",
)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the working folder, with a configuration, its DBC and a recording."""
    monkeypatch.chdir(tmp_path)
    assert run("dbc", "-o", "own.dbc").code == 0
    assert run("simulate", "--seconds", 2, "-o", "x.bin").code == 0
    written(tmp_path / "gateway.toml", CONFIGURATION)
    return tmp_path


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("command", COMMANDS)
def test_file_that_exists_is_replaced_only_with_force(command: str, folder: Path) -> None:
    words = command.format(o="out").split()
    assert run(*words).code == 0
    first = (folder / "out").read_bytes()
    assert len(first) > 100
    written(folder / "out", "precious")
    done = run(*words)
    assert done.code == 2
    assert done.out == ""
    assert "out: exists. Give another name, or --force to replace it." in done.err
    assert (folder / "out").read_text() == "precious"
    assert run(*words, "--force").code == 0
    assert (folder / "out").read_bytes() == first
    assert names(folder) == ["gateway.toml", "out", "own.dbc", "x.bin"]


@pytest.mark.parametrize("command", COMMANDS)
def test_output_that_cannot_be_written_leaves_no_file(command: str, folder: Path) -> None:
    before = names(folder)
    for output, code in (
        ("none/out", 1),
        ("x.bin/out", 1),
        (".", 2),
    ):
        done = run(*command.format(o=output).split(), "--force")
        assert done.code == code, done
        assert done.out == "", done
        assert "Traceback" not in done.err, done
        said = done.err.splitlines()[-1]
        assert output in said
        assert "cannot be written" in said if code == 1 else "folder" in said
    assert names(folder) == before


@pytest.mark.parametrize("way", ["name", "symbolic link", "hard link", "temporary name"])
@pytest.mark.parametrize(
    ("command", "source"),
    [
        ("dbc -o {o}", "gateway.toml"),
        ("dbc -c gateway.toml -o {o}", "own.dbc"),
        ("dbc --from own.dbc -o {o}", "own.dbc"),
        ("dbc --canopen -o {o}", "gateway.toml"),
        ("eds -o {o}", "gateway.toml"),
        ("eds -c nodes.toml -o {o}", "own.eds"),
        ("describe -o {o}", "gateway.toml"),
        ("describe --dbc own.dbc -o {o}", "own.dbc"),
        ("convert x.bin {o} --to csv", "x.bin"),
        ("convert x.bin {o} --to csv --dbc own.dbc", "own.dbc"),
        ("convert captures {o} --to csv", "captures/a-1.kcap"),
        ("decode x.bin -o {o}", "x.bin"),
        ("report -c gateway.toml x.bin -o {o}", "own.dbc"),
    ],
)
def test_input_is_never_overwritten(command: str, source: str, way: str, folder: Path) -> None:
    assert run("eds", "-o", "own.eds").code == 0
    nodes = CONFIGURATION + '[canopen]\nenabled = true\neds = "own.eds"\n'
    written(folder / "nodes.toml", nodes)
    (folder / "captures").mkdir()
    written(folder / "captures" / "a-1.kcap", b"KCB1")
    path = folder / source
    output = folder / "out"
    if way == "name":
        output = path
    elif way == "symbolic link":
        output.symlink_to(path)
    elif way == "hard link":
        os.link(path, output)
    else:  # the name that the output has until it is complete
        os.link(path, folder / "out.part")
    before = path.read_bytes()
    done = run(*command.format(o=output).split(), "--force")
    assert done.code == 2
    assert done.out == ""
    assert f"{output}: would overwrite the input" in done.err
    assert path.read_bytes() == before


def test_export_replaces_files_only_with_force_and_never_its_input(folder: Path) -> None:
    assert run("export", "c", "-o", "fw").code == 0
    (folder / "fw" / "example_main.c").write_text("mine")
    done = run("export", "c", "--dbc", "own.dbc", "fw")
    assert done.code == 2
    assert done.err.count(": exists. Give another name, or --force") == 6
    assert run("export", "c", "--dbc", "own.dbc", "fw", "--force").code == 0
    assert (folder / "fw" / "example_main.c").read_text() == "mine"
    (folder / "fw" / "core.h").unlink()
    (folder / "fw" / "core.h").symlink_to(folder / "own.dbc")
    done = run("export", "c", "--dbc", "own.dbc", "fw", "--force")
    assert done.code == 2
    assert "fw/core.h: would overwrite the input own.dbc" in done.err
    assert (folder / "own.dbc").read_text().startswith("VERSION")


@pytest.mark.parametrize("command", COMMANDS)
def test_part_that_exists_is_replaced_only_with_force(command: str, folder: Path) -> None:
    part = written(folder / "out.part", "rows of an interrupted command")
    done = run(*command.format(o="out").split())
    assert done.code == 2
    assert done.out == ""
    assert "out.part: exists. It may have the data of an earlier command" in done.err
    assert "Rename it, or give --force" in done.err
    assert part.read_text() == "rows of an interrupted command"
    assert not (folder / "out").exists()
    assert run(*command.format(o="out").split(), "--force").code == 0
    assert not part.exists()
    assert (folder / "out").stat().st_size > 100


@pytest.mark.parametrize("command", COMMANDS)
def test_part_that_is_being_written_is_never_replaced(command: str, folder: Path) -> None:
    part = folder / "out.part"
    with part.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        for force in ((), ("--force",)):
            done = run(*command.format(o="out").split(), *force)
            assert done.code == 2
            assert "out.part: another process is writing it. Wait for its end" in done.err
        assert part.exists()
    assert not (folder / "out").exists()


def test_file_that_appears_during_writing_is_kept(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def appear(_fd: int) -> None:
        written(folder / "out", "precious")

    monkeypatch.setattr(os, "fsync", appear)
    done = run("convert", "x.bin", "out", "--to", "csv")
    assert done.code == 1
    assert "out: cannot be written: another program has created it meanwhile." in done.err
    assert "The data so far are in out.part." in done.err
    assert (folder / "out").read_text() == "precious"
    assert (folder / "out.part").stat().st_size > 1000


def test_rows_of_a_killed_conversion_survive_the_same_command(folder: Path) -> None:
    command = [*PROGRAM, "convert", "-", "live.csv"]
    part = folder / "live.csv.part"
    rows = (folder / "x.bin").read_bytes()
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as first:
        assert first.stdin is not None
        first.stdin.write(rows)
        first.stdin.flush()
        end = time.monotonic() + 60
        while not (part.exists() and part.stat().st_size):
            assert first.poll() is None
            assert time.monotonic() < end
            time.sleep(0.02)
        for force in ((), ("--force",)):
            done = run("convert", "-", "live.csv", *force, given=rows)
            assert "another process is writing it" in done.err
        first.kill()
    kept = part.read_bytes()
    assert len(kept) > 1000
    done = run("convert", "-", "live.csv", given=rows)
    assert done.code == 2
    assert "live.csv.part: exists" in done.err
    assert part.read_bytes() == kept


def test_export_to_a_full_disk_leaves_the_folder_as_it_was(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fill_up(count: int) -> None:
        left = count

        def sync(_fd: int) -> None:
            nonlocal left
            left -= 1
            if left < 0:
                raise OSError(28, "No space left on device")

        monkeypatch.setattr(os, "fsync", sync)

    before = names(folder)
    for count in range(6):
        fill_up(count)
        done = run("export", "c", "--dbc", "own.dbc", "deep/fw")
        assert done.code == 1
        assert "cannot be written: No space left on device" in done.err
        assert names(folder) == before
    monkeypatch.undo()
    monkeypatch.chdir(folder)
    assert run("export", "c", "--dbc", "own.dbc", "fw").code == 0
    (folder / "fw" / "core.h").write_text("older")
    files = {path.name: path.read_bytes() for path in (folder / "fw").iterdir()}
    fill_up(2)
    assert run("export", "c", "--dbc", "own.dbc", "fw", "--force").code == 1
    assert {path.name: path.read_bytes() for path in (folder / "fw").iterdir()} == files


def test_two_outputs_are_refused_and_so_is_a_missing_output() -> None:
    assert "OUT and -o: both are outputs" in run("convert", "x.bin", "a.csv", "-o", "b.csv").err
    assert "no output. Give OUT, or -o OUT." in run("convert", "x.bin").err
    assert run("init", "a", "-o", "b").code == run("export", "c").code == 2


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGTERM,
        signal.SIGINT,
        signal.SIGHUP,
    ],
)
def test_signal_leaves_no_partly_written_file(number: int, folder: Path) -> None:
    before = names(folder)
    command = [*PROGRAM, "simulate", "--seconds", "1000h", "-o", "long.bin"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        end = time.monotonic() + 60
        part = folder / "long.bin.part"
        while not (part.exists() and part.stat().st_size):
            assert process.poll() is None
            assert time.monotonic() < end
            time.sleep(0.02)
        process.send_signal(number)
        _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert said == "kontronik-can-gw: stopped: long.bin was not written\n"
    assert names(folder) == before


def test_full_disk_leaves_no_partly_written_file(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_fd: int) -> None:
        raise OSError(28, "No space left on device")

    before = names(folder)
    monkeypatch.setattr(os, "fsync", full)
    for command in COMMANDS:
        done = run(*command.format(o="out").split())
        said = [line for line in done.err.splitlines() if ": using gateway.toml" not in line]
        assert done.code == 1, done
        assert done.out == "", done
        assert len(said) == 1, done
        assert "out: cannot be written: No space left on device." in said[0]
    assert names(folder) == before
