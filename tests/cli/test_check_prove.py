"""The texts, exit codes and refusals of ``check --prove``. tests/proofs tests the proofs."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from command_line import refused, run, written

from dbc_proof import planned
from dbc_proof.quantities import QUANTITIES, Divisor
from kontronik_can_gw.esc.values import VALUES
from kontronik_can_gw.signals.plan import Layout

pytest.importorskip("z3")

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


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Return a configuration with a small DBC."""
    written(tmp_path / "small.dbc", DBC)
    return written(tmp_path / "gateway.toml", f'{ESC}[dbc]\nfile = "small.dbc"\n')


def test_the_summary_lists_what_is_not_proven_by_name(path: Path) -> None:
    done = run("check", "--prove", path)
    assert done.code == 0
    assert "  proof     2 of 3 signals proven for all values and settings\n" in done.out
    assert "            both cores\n" in done.out
    assert "  not proven: Motor.Throttle: a float\n" in done.out
    assert 'no code for "not available", which is sent as a value: Motor.BatteryC' in done.out


def test_v_names_the_proven_signals(path: Path) -> None:
    assert "  proven    Motor.BatteryCurrent\n" in run("check", "--prove", "-v", path).out


def test_json_contains_the_findings(path: Path) -> None:
    done = run("check", "--prove", "--json", path)
    assert done.code == 0
    assert json.loads(done.out)["proof"] == {
        "proven": ["Motor.BatteryCurrent", "Motor.MotorSpeed"],
        "unproven": ["Motor.Throttle: a float"],
        "refuted": [],
        "refuted_signals": [],
        "without_code": ["Motor.BatteryCurrent"],
        "only_python": "",
    }
    assert "proof" not in json.loads(run("check", "--json", path).out)


def test_a_wrong_plan_is_refuted_in_the_words_of_the_user(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = planned._python_plan

    def wrong(*arguments: Any) -> planned.Planned:
        plan = right(*arguments)
        assert plan.scale is not None
        if plan.length == 16 and plan.divisor is Divisor.POLES:
            return replace(plan, scale=replace(plan.scale, add=0))
        return replace(plan, high=plan.high - 1)

    monkeypatch.setattr(planned, "_python_plan", wrong)
    done = run("check", "--prove", path)
    assert done.code == 1
    lines = [line for line in done.out.splitlines() if line.startswith("  REFUTED ")]
    assert lines[0] == (
        "  REFUTED   Motor.BatteryCurrent: battery current 3276.7 A "
        "is sent as NotAvailable, not as 3276.7 A"
    )
    assert lines[1].startswith("  REFUTED   Motor.MotorSpeed: motor speed ")
    assert " rpm with 7 pole pairs is sent as " in lines[1]


def test_no_signal_of_a_message_with_a_wrong_id_is_proven(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dbc_proof import proof  # needs z3

    right = planned.of_python

    def wrong(*arguments: Any) -> planned.PlannedMessage:
        return replace(right(*arguments), can_id=257)

    monkeypatch.setattr(proof, "of_python", wrong)
    done = run("check", "--prove", path)
    assert done.code == 1
    assert "  proof     0 of 3 signals proven for all values and settings\n" in done.out
    assert "  REFUTED   Motor: is sent with CAN id 101h, not 100h\n" in done.out


def test_no_signal_of_a_message_that_is_never_sent_is_proven(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dbc_proof import proof  # needs z3

    right = proof.Proof.__init__

    def wrong(self: Any, database: Any, layout: Layout, *others: Any) -> None:
        right(self, database, replace(layout, messages=()), *others)

    monkeypatch.setattr(proof.Proof, "__init__", wrong)
    done = run("check", "--prove", path)
    assert done.code == 1
    assert "  proof     0 of 3 signals proven for all values and settings\n" in done.out
    assert "  REFUTED   Motor: is in the DBC, but is never sent\n" in done.out


def test_a_signal_that_the_solver_gives_up_is_listed_by_name(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import z3  # type: ignore[import-untyped]

    monkeypatch.setattr(z3.Solver, "check", lambda _solver: z3.unknown)
    monkeypatch.setattr(z3.Solver, "reason_unknown", lambda _solver: "timeout")
    done = run("check", "--prove", path)
    assert done.code == 0
    assert "  not proven: Motor.MotorSpeed: the solver gave up: timeout\n" in done.out


@pytest.fixture
def not_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the next command import z3 and the modules of the proof again."""
    for name in [*sys.modules]:
        if "desk.proof" in name or name.partition(".")[0] == "z3":
            monkeypatch.delitem(sys.modules, name)


def install_other_z3(folder: Path, monkeypatch: pytest.MonkeyPatch, source: str) -> None:
    """Put a package with the name z3 before the installed one."""
    (folder / "other/z3").mkdir(parents=True)
    written(folder / "other/z3/__init__.py", source)
    monkeypatch.syspath_prepend(str(folder / "other"))


@pytest.mark.usefixtures("not_imported")
def test_without_z3_the_command_says_how_to_install_it(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "z3", None)
    line = refused(1, "check", "--prove", path)
    assert line.startswith("check --prove needs z3-solver>=")
    assert "Install it: " in line


@pytest.mark.usefixtures("not_imported")
@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("raise OSError('libz3.so: cannot open')", "libz3.so: cannot open"),
        ("print('Advice')\nraise Exception('libz3.so\\nnot found.')", "libz3.so not found"),
        ("raise AttributeError", "AttributeError"),
        ("import nothing_of_this_name", "No module named 'nothing_of_this_name'"),
    ],
)
def test_a_broken_z3_is_reported_with_the_reason(
    path: Path, monkeypatch: pytest.MonkeyPatch, source: str, reason: str
) -> None:
    install_other_z3(path.parent, monkeypatch, source)
    line = refused(1, "check", "--prove", path)
    assert line.startswith("check --prove needs z3-solver>=")
    assert ", but z3 is broken: " in line
    assert f"{reason}. Install it again: " in line


@pytest.mark.usefixtures("not_imported")
def test_another_package_with_the_name_z3_is_reported(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install_other_z3(path.parent, monkeypatch, "def backup() -> None: ...")
    line = refused(1, "check", "--prove", path)
    assert "the installed z3 is another library" in line
    assert "-m pip uninstall z3. Then: " in line
    assert "-m pip install --force-reinstall 'z3-solver>=" in line


@pytest.mark.usefixtures("not_imported")
def test_an_import_error_of_the_proof_itself_does_not_blame_z3(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "dbc_proof.formulas", None)
    with pytest.raises(ImportError, match="formulas"):
        run("check", "--prove", path)


@pytest.mark.usefixtures("not_imported")
def test_json_without_z3_contains_the_line_as_a_mistake(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "z3", None)
    done = run("check", "--prove", "--json", path)
    assert done.code == 1
    assert done.err == ""
    (line,) = json.loads(done.out)["mistakes"]
    assert line.startswith("check --prove needs z3-solver>=")


def test_a_dbc_that_check_refuses_is_refused_the_same_way(path: Path) -> None:
    written(path.with_name("small.dbc"), DBC.replace("Throttle", "Nothing"))
    assert refused(2, "check", "--prove", path) == refused(2, "check", path)


def test_without_a_dbc_output_there_is_nothing_to_prove(tmp_path: Path) -> None:
    text = f"{ESC}[dbc]\nenabled = false\n[canopen]\nenabled = true\n"
    line = refused(2, "check", "--prove", written(tmp_path / "gateway.toml", text))
    assert "--prove has nothing to prove" in line
    done = run("check", "--prove", "--json", tmp_path / "gateway.toml")
    assert done.code == 2
    assert json.loads(done.out)["mistakes"] == [line]


def test_each_value_is_in_the_sheet_of_the_proof() -> None:
    assert QUANTITIES.keys() == VALUES.keys()
