"""``simulate``: terminals, links, files and signals, and bytes transmitted to the ESC."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import refused, run

from kontronik_can_gw.esc.kontronik.codec import WireLayout
from kontronik_can_gw.esc.kontronik.deframer import Deframer, Frame
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData
from kontronik_can_gw.esc.kontronik.protocol import KONTRONIK
from kontronik_can_gw.esc.kontronik.simulator import SimulatedEsc
from kontronik_can_gw.esc.kontronik.states import Device, OperatingError

pytestmark = pytest.mark.promise("simulated-esc")

COMMAND = [sys.executable, "-m", "kontronik_can_gw", "simulate"]


def frames_of(data: bytes) -> list[Frame]:
    deframer = Deframer()
    return deframer.feed(data) + deframer.flush()


def written(tmp_path: Path, words: str) -> list[Frame]:
    file = tmp_path / "out.bin"
    assert run("simulate", "--out", file, *words.split()).code == 0
    return frames_of(file.read_bytes())


def test_file_and_standard_output_get_the_simulators_bytes(tmp_path: Path) -> None:
    words = ["simulate", "--seconds", "90", "--seed", "5", "--out"]
    file = tmp_path / "out.bin"
    assert run(*words, file).code == 0
    sent = SimulatedEsc(seed=5).frames_until(90 * 10**9 - 1)
    expected = b"".join(frame.wire for frame in sent)
    assert file.read_bytes() == expected
    assert run(*words, "-").data == expected
    assert run(*words, tmp_path / "esc{n}.bin", "--esc", 3, "--layout", "legacy").code == 0
    files = [tmp_path / f"esc{n}.bin" for n in (1, 2, 3)]
    contents = [path.read_bytes() for path in files]
    assert len(set(contents)) == 3
    for data in contents:
        layouts = {frame.layout for frame in frames_of(data)}
        assert layouts == {WireLayout.LEGACY}


def test_error_bits_and_the_device_are_as_requested(tmp_path: Path) -> None:
    words = "--error undervoltage@1s+500ms --error BEC-overcurrent@2 --device kontrol-x"
    frames = written(tmp_path, f"{words} --seconds 6")
    lives = [frame.data for frame in frames if isinstance(frame.data, LiveData)]
    errors = [live.operating_errors for live in lives]
    undervoltage = [word & 1 for word in errors]
    assert undervoltage == [0] * 100 + [1] * 50 + [0] * 450
    overcurrent = [word >> OperatingError.BEC_OVERCURRENT & 1 for word in errors]
    assert overcurrent == [0] * 200 + [1] * 400
    infos = [frame.data for frame in frames if isinstance(frame.data, InfoData)]
    devices = [KONTRONIK.value("device_raw", info) for info in infos]
    assert devices == [Device.KONTROL_X] * 6
    assert KONTRONIK.value("variant", infos[0]) == 120
    assert KONTRONIK.firmware_text(infos[0]) == "4.17"
    assert infos[0].cell_count == 6


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_escs_on_terminals_are_listed_and_send_until_a_signal(
    tmp_path: Path, number: signal.Signals
) -> None:
    words = [*COMMAND, "--esc", "2", "--link", str(tmp_path / "esc{n}"), "--layout", "legacy"]
    pipe = subprocess.PIPE
    with subprocess.Popen(words, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout
        assert process.stderr
        lines = [process.stdout.readline().split() for _ in range(2)]
        assert [line[0] for line in lines] == ["esc1", "esc2"]
        for name, path in lines:
            assert str((tmp_path / name).readlink()) == path
            fd = os.open(tmp_path / name, os.O_RDONLY | os.O_NOCTTY)
            deframer = Deframer()
            frames: list[Frame] = []
            while len(frames) < 5:
                frames += deframer.feed(os.read(fd, 4096))
            os.close(fd)
            assert deframer.counters.dropped_bytes == 0
        process.send_signal(number)
        assert process.stdout.read() == ""
        assert "esc1: " in process.stderr.read()
    assert process.returncode == 0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.promise("silent-to-esc")
def test_gateway_that_transmits_to_the_esc_is_reported() -> None:
    pipe = subprocess.PIPE
    with subprocess.Popen(COMMAND, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout
        assert process.stderr
        path = process.stdout.readline().split()[1]
        fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
        os.write(fd, b"AT")
        loud = f"ERROR: esc1 {path}: the gateway transmits to the ESC: 41 54\n"
        assert process.stderr.readline() == loud
        process.send_signal(signal.SIGTERM)
        said = process.stderr.read()
        assert "the gateway transmits to the ESC: 41 54. Nothing may ever be sent" in said
        os.close(fd)
    assert process.returncode == 1


def test_regular_file_in_place_of_the_link_is_not_replaced(tmp_path: Path) -> None:
    link = tmp_path / "esc2"
    link.write_text("precious")
    said = refused(1, "simulate", "--esc", "2", "--link", tmp_path / "esc{n}", "--seconds", "1")
    assert "exists and is not a symbolic link" in said
    assert [file.name for file in tmp_path.iterdir()] == ["esc2"]
    assert link.read_text() == "precious"


def test_lost_and_disturbed_frames_are_missing_and_the_rest_is_decoded(tmp_path: Path) -> None:
    frames = written(tmp_path, "--seconds 3 --flip-bits 3e-4 --dropout 500ms/2s")
    assert 150 < len(frames) < 253
