"""Every command replaces an existing output only with --force, and never replaces an input."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command_line import run, written

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
def test_a_file_that_exists_is_replaced_only_with_force(command: str, folder: Path) -> None:
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
def test_an_output_that_cannot_be_written_leaves_no_file(command: str, folder: Path) -> None:
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
def test_an_input_is_never_overwritten(command: str, source: str, way: str, folder: Path) -> None:
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


def test_an_export_replaces_files_only_with_force_and_never_its_input(folder: Path) -> None:
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
def test_a_signal_leaves_no_partly_written_file(number: int, folder: Path) -> None:
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
    assert said == ""
    assert names(folder) == before


def test_a_full_disk_leaves_no_partly_written_file(
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
