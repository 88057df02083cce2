"""The publisher as a systemd service of its own: how it is installed and removed. Its unit: tests/service."""

import os
from pathlib import Path

import pytest

from kontronik_can_gw.cli import main

WANTS = "etc/systemd/system/multi-user.target.wants"
UNITS = "etc/systemd/system"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """The root of a disk image, with a program."""
    program = tmp_path / "opt/kontronik-can-gw"
    program.parent.mkdir()
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    (tmp_path / "etc/kontronik-can-gw").mkdir(parents=True)
    return tmp_path


def install(root: Path, *words: str) -> int:
    return main(
        ["service", "install", "--root", str(root), "--executable", "/opt/kontronik-can-gw", *words]
    )


def configuration(
    root: Path, name: str = "gateway", mqtt: str = '[mqtt]\nbroker = "broker.example"\n'
) -> None:
    file = root / f"etc/kontronik-can-gw/{name}.toml"
    file.write_text(f'{mqtt}[[esc]]\nport = "/dev/ttyAMA0"\npole_pairs = 7\n')


def test_it_is_installed_and_enabled_on_request_only(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    configuration(root)
    assert install(root) == 0
    assert not list(root.glob(f"{UNITS}/*mqtt*"))
    assert install(root, "--mqtt") == 0
    assert "kontronik-can-gw-mqtt.service is enabled" in capsys.readouterr().err
    link = root / WANTS / "kontronik-can-gw-mqtt.service"
    assert os.readlink(link) == f"/{UNITS}/kontronik-can-gw-mqtt.service"
    assert (root / UNITS / "kontronik-can-gw-mqtt.service").is_file()
    assert main(["service", "uninstall", "--root", str(root)]) == 0
    assert not list(root.glob(f"{UNITS}/**/*kontronik*"))


def test_without_a_broker_it_is_installed_but_not_enabled(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    configuration(root, mqtt="")
    assert install(root, "--mqtt") == 0
    said = capsys.readouterr().err
    assert (
        "gateway.toml: mqtt.broker is not set. kontronik-can-gw-mqtt.service was not enabled."
        in said
    )
    assert [path.name for path in (root / WANTS).iterdir()] == ["kontronik-can-gw.service"]
