"""Advice on how to install a library that only some commands need.

The advice works for each kind of installation.
"""

import re
import sys
import sysconfig
import tomllib
from pathlib import Path

import pytest

from kontronik_can_gw.desk.libraries import (
    EXTRAS,
    install_command,
    missing_library,
)

pytestmark = pytest.mark.promise("one-line")

PROJECT = Path(__file__).resolve().parents[2]


def test_each_extra_has_the_library_of_pyproject() -> None:
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    del extras["all"]
    del extras["test"]
    assert {extra: libraries.split() for extra, libraries in EXTRAS.items()} == extras


@pytest.mark.parametrize(
    ("prefix", "command"),
    [
        ("/home/me/clone/.venv", "/x/bin/python -m pip install --upgrade 'asammdf>=8'"),
        (
            "/home/me/.local/share/pipx/venvs/kontronik-can-gw",
            "pipx inject --force kontronik-can-gw 'asammdf>=8'",
        ),
    ],
)
def test_in_a_virtual_environment_the_advice_installs_the_library_alone(
    prefix: str,
    command: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "prefix", prefix)
    monkeypatch.setattr(sys, "executable", "/x/bin/python")
    assert install_command("asammdf>=8") == command
    said = str(missing_library("MF4", "mf4"))
    assert said == f"MF4 needs asammdf>=8. Install it: {command}"


@pytest.mark.parametrize("is_debian", [True, False])
def test_in_the_debian_package_the_advice_is_to_install_a_clone(
    is_debian: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "prefix", "/usr")
    monkeypatch.setattr(sys, "base_prefix", "/usr")
    monkeypatch.setattr(sysconfig, "get_path", lambda _name: str(tmp_path))
    if is_debian:
        (tmp_path / "EXTERNALLY-MANAGED").touch()
    said = str(missing_library("Parquet", "parquet"))
    assert said.startswith("Parquet needs pyarrow>=15. ")
    assert ("~/kontronik/bin/pip install '.[parquet]'" in said) == is_debian
    assert (" -m pip install --upgrade 'pyarrow>=15'" in said) != is_debian


def test_no_text_names_an_index_that_lacks_the_package() -> None:
    """The package is not on an index, so its extras can only be installed from a clone."""
    places = [PROJECT / "README.md", *(PROJECT / "kontronik_can_gw").rglob("*.py")]
    for folder in ("docs", "examples"):
        places += [path for path in (PROJECT / folder).rglob("*") if path.is_file()]
    for path in places:
        text = path.read_bytes().decode("utf-8", "ignore")
        for line in re.findall(r"pipx? (?:install|download) [^\n`]*", text):
            # allowed: a folder or program of this name, and "NAME @ git+https://..."
            assert not re.search(r"(?<!/)kontronik[-_]can[-_]gw(?! @|/)", line), f"{path}: {line}"
        assert "kontronik-can-gw[" not in text, path
