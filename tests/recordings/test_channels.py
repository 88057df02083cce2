"""Logs of several buses: commands read one channel, and a copy of the log keeps all channels."""

import csv
import json
from pathlib import Path

import can
import pytest
from capture_bench import Bench, capture_file, made
from command_line import refused, run
from log_files import READERS, SUFFIX

from kontronik_can_gw.desk.recordings.can_logs.writer import Channels

pytestmark = pytest.mark.promise("logs")

VOLTS = {"can0": 25, "can1": 50}
FORMATS = sorted(READERS)


def _two_buses(path: Path, names: tuple[str, str] = ("can0", "can1")) -> Path:
    """Write a candump log whose battery has 25 V on the first bus and 50 V on the second."""
    lines = []
    for number in range(50):
        for name, volts in zip(names, VOLTS.values(), strict=True):
            second = 1_700_000_000 + number * 0.01
            if volts == 50:
                second += 0.0004
            steps = (volts * 100).to_bytes(2, "little").hex().upper()
            lines.append(f"({second:.6f}) {name} 688#000000{steps}001400\n")
    path.write_text("".join(lines))
    return path


def _in_format(tmp_path: Path, format_: str) -> Path:
    source = _two_buses(tmp_path / "source.log")
    path = tmp_path / f"two{SUFFIX[format_]}"
    form = "mf4-log" if format_ == "mf4" else format_
    assert run("convert", source, path, "--to", form).code == 0
    return path


def _voltages(log: Path, *words: object) -> set[str]:
    table = log.with_name("table.csv")
    done = run("convert", log, table, "--force", "--signals", "battery_voltage", *words)
    assert done.code == 0, done.err
    with table.open() as file:
        return {row["battery_voltage [V]"] for row in csv.DictReader(file)}


@pytest.mark.parametrize("format_", FORMATS)
def test_channel_is_chosen_by_its_name_in_the_log(tmp_path: Path, format_: str) -> None:
    log = _in_format(tmp_path, format_)
    names = ("can0", "can1") if format_ == "candump" else ("1", "2")
    assert _voltages(log, "--channel", names[0]) == {"25.0"}
    assert _voltages(log, "--channel", names[1]) == {"50.0"}
    listed = ", ".join(names)
    ambiguous = (
        f"{log}: several channels have messages of kontronik_esc.dbc. "
        f"Choose one with --channel: {listed}."
    )
    page = tmp_path / "page.html"
    for words in (
        ("convert", log, tmp_path / "other.csv"),
        ("report", log, "-o", page),
        ("monitor", "--once", log),
    ):
        assert refused(2, *words) == ambiguous
        assert (
            refused(2, *words, "--channel", "7") == f"{log}: has no channel 7. Available: {listed}."
        )
    assert not (tmp_path / "other.csv").exists()
    assert not page.exists()
    assert run("report", log, "-o", page, "--channel", names[1]).code == 0
    assert "50.0" in page.read_text()
    assert "25.0" not in page.read_text()
    shown = json.loads(run("monitor", "--once", log, "--channel", names[1]).out)
    assert shown["escs"][0]["values"]["battery_voltage"] == 50


@pytest.mark.parametrize("format_", FORMATS)
def test_copy_of_a_log_keeps_the_channels(tmp_path: Path, format_: str) -> None:
    log = _in_format(tmp_path, format_)
    if format_ != "candump":
        with READERS[format_](log) as reader:
            first = {"mf4": 1, "trc": 1}.get(format_, 0)  # number of channel 1 in python-can
            channels = [message.channel for message in reader]
        assert channels == [first, first + 1] * 50
    back = tmp_path / "back.log"
    done = run("convert", log, back)
    assert ("channels: 1 is can0, 2 is can1" in done.err) == (format_ != "candump")
    assert _names_and_frames(back) == _names_and_frames(tmp_path / "source.log")
    name = "can1" if format_ == "candump" else "2"
    assert run("convert", log, back, "--force", "--channel", name).code == 0
    copied = _names_and_frames(back)
    assert len(copied) == 50
    assert {channel for channel, _ in copied} == {"can1"}


def _names_and_frames(log: Path) -> list[list[str]]:
    return [line.split()[1:3] for line in log.read_text().splitlines()]


def test_only_channel_with_messages_of_the_dbc_is_chosen(tmp_path: Path) -> None:
    log = _two_buses(tmp_path / "two.log")
    log.write_text(log.read_text().replace("can1 688", "can1 123"))
    assert _voltages(log) == {"25.0"}
    done = run("convert", log, tmp_path / "other.csv")
    assert f"{log}: 50 CAN frames left out that are not in kontronik_esc.dbc" in done.err
    done = run("convert", log, tmp_path / "other.csv", "--channel", "can0", "--force")
    assert "left out" not in done.err


def test_all_channels_of_the_whole_log_are_listed(tmp_path: Path) -> None:
    log = _two_buses(tmp_path / "many.log")
    lines = log.read_text().splitlines(keepends=True)
    log.write_text("".join([*lines, "(1700000001.000000) vcan7 688#0000008813001400\n"]))
    assert refused(2, "convert", log, tmp_path / "o.csv").endswith("--channel: can0, can1, vcan7.")


def test_capture_has_no_channels(tmp_path: Path) -> None:
    bench = Bench(*made()).live(3, 0.5)
    path = tmp_path / "a.kcap"
    path.write_bytes(capture_file(bench.setup, bench.entries))
    said = refused(2, "convert", path, tmp_path / "o.csv", "--channel", "can0")
    assert said == f"{path}: is not a CAN log, so --channel can0 has no effect. Leave it out."


@pytest.mark.parametrize(
    ("channels", "numbers", "names"),
    [
        (["can0", "can1"], [1, 2], ["can0", "can1"]),
        (["can1", "vcan1", "can0"], [2, 1, 3], ["can1", "vcan1", "can0"]),
        (["bus", "slcan0"], [1, 2], ["bus", "slcan0"]),
        (["can300", ""], [1, 2], ["can300", "own"]),
        (["1", "0", "2"], [1, 2, 3], ["can0", "can1", "can2"]),
        (["3"], [3], ["can2"]),
        (["can0", "1"], [1, 2], ["can0", "can1"]),
    ],
)
def test_each_channel_gets_a_unique_number_and_name(
    channels: list[str],
    numbers: list[int],
    names: list[str],
) -> None:
    of_numbers = Channels("own")
    of_names = Channels("own")
    for _ in range(2):
        assert [of_numbers.number_of(channel) for channel in channels] == numbers
        assert [of_names.name_of(channel) for channel in channels] == names


def test_channels_of_logs_by_python_can_count_as_in_its_tools(tmp_path: Path) -> None:
    """python-can counts channels from 0, but ASC, BLF and the tools of their makers from 1."""
    data = bytes.fromhex("000000C409001400")
    for suffix, name in (
        (".asc", "2"),
        (".blf", "2"),
        (".trc", "2"),
        (".mf4", "1"),
    ):
        path = tmp_path / f"log{suffix}"
        with can.Logger(path) as writer:
            writer(can.Message(1_700_000_000.0, 0x688, False, data=data, channel=1))
        assert _voltages(path, "--channel", name) == {"25.0"}
