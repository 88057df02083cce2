"""`tests/vm/run` names `make test` when the set-up is missing, and finds the programs of .venv.

It runs a virtual machine on one CPU, and each on another one if possible.
"""

import os
import subprocess
import sys

import pytest
import vm_run

pytestmark = pytest.mark.promise("independent-tests")


@pytest.fixture
def no_vcan_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """A kernel without vcan, in which no virtual machine starts."""
    monkeypatch.setenv("PATH", os.environ["PATH"])  # `main` extends it
    monkeypatch.setattr(vm_run, "native_prefix", lambda: None)
    monkeypatch.setattr(vm_run, "leave", lambda *_: None)
    monkeypatch.setattr("signal.signal", lambda *_: None)
    monkeypatch.setattr(vm_run, "run_in_vm", lambda *_: (vm_run.VM_FAILED, False))
    monkeypatch.setattr(sys, "argv", ["vm_run.py", "--", "true"])


@pytest.mark.parametrize(
    ("vms", "problem"),
    [
        ([], "this kernel has no vcan and no virtual machine."),
        (["uml"], "this kernel has no vcan, and none of its virtual machines starts."),
    ],
)
def test_without_a_virtual_machine_the_remedy_is_named(
    vms: list[str],
    problem: str,
    no_vcan_here: None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(vm_run, "installed", lambda: vms)
    assert vm_run.main() == vm_run.VM_FAILED
    assert capsys.readouterr().err == f"vm/run: {problem} {vm_run.SET_UP}\n"


def test_without_venv_a_line_names_make_test_before_the_command_runs(
    no_vcan_here: None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(vm_run, "installed", lambda: ["uml"])
    monkeypatch.setattr(vm_run, "run_in_vm", lambda *_: (127, True))
    monkeypatch.setattr(sys, "prefix", sys.base_prefix)
    assert vm_run.main() == 127
    assert capsys.readouterr().err == (
        f"vm/run: {sys.executable} is not the project's .venv. {vm_run.SET_UP}\n"
    )


def test_programs_of_the_venv_come_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/usr/bin:/home/me/bin")
    monkeypatch.setattr(sys, "prefix", "/clone/.venv")
    vm_run.extend_path()
    folders = ["/clone/.venv/bin", "/usr/bin", "/home/me/bin", "/usr/sbin", "/sbin", "/bin"]
    assert os.environ["PATH"].split(":") == folders


def test_virtual_machines_take_the_cpus_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vm_run, "reserved", [])
    cpus = {2001, 2002}  # no other virtual machine can have them
    taken = [vm_run.reserved_cpu(cpus) for _ in range(5)]
    assert taken == [2001, 2002, 2001, 2002, 2001]
    vm_run.reserved[1].close()
    assert vm_run.reserved_cpu(cpus) == 2002
    for name in vm_run.reserved:
        name.close()


def test_virtual_machine_and_its_children_run_on_one_cpu() -> None:
    before = os.sched_getaffinity(0)
    code = "import os; print(len(os.sched_getaffinity(0)))"
    with vm_run.on_one_cpu():
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    vm_run.reserved.pop().close()
    assert done.stdout == b"1\n"
    assert os.sched_getaffinity(0) == before
