"""The DBCs of this project are proven by the solver, and faults of the compiler are refuted."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import prove_dbc
import pytest
from command_line import written
from dbc_proof.proof import IS_CRC, IS_FLOAT
from packer_oracle import Msg, Sig, dbc_text
from put_in_faults import Fault

from kontronik_can_gw.assembly.assemble import load_configuration

pytestmark = pytest.mark.promise("proven-dbc")

PROJECT = Path(__file__).resolve().parents[2]
TESTS = PROJECT / "tests"
EXAMPLES = {
    "four-escs-canopen/bus.dbc": 402,
    "j1939/j1939.dbc": 9,
    "one-esc/bus.dbc": 108,
    "vehicle-dbc/vehicle.dbc": 11,
}
"""The DBC on the bus of each example, and the number of its signals that the gateway sends."""
ONE_ESC = '[[esc]]\nport = "/dev/ttyUSB0"\npole_pairs = 7\n'
EVERY_RULE = f"""
[can]
fd = true
[[esc]]
name = "left"
port = "/dev/ttyUSB0"
pole_pairs = 7
gear = "5/2"
[[esc]]
name = "right"
port = "/dev/ttyUSB1"
pole_pairs = 3
[dbc]
file = "{Path(__file__).with_name("every_rule.dbc")}"
unbound = "start_value"
"""
"""A DBC with each kind of signal, and two ESCs."""
LIST = PROJECT / "tests/mutants/plan_faults.toml"
LIMIT_S = 300


def configuration(folder: Path, dbc: str = "", keys: str = "") -> Path:
    """Write a configuration with one of the DBCs of this folder, and further keys of [dbc]."""
    text = EVERY_RULE + keys
    if dbc:
        text = text.replace("every_rule.dbc", dbc)
    return written(folder / "gateway.toml", text)


def proof_of(path: Path) -> dict[str, Any]:
    """Return the findings about the DBC of a configuration."""
    return asdict(prove_dbc.proof_of(load_configuration(path)))


def signals_in(dbc: Path) -> list[str]:
    """Return "Message.Signal" for each signal of a gateway's node in the text of a DBC."""
    found = []
    message = transmitter = ""
    for line in dbc.read_text(encoding="cp1252").splitlines():
        if start := re.match(r"BO_ \d+ (\w+): \d+ (\w+)", line):
            message, transmitter = start.groups()
        elif (signal := re.match(r" SG_ (\w+) ", line)) and transmitter.endswith("Gateway"):
            found.append(f"{message}.{signal[1]}")
    return found


def test_each_signal_of_the_shipped_dbc_is_proven(tmp_path: Path) -> None:
    found = proof_of(written(tmp_path / "gateway.toml", ONE_ESC))
    assert found["refuted"] == []
    assert found["unproven"] == []
    assert sorted(found["proven"]) == sorted(signals_in(PROJECT / "dbc/kontronik_esc.dbc"))
    assert len(found["proven"]) == 108
    assert found["only_python"] == ""


@pytest.mark.parametrize(("dbc", "signals"), EXAMPLES.items())
def test_each_signal_of_an_example_is_proven(dbc: str, signals: int) -> None:
    file = PROJECT / "examples" / dbc
    found = proof_of(file.with_name("gateway.toml"))
    assert found["refuted"] == []
    assert found["unproven"] == []
    assert sorted(found["proven"]) == sorted(signals_in(file))
    assert len(found["proven"]) == signals


def test_list_of_examples_is_complete() -> None:
    configurations = (PROJECT / "examples").glob("*/gateway.toml")
    assert {file.parent.name for file in configurations} == {Path(dbc).parts[0] for dbc in EXAMPLES}


def test_each_signal_of_a_dbc_is_named_as_proven_or_not_proven(tmp_path: Path) -> None:
    """One signal is a float and one a CRC. The lines of ``check`` name each signal once."""
    signals = [
        Sig("M_CRC", 0, 8),
        Sig("M_BZ", 8, 4),
        Sig("BatteryVoltage", 16, 16, unit="V", factor="0.01"),
        Sig("Throttle", 32, 32, is_float=True, unit="%"),
    ]
    dbc = written(tmp_path / "mixed.dbc", dbc_text([Msg("M", 0x123, 8, signals)]))
    keys = f'[dbc]\nfile = "{dbc}"\nnode = "Gateway"\n[dbc.e2e]\nM = "1A"\n'
    found = proof_of(written(tmp_path / "gateway.toml", ONE_ESC + keys))
    assert found["refuted"] == []
    assert found["unproven"] == [f"M.M_CRC: {IS_CRC}", f"M.Throttle: {IS_FLOAT}"]
    named = [*found["proven"], *(line.partition(": ")[0] for line in found["unproven"])]
    assert sorted(named) == sorted(signals_in(dbc))
    assert len(named) == len(signals)


def test_dbc_with_each_kind_of_signal_is_proven_completely(tmp_path: Path) -> None:
    found = proof_of(configuration(tmp_path))
    assert found["refuted"] == []
    assert found["unproven"] == []
    assert found["only_python"] == ""


@pytest.mark.parametrize("name", ["my_car", "no_start_values", "kontronik_esc_0.5.0"])
def test_dbc_of_the_golden_set_is_proven_except_floats_and_crcs(tmp_path: Path, name: str) -> None:
    file = PROJECT / f"tests/golden/inputs/{name}.dbc"
    text = f'[can]\nfd = true\n{ONE_ESC}[dbc]\nfile = "{file}"\nunbound = "start_value"\n'
    if name == "my_car":
        text += 'node = "Gateway"\n'
    found = proof_of(written(tmp_path / "gateway.toml", text))
    assert found["refuted"] == []
    assert found["proven"]
    reasons = {line.partition(": ")[2] for line in found["unproven"]}
    assert reasons <= {IS_FLOAT, IS_CRC}


@pytest.mark.parametrize("profile", ["1A", "1B", "1C", "2", "5", "11A", "11C", "22"])
def test_e2e_message_is_proven_except_the_computation_of_its_crc(
    tmp_path: Path, profile: str
) -> None:
    crc_bits = 16 if profile == "5" else 8
    signals = [
        Sig("M_CRC", 0, crc_bits),
        Sig("M_BZ", crc_bits, 8 if profile == "5" else 4),
        Sig("BatteryVoltage", 24, 16, unit="V", factor="0.01"),
    ]
    if profile.endswith("C"):
        signals.append(Sig("M_DataIDNibble", crc_bits + 4, 4))
    dbc = written(tmp_path / "e2e.dbc", dbc_text([Msg("M", 0x123, 8, signals)]))
    data_ids: object = [*range(3, 19)] if profile in ("2", "22") else 0xACD
    text = f'{ONE_ESC}[dbc]\nfile = "{dbc}"\nnode = "Gateway"\n[dbc.e2e]\nM = "{profile}"\n'
    text += f"[dbc.e2e_data_ids]\nM = {data_ids}\n"
    found = proof_of(written(tmp_path / "gateway.toml", text))
    assert found["refuted"] == []
    assert found["only_python"] == ""
    assert found["unproven"] == [f"M.M_CRC: {IS_CRC}"]
    assert {"M.M_BZ", "M.BatteryVoltage"} <= {*found["proven"]}


@pytest.mark.parametrize(
    ("keys", "signals"),
    [
        ("", {"Gateway.Uptime", "LeftMotor.LeftBatteryVoltage", "RightMotor.RightBatteryVoltage"}),
        ("base_id = 0x300\nid_step = 8", {"Gateway.Uptime"}),
        ('messages = ["Gateway"]', {"Gateway.Uptime"}),
        ('bind = {BatteryVoltage = "left.battery_voltage"}', {"EscMotor.BatteryVoltage"}),
    ],
)
def test_copies_for_several_escs_are_proven(tmp_path: Path, keys: str, signals: set[str]) -> None:
    found = proof_of(configuration(tmp_path, "copied.dbc", keys))
    assert found["refuted"] == []
    assert signals <= {*found["proven"]}


def test_chosen_messages_without_a_transmitter_are_proven(tmp_path: Path) -> None:
    text = Path(__file__).with_name("copied.dbc").read_text()
    for node in ("KontronikGateway", "Other"):
        text = text.replace(f": 8 {node}\n", ": 8 Vector__XXX\n")
    dbc = written(tmp_path / "no_node.dbc", text)
    keys = f'[dbc]\nfile = "{dbc}"\nmessages = ["EscMotor"]\n'
    found = proof_of(written(tmp_path / "gateway.toml", ONE_ESC + keys))
    assert found["refuted"] == []
    assert found["proven"] == ["EscMotor.BatteryVoltage"]


def test_layout_that_only_python_can_send_is_proven_for_python(tmp_path: Path) -> None:
    found = proof_of(configuration(tmp_path, "wide.dbc"))
    assert found["refuted"] == []
    assert found["proven"] == ["LeftWide.LeftMotorRunTime", "RightWide.RightMotorRunTime"]
    assert "exceeds 64 bits" in found["only_python"]


# --- the proof can fail


@dataclass(frozen=True)
class PlanFault:
    """A fault in the compiler of DBCs, and how the proof must refute it."""

    fault: Fault
    refuted_as: str
    dbc: str
    keys: str


def plan_faults() -> list[PlanFault]:
    found = []
    for each in tomllib.loads(LIST.read_text())["fault"]:
        refuted_as = each.pop("refuted_as")
        dbc = each.pop("dbc", "")
        keys = each.pop("keys", "")
        found.append(PlanFault(Fault(**each), refuted_as, dbc, keys))
    return found


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return a copy of the package, in which faults are put."""
    folder = tmp_path_factory.mktemp("copy")
    left_out = shutil.ignore_patterns("__pycache__", "*.so")
    for name in ("kontronik_can_gw", "dbc", "eds"):
        shutil.copytree(PROJECT / name, folder / name, ignore=left_out)
    yield folder
    shutil.rmtree(folder)


@pytest.mark.parametrize("each", plan_faults(), ids=lambda each: each.fault.what)
def test_fault_of_the_compiler_is_refuted(each: PlanFault, copy: Path, tmp_path: Path) -> None:
    file, changed = each.fault.put_in(copy)
    whole = file.read_text()
    file.write_text(changed)
    words = [prove_dbc.__file__, "--json", "-c", configuration(tmp_path, each.dbc, each.keys)]
    try:
        done = subprocess.run(
            [sys.executable, *map(str, words)],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": f"{copy}:{TESTS}", "PYTHONDONTWRITEBYTECODE": "1"},
            capture_output=True,
            timeout=LIMIT_S,
            check=False,
        )
    finally:
        file.write_text(whole)
    assert done.returncode == prove_dbc.REFUTED, done.stderr.decode()
    refuted_lines = json.loads(done.stdout)["refuted"]
    assert any(each.refuted_as in line for line in refuted_lines), refuted_lines
