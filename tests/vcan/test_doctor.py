"""`doctor` on real interfaces: a vcan, and the kernel's slcan driver on an emulated adapter.

The adapter has a bit rate and controller states.
"""

import contextlib
import io
import json
import os
import subprocess
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from feeder import Identity
from harness import PtyPort
from slcan_adapters import Adapter, Bus
from vcan_tools import chain, configuration, ip, recording, wait_for

from kontronik_can_gw.capture.format import Block, Damage, Scanner
from kontronik_can_gw.cli import main

pytestmark = pytest.mark.promise("doctor")


@pytest.fixture
def adapter() -> Iterator[Adapter]:
    """Yield a serial CAN adapter that the kernel's slcan driver uses."""
    try:
        bus = Bus("slcan9")
    except OSError as error:
        remedy = "sudo modprobe slcan, or `tests/vm/run -- pytest tests/vcan`"
        reason = f"no slcan here ({error.strerror}): {remedy}"
        if os.environ.get("KCG_VCAN"):
            pytest.fail(reason)
        pytest.skip(reason)
    yield bus.adapters[0]
    bus.close()


def doctor(file: Path) -> tuple[dict[str, dict[str, Any]], int]:
    """Return the findings of the CAN and port groups by check, and the exit code."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        # It runs in this process, because starting one takes long on a slow machine.
        code = main(["doctor", "-c", str(file), "--json"])
    findings = json.loads(printed.getvalue())["findings"]
    return {f["check"]: f for f in findings if f["check"].startswith(("can.", "port."))}, code


def configured(folder: Path, interface: str, ports: list[PtyPort]) -> Path:
    file = folder / "doctor.toml"
    file.write_text(configuration(interface, ports))
    return file


def test_vcan_that_is_down_or_missing_is_an_error_with_the_remedy(
    vcan: str,
    tmp_path: Path,
    escs: list[PtyPort],
) -> None:
    file = configured(tmp_path, vcan, escs)
    ip("link", "set", vcan, "down")
    for check, before in (("can.up", ["true"]), ("can.exists", ["ip", "link", "del", vcan])):
        subprocess.run(before, check=True)
        found, code = doctor(file)
        assert code == 1
        assert found[check]["severity"] == "error"
        subprocess.run(found[check]["command"].replace("sudo ", ""), shell=True, check=True)
        with recording(vcan) as watch:
            found, code = doctor(file)
        assert watch.recorded == []
        assert code == 0
        assert found["can.up"]["severity"] == "ok"
        assert "virtual interface" in found["can.exists"]["text"]
        assert not {"can.bitrate", "can.restart", "can.state"} & set(found)


def test_bit_rate_and_state_of_a_real_driver_are_judged(
    adapter: Adapter,
    tmp_path: Path,
    escs: list[PtyPort],
) -> None:
    file = configured(tmp_path, adapter.name, escs)
    found, code = doctor(file)
    assert code == 1
    assert found["can.up"]["severity"] == "error"
    assert "bitrate 1000000" in found["can.up"]["command"]
    ip(
        "link",
        "set",
        adapter.name,
        "up",
        "type",
        "can",
        "bitrate",
        "250000",
    )
    found, code = doctor(file)
    assert code == 1
    assert "250000" in found["can.bitrate"]["text"]
    assert found["can.up"]["severity"] == "ok"
    subprocess.run(found["can.bitrate"]["command"].replace("sudo ", ""), shell=True, check=True)
    found, code = doctor(file)
    assert code == 0
    assert found["can.bitrate"]["severity"] == found["can.state"]["severity"] == "ok"
    assert found["can.restart"]["severity"] == "note"
    for letter, state, severity in (("p", "passive", "warning"), ("b", "bus-off", "error")):
        adapter.tell_state(letter, 0, 128)

        def is_shown(state: str = state) -> bool:
            return state.upper() in shown(adapter.name)

        wait_for(is_shown, state)
        found, _ = doctor(file)
        assert found["can.state"]["severity"] == severity
        assert state in found["can.state"]["text"]
    subprocess.run(found["can.state"]["command"].replace("sudo ", ""), shell=True, check=True)
    assert doctor(file)[0]["can.state"]["severity"] == "ok"


def shown(name: str) -> str:
    command = ["ip", "-d", "link", "show", name]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_bundle_of_a_running_gateway_has_its_state_and_a_capture(
    vcan: str,
    tmp_path: Path,
) -> None:
    """The capture is still being written. Its copy can be converted."""
    record = f'[record]\ndirectory = "{tmp_path}/captures"'
    with chain(vcan, tmp_path, Identity(1), toml=record) as run, run.running() as gateway:
        run.feed(times=20)
        wait_for(lambda: data_blocks(tmp_path / "captures") > 0, "data in the capture")
        bundle = tmp_path / "bundle.zip"
        messages = io.StringIO()
        with contextlib.redirect_stderr(messages):
            assert main(["doctor", "-c", str(run.config), "--bundle", str(bundle)]) == 0
        assert "status:" not in messages.getvalue()
        with zipfile.ZipFile(bundle) as found:
            found.extractall(tmp_path / "out")
        status = json.loads((tmp_path / "out/status.json").read_text())
        assert gateway.end() == 0, gateway.log
    [seen] = status["gateways"]
    assert seen["document"]["escs"][0]["name"] == "esc1"
    [capture] = (tmp_path / "out/captures").iterdir()
    assert main(["convert", str(capture), str(tmp_path / "out.csv"), "-q"]) == 0
    assert len((tmp_path / "out.csv").read_text().splitlines()) > 1


def data_blocks(folder: Path) -> int:
    """Return the number of data blocks in all captures of a folder."""
    scanner = Scanner()
    found: list[Block | Damage] = []
    for path in folder.glob("*.kcap"):
        found += scanner.feed(path.read_bytes())
    return sum(isinstance(each, Block) and each.kind == b"D" for each in found)
