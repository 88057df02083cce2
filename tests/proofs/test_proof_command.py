"""The texts, exit codes and refusals of ``make prove ARGS='-c gateway.toml'``."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import prove_dbc
import pytest
import z3  # type: ignore[import-untyped]
from command_line import refused, written
from dbc_proof import planned, proof
from prove_dbc import main
from specification.quantities import QUANTITIES, Divisor

from kontronik_can_gw.esc.values import VALUES
from kontronik_can_gw.native.rows import Signal
from kontronik_can_gw.native.tables import SOURCES
from kontronik_can_gw.signals.plan import MessageLayout

pytestmark = pytest.mark.promise("proven-dbc")

PROJECT = Path(__file__).resolve().parents[2]
Prove = Callable[..., "Done"]
ESC = '[[esc]]\nport = "/dev/ttyUSB0"\npole_pairs = 7\n'
DBC = """
BU_: Gateway
BO_ 256 Motor: 8 Gateway
 SG_ BatteryCurrent : 0|16@1- (0.1,0) [0|0] "A" Gateway
 SG_ MotorSpeed : 16|16@1+ (10,0) [0|0] "rpm" Gateway
 SG_ Throttle : 32|32@1- (1,0) [0|0] "%" Gateway
SIG_VALTYPE_ 256 Throttle : 1;
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_DEF_ "GenMsgCycleTime" 100;
VAL_ 256 MotorSpeed 65535 "NotAvailable" ;
"""


@dataclass
class Done:
    code: int
    out: str
    err: str


@pytest.fixture
def prove(capsys: pytest.CaptureFixture[str]) -> Callable[..., Done]:
    """Return a function that runs the command in this process."""

    def run_it(*words: object) -> Done:
        code = main([str(word) for word in words])
        return Done(code, *capsys.readouterr())

    return run_it


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Return a configuration with a small DBC."""
    written(tmp_path / "small.dbc", DBC)
    return written(tmp_path / "gateway.toml", f'{ESC}[dbc]\nfile = "small.dbc"\n')


def test_summary_lists_what_is_not_proven_by_name(path: Path, prove: Prove) -> None:
    done = prove("-c", path)
    assert done.code == 3
    assert done.out.startswith(f"{path}: layout ")
    assert "  proof     2 of 3 signals proven for all values and settings\n" in done.out
    assert "            both cores\n" in done.out
    assert "  not proven: Motor.Throttle: a float\n" in done.out
    assert 'no code for "not available", which is sent as a value: Motor.BatteryC' in done.out


def test_exit_code_is_0_if_each_signal_is_proven(path: Path, prove: Prove) -> None:
    text = DBC.replace("SIG_VALTYPE_ 256 Throttle : 1;", "")
    written(path.with_name("small.dbc"), text)
    done = prove("-c", path)
    assert done.code == 0
    assert "  proof     3 of 3 signals proven for all values and settings\n" in done.out


def test_v_names_the_proven_signals(path: Path, prove: Prove) -> None:
    assert "  proven    Motor.BatteryCurrent\n" in prove("-v", "-c", path).out


def test_json_contains_the_findings(path: Path, prove: Prove) -> None:
    done = prove("--json", "-c", path)
    assert done.code == 3
    assert json.loads(done.out) == {
        "proven": ["Motor.BatteryCurrent", "Motor.MotorSpeed"],
        "unproven": ["Motor.Throttle: a float"],
        "refuted": [],
        "refuted_signals": [],
        "without_code": ["Motor.BatteryCurrent"],
        "only_python": "",
    }


def test_wrong_plan_is_refuted_in_the_words_of_the_user(
    path: Path, prove: Prove, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = planned._python_plan

    def wrong(*arguments: Any) -> planned.Planned:
        plan = right(*arguments)
        assert plan.scale is not None
        if plan.length == 16 and plan.divisor is Divisor.POLES:
            return replace(plan, scale=replace(plan.scale, add=0))
        return replace(plan, high=plan.high - 1)

    monkeypatch.setattr(planned, "_python_plan", wrong)
    done = prove("-c", path)
    assert done.code == 4
    lines = [line for line in done.out.splitlines() if line.startswith("  REFUTED ")]
    assert lines[0] == (
        "  REFUTED   Motor.BatteryCurrent: battery current 3276.7 A "
        "is sent as NotAvailable, not as 3276.7 A"
    )
    assert lines[1].startswith("  REFUTED   Motor.MotorSpeed: motor speed ")
    assert " rpm with 7 pole pairs is sent as " in lines[1]


def test_no_signal_of_a_message_with_a_wrong_id_is_proven(
    path: Path, prove: Prove, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = planned.of_python

    def wrong(*arguments: Any) -> planned.PlannedMessage:
        return replace(right(*arguments), can_id=257)

    monkeypatch.setattr(proof, "of_python", wrong)
    done = prove("-c", path)
    assert done.code == 4
    assert "  proof     0 of 3 signals proven for all values and settings\n" in done.out
    assert "  REFUTED   Motor: is sent with CAN id 101h, not 100h\n" in done.out


def test_no_signal_of_a_message_that_is_never_sent_is_proven(
    path: Path, prove: Prove, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = proof.Proof.__init__

    def wrong(self: Any, database: Any, layout: MessageLayout, *others: Any) -> None:
        right(self, database, replace(layout, messages=()), *others)

    monkeypatch.setattr(proof.Proof, "__init__", wrong)
    done = prove("-c", path)
    assert done.code == 4
    assert "  proof     0 of 3 signals proven for all values and settings\n" in done.out
    assert "  REFUTED   Motor: is in the DBC, but is never sent\n" in done.out


def test_signal_that_the_solver_gives_up_is_listed_by_name(
    path: Path, prove: Prove, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(z3.Solver, "check", lambda _solver: z3.unknown)
    monkeypatch.setattr(z3.Solver, "reason_unknown", lambda _solver: "timeout")
    done = prove("-c", path)
    assert done.code == 3
    assert "  not proven: Motor.MotorSpeed: the solver gave up: timeout\n" in done.out


@pytest.mark.parametrize("option", ["-v", "--json"])
@pytest.mark.parametrize(
    ("end", "code", "message"),
    [
        ("| true", 141, ""),
        (">/dev/full", 1, "make prove: standard output: No space left on device\n"),
    ],
)
def test_output_that_cannot_be_written_is_no_counter_example(
    path: Path, option: str, end: str, code: int, message: str
) -> None:
    command = f'{{ "{sys.executable}" "{prove_dbc.__file__}" {option} -c "{path}"; echo $? >&2; }}'
    environment = os.environ | {"PYTHONPATH": f"{PROJECT}:{PROJECT / 'tests'}"}
    done = subprocess.run(
        ["sh", "-c", f"{command} {end}"], env=environment, capture_output=True, text=True
    )
    assert done.stderr == f"{message}{code}\n"


def test_proof_without_z3_ends_with_the_remedy(path: Path, tmp_path: Path) -> None:
    written(tmp_path / "z3.py", "raise ModuleNotFoundError(\"No module named 'z3'\", name='z3')")
    done = subprocess.run(
        [sys.executable, prove_dbc.__file__, "-c", path],
        env=os.environ | {"PYTHONPATH": f"{tmp_path}:{PROJECT}:{PROJECT / 'tests'}"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert done.stderr == (
        "make prove: z3: No module named 'z3'. Install it: tests/bootstrap.sh prove\n"
    )


def test_removed_option_prints_the_command_that_replaces_it(path: Path) -> None:
    line = refused(2, "check", "--prove", path)
    assert "--prove: was removed." in line
    assert "make prove ARGS='-c /PATH/gateway.toml'" in line


def test_make_passes_a_configuration_to_this_command() -> None:
    """Without one, it runs the proofs of this project."""
    # This test may run below another make, whose variables would reach this one.
    clean = {name: text for name, text in os.environ.items() if "MAKE" not in name}
    for arguments, program in (("-v -c x.toml", "prove_dbc.py"), ("-- -k crc", "run.py prove")):
        words = ["make", "-n", "prove", f"ARGS={arguments}"]
        shown = subprocess.run(
            words, cwd=PROJECT, env=clean, capture_output=True, text=True, check=True
        )
        script = shown.stdout[shown.stdout.index("case") :].replace(".venv/bin/python", "echo")
        done = subprocess.run(["sh", "-c", script], capture_output=True, text=True, check=True)
        assert f"{program} {arguments}" in done.stdout


def test_dbc_that_check_refuses_is_refused_the_same_way(path: Path, prove: Prove) -> None:
    written(path.with_name("small.dbc"), DBC.replace("Throttle", "Nothing"))
    done = prove("-c", path)
    assert done.code == 2
    assert done.err == f"make prove: {refused(2, 'check', path)}\n"


def test_without_a_dbc_output_there_is_nothing_to_prove(tmp_path: Path, prove: Prove) -> None:
    text = f"{ESC}[dbc]\nenabled = false\n[canopen]\nenabled = true\n"
    done = prove("-c", written(tmp_path / "gateway.toml", text))
    assert done.code == 2
    assert "dbc.enabled is false, so there is nothing to prove. Set it to true." in done.err


def test_each_value_is_in_the_sheet_of_the_proof() -> None:
    missing = VALUES.keys() ^ QUANTITIES.keys()
    assert not missing, "add them to tests/specification/quantities.py, or to esc/values.py"


def test_proof_reads_each_source_of_c_as_the_sheet_says() -> None:
    for (_, name), (kind, place) in SOURCES.items():
        if name in QUANTITIES:  # the others are shown by objects only
            quantity = QUANTITIES[name]
            found = planned.c_source(Signal(kind=kind, place=place))
            expected = (quantity.read, quantity.presence)
            assert found == expected, f"tests/proofs/dbc_proof/planned.py, c_source: {name}"
