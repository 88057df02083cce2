"""pip installs a working gateway with a C compiler, without one, and with one that fails.

The gateway logs which core runs and why.
"""

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Mapping
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[2]
FILES = "pyproject.toml", "hatch_build.py", "README.md", "LICENSE"
FOLDERS = "dbc", "eds", "kontronik_can_gw"
CONFIG = '[can]\ninterface = "virtual"\nchannel = "x"\n[[esc]]\nport = "/dev/no-port"\n'

pytestmark = [
    pytest.mark.promise("which-core"),
    pytest.mark.extended,
]


@pytest.fixture
def sources(tmp_path: Path) -> Path:
    """Return a copy of the source distribution, because an installation writes into it."""
    made = tmp_path / "sources"
    made.mkdir()
    for name in FILES:
        shutil.copy(PROJECT / name, made)
    left_out = shutil.ignore_patterns("*.so", "not_built.txt", "__pycache__")
    for name in FOLDERS:
        shutil.copytree(PROJECT / name, made / name, ignore=left_out)
    return made


def installed(sources: Path, environment: Mapping[str, str]) -> tuple[Path, str, str]:
    """Install in a new environment. Return the program, the name of its wheel and pip's output."""
    folder = sources.parent / "fresh"
    wheels = sources.parent / "wheels"
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    build = ["wheel", "-v", "--no-deps", "--no-build-isolation", "-w", str(wheels), str(sources)]
    command = [*pip, *build]
    done = subprocess.run(
        command,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    (wheel,) = wheels.iterdir()
    venv.create(folder, symlinks=True)
    into = ["--python", f"{folder}/bin/python", "install", "-q", "--no-deps", "--no-index"]
    subprocess.run([*pip, *into, str(wheel)], check=True)
    (packages,) = folder.glob("lib/python*/site-packages")
    # The dependencies are taken from the environment of the tests.
    (packages / "others.pth").write_text(sysconfig.get_path("purelib"))
    return folder / "bin" / "kontronik-can-gw", wheel.name, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("compiles", "why"),
    [
        (None, ""),
        ("", "no C compiler was found during installation"),
        (
            "echo 'cc: error: broken' >&2\nexit 1\n",
            "{} failed during installation: cc: error: broken",
        ),
    ],
    ids=["with a compiler", "without one", "with one that fails"],
)
def test_installed_gateway_works_and_logs_which_core_runs_and_why(
    sources: Path,
    compiles: str | None,
    why: str,
    request: pytest.FixtureRequest,
) -> None:
    programs = sources.parent / "programs"
    if compiles is None:
        request.getfixturevalue("c_compiler")
    environment = dict(os.environ)
    programs.mkdir()
    if compiles is not None:
        environment["PATH"] = str(programs)
    if compiles:
        (programs / "cc").write_text(f"#!/bin/sh\n{compiles}")
        (programs / "cc").chmod(0o755)
    why = why.format(programs / "cc")
    program, wheel, printed = installed(sources, environment)
    assert ("-py3-none-any.whl" in wheel) is bool(why)
    assert not why or f"the core in Python will run: {why}" in printed
    config = program.with_name("gateway.toml")
    config.write_text(CONFIG)
    command = [str(program), "run", "--wait", "-c", str(config)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd="/") as process:
        assert process.stderr is not None
        found = next((line for line in process.stderr if "core: " in line), "")
        process.terminate()
        process.stderr.read()
    assert process.returncode == 0
    expected = f"Python ({why})" if why else "C"
    assert found.strip().partition("core: ")[2] == expected
