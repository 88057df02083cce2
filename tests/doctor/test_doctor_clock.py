"""Findings of `doctor` about the wall clock."""

from pathlib import Path

import pytest
from doctor_trees import Tree, only

from kontronik_can_gw.desk.doctor import Finding, Findings
from kontronik_can_gw.desk.doctor.clock import check_clock
from kontronik_can_gw.desk.doctor.machine import Machine
from kontronik_can_gw.runtime.system.clock import ClockFacts

pytestmark = pytest.mark.promise("doctor", "clock")


def findings(tree: Tree) -> list[Finding]:
    found = Findings("Machine")
    check_clock(tree, found)
    return found.found


@pytest.mark.parametrize(
    ("is_synchronized", "process", "severity", "text", "command"),
    [
        (True, "", "ok", "the clock is synchronised", ""),
        (None, "", "note", "it is not known", ""),
        (False, "", "warning", "no time service runs", "sudo timedatectl set-ntp true"),
        (False, "systemd-timesyn", "warning", "systemd-timesyncd runs, but has no time",
         "timedatectl timesync-status"),
        (False, "chronyd", "warning", "chronyd runs", "chronyc tracking"),
    ],
)  # fmt: skip
def test_clock_that_is_not_synchronised_is_a_warning_with_the_remedy(
    tmp_path: Path,
    is_synchronized: bool | None,
    process: str,
    severity: str,
    text: str,
    command: str,
) -> None:
    tree = Tree(tmp_path)
    tree.wall_clock = ClockFacts(is_synchronized, hardware="rtc-ds3231")
    if process:
        tree.process(7, f"/usr/sbin/{process}")
    found = only(findings(tree), "machine.clock")
    assert found.severity == severity
    assert text in found.text
    assert found.command == command


@pytest.mark.parametrize(
    ("hardware", "severity", "text"),
    [("rtc-ds3231", "ok", "rtc-ds3231"), ("", "note", "after power was off")],
)
def test_missing_hardware_clock_is_a_note(
    tmp_path: Path, hardware: str, severity: str, text: str
) -> None:
    tree = Tree(tmp_path)
    tree.wall_clock = ClockFacts(True, hardware=hardware)
    found = only(findings(tree), "machine.hardware_clock")
    assert found.severity == severity
    assert text in found.text
    tree.wall_clock = ClockFacts(True, hardware=None)
    assert [each.check for each in findings(tree)] == ["machine.clock"]


def test_clock_of_this_machine_can_be_read(tmp_path: Path) -> None:
    (tmp_path / "sys/class/rtc/rtc0").mkdir(parents=True)
    (tmp_path / "sys/class/rtc/rtc0/name").write_text("rtc-test\n")
    clock = Machine(tmp_path).clock()
    assert clock.hardware == "rtc-test"
    assert clock.synchronized in (True, False)
