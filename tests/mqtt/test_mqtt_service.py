"""The publisher as a systemd service of its own: its unit, how it is installed and removed."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from kontronik_can_gw.cli import main
from kontronik_can_gw.cli.service_files import Choices, planned

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


def analyze(*words: str) -> "subprocess.CompletedProcess[str]":
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze on this machine: sudo apt-get install systemd")
    environment = os.environ | {"SYSTEMD_COLORS": "0", "LC_ALL": "C.UTF-8"}
    return subprocess.run(
        ["systemd-analyze", *words],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
        env=environment,
    )


def units(folder: Path) -> list[Path]:
    """Both units, the template as an instance."""
    made = []
    for file in planned(Choices("/bin/true", False, "dialout", mqtt=True), folder):
        if "-mqtt" in file.path:
            made.append(folder / Path(file.path).name.replace("@.", "@left."))
            made[-1].write_text(file.text)
    return made


def test_systemd_finds_nothing_to_complain_about_and_hardly_any_exposure(tmp_path: Path) -> None:
    found = units(tmp_path)
    assert [unit.name for unit in found] == [
        "kontronik-can-gw-mqtt.service",
        "kontronik-can-gw-mqtt@left.service",
    ]
    for unit in found:
        done = analyze("verify", "--man=no", str(unit))
        ours = [line for line in (done.stdout + done.stderr).splitlines() if "kontronik" in line]
        assert (done.returncode, ours) == (0, []), done.stderr
        done = analyze("security", "--offline=true", "--no-pager", str(unit))
        level = re.search(r"Overall exposure level for \S+: ([\d.]+)", done.stdout)
        assert level, done.stdout + done.stderr
        assert float(level[1]) <= 2.0


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
