"""pip installs a gateway that works, with a C compiler, without one, and with one that fails; it says which core runs and why."""

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Mapping
from pathlib import Path

import pytest

from kontronik_can_gw.native.compile import compiler

PROJECT = Path(__file__).resolve().parents[2]
PARTS = (
    "pyproject.toml",
    "hatch_build.py",
    "README.md",
    "LICENSE",
    "dbc",
    "eds",
    "kontronik_can_gw",
)
CONFIG = '[can]\ninterface = "virtual"\nchannel = "x"\n[[esc]]\nport = "/dev/no-port"\n'

pytestmark = pytest.mark.extended


@pytest.fixture
def sources(tmp_path: Path) -> Path:
    """A copy of what a source distribution holds: an installation writes in there."""
    made = tmp_path / "sources"
    made.mkdir()
    for name in PARTS:
        if (part := PROJECT / name).is_dir():
            left_out = shutil.ignore_patterns("*.so", "not_built.txt", "__pycache__")
            shutil.copytree(part, made / name, ignore=left_out)
        else:
            shutil.copy(part, made)
    return made


def installed(sources: Path, environment: Mapping[str, str]) -> tuple[Path, str, str]:
    """The program in a fresh environment, the name of its wheel, and what pip printed."""
    folder, wheels = sources.parent / "fresh", sources.parent / "wheels"
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    build = [*pip, "wheel", "-v", "--no-deps", "--no-build-isolation", "-w", str(wheels)]
    command = [*build, str(sources)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (wheel,) = wheels.iterdir()
    venv.create(folder, symlinks=True)
    python = folder / "bin" / "python"
    command = [*pip, "--python", str(python), "install", "-q", "--no-deps", "--no-index"]
    subprocess.run([*command, str(wheel)], check=True)
    (packages,) = folder.glob("lib/python*/site-packages")
    # what it depends on is that of the tests
    (packages / "others.pth").write_text(sysconfig.get_path("purelib"))
    return folder / "bin" / "kontronik-can-gw", wheel.name, done.stdout + done.stderr


def first_words(program: Path) -> str:
    """Of a gateway that starts and ends: the line about its core."""
    folder = program.parent
    (folder / "gateway.toml").write_text(CONFIG)
    command = [str(program), "run", "--wait", "-c", str(folder / "gateway.toml")]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=folder) as process:
        assert process.stderr is not None
        said = next((line for line in process.stderr if "core: " in line), "")
        process.terminate()
        process.stderr.read()
    assert process.returncode == 0
    return said.strip().partition("core: ")[2]


def test_with_a_compiler_the_core_in_c_is_built(sources: Path) -> None:
    if compiler() is None:
        pytest.skip("no C compiler: sudo apt-get install gcc libc6-dev")
    program, wheel, _ = installed(sources, os.environ)
    assert first_words(program) == "C"
    assert "-py3-none-linux_" in wheel


@pytest.mark.parametrize("fails", [False, True])
def test_without_a_compiler_or_with_one_that_fails_the_core_in_python_runs(
    sources: Path, fails: bool
) -> None:
    programs, why = sources.parent / "programs", "there was no C compiler at the installation"
    programs.mkdir()
    if fails:
        (programs / "cc").write_text("#!/bin/sh\necho 'cc: error: broken' >&2\nexit 1\n")
        (programs / "cc").chmod(0o755)
        why = f"at the installation {programs / 'cc'} failed: cc: error: broken"
    program, wheel, printed = installed(sources, os.environ | {"PATH": str(programs)})
    assert f"the core in Python will run: {why}" in printed
    assert wheel.endswith("-py3-none-any.whl")
    assert first_words(program) == f"Python ({why})"
