"""``simulate``: terminals, links, files, signals; what is transmitted to the ESC."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import refused, run

from kontronik_can_gw.esc.kontronik.codec import Layout
from kontronik_can_gw.esc.kontronik.deframer import Deframer, Frame
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData
from kontronik_can_gw.esc.kontronik.protocol import KONTRONIK
from kontronik_can_gw.esc.kontronik.simulator import SimulatedEsc
from kontronik_can_gw.esc.kontronik.states import Device, OperatingError

COMMAND = [sys.executable, "-m", "kontronik_can_gw", "simulate"]


def frames_of(data: bytes) -> list[Frame]:
    deframer = Deframer()
    return deframer.feed(data) + deframer.flush()


def written(tmp_path: Path, words: str) -> list[Frame]:
    assert run("simulate", "--out", tmp_path / "out.bin", *words.split()).code == 0
    return frames_of((tmp_path / "out.bin").read_bytes())


def test_a_file_and_standard_output_get_the_simulators_bytes(
    tmp_path: Path,
) -> None:
    words = ["simulate", "--seconds", "90", "--seed", "5", "--out"]
    assert run(*words, tmp_path / "out.bin").code == 0
    expected = SimulatedEsc(seed=5).frames_until(90 * 10**9 - 1)
    assert (tmp_path / "out.bin").read_bytes() == b"".join(sent.wire for sent in expected)
    assert run(*words, "-").data == (tmp_path / "out.bin").read_bytes()
    assert run(*words, tmp_path / "esc{n}.bin", "--esc", 3, "--layout", "legacy").code == 0
    files = [(tmp_path / f"esc{n}.bin").read_bytes() for n in (1, 2, 3)]
    assert len(set(files)) == 3
    assert {frame.layout for file in files for frame in frames_of(file)} == {Layout.LEGACY}


def test_error_bits_and_the_device_are_as_requested(tmp_path: Path) -> None:
    words = "--error undervoltage@1s+500ms --error BEC-overcurrent@2 --device kontrol-x"
    frames = written(tmp_path, f"{words} --seconds 6")
    errors = [f.data.operating_errors for f in frames if isinstance(f.data, LiveData)]
    assert [word & 1 for word in errors] == [int(100 <= n < 150) for n in range(600)]
    bec = 1 << OperatingError.BEC_OVERCURRENT
    assert [word & bec for word in errors] == [bec if n >= 200 else 0 for n in range(600)]
    infos = [frame.data for frame in frames if isinstance(frame.data, InfoData)]
    assert [KONTRONIK.value("device_raw", info) for info in infos] == [Device.KONTROL_X] * 6
    assert KONTRONIK.value("variant", infos[0]) == 120
    assert (KONTRONIK.firmware_text(infos[0]), infos[0].cell_count) == ("4.17", 6)


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


def test_a_gateway_that_transmits_to_the_esc_is_reported() -> None:
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
        assert (
            "the gateway transmits to the ESC: 41 54. Nothing may ever be sent"
            in process.stderr.read()
        )
        os.close(fd)
    assert process.returncode == 1


def test_a_regular_file_in_place_of_the_link_is_not_replaced(tmp_path: Path) -> None:
    link = tmp_path / "esc2"
    link.write_text("precious")
    said = refused(1, "simulate", "--esc", "2", "--link", tmp_path / "esc{n}", "--seconds", "1")
    assert "exists and is not a symbolic link" in said
    assert [file.name for file in tmp_path.iterdir()] == ["esc2"]
    assert link.read_text() == "precious"


def test_lost_and_disturbed_frames_are_missing_and_the_rest_is_decoded(tmp_path: Path) -> None:
    assert 150 < len(written(tmp_path, "--seconds 3 --flip-bits 3e-4 --dropout 500ms/2s")) < 253
