"""What the fault programme makes of faults that ran while processor time was taken away."""

import itertools
import os
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree as ET

import pytest
from fault_report import FAILED, GOOD, NOT_JUDGED, Report, Row, in_order
from harness import Bench
from programme import conclude, run_one
from qemu_adapter import SerialAdapter
from taken import Load, Sample, worst_share


def row(name: str = "x", taken: float = 0.0, **counts: Any) -> Row:
    return Row(name, 2.0, **{"injected": 3, "recovered": 3, "taken": taken, **counts})


@pytest.mark.parametrize(
    ("taken", "counts", "state"),
    [
        (0.0, {}, GOOD),
        (0.5, {}, GOOD),
        (0.0, {"recovered": 2}, FAILED),
        (0.1, {"lost": 1}, FAILED),
        (0.11, {"lost": 1}, NOT_JUDGED),
        (0.11, {"recovered": 2}, NOT_JUDGED),
        (0.5, {"wrong": 1}, FAILED),
        (0.5, {"wrong": 2, "old": 1}, FAILED),
        (0.0, {"wrong": 2, "old": 2}, FAILED),
        (0.5, {"wrong": 2, "old": 2}, NOT_JUDGED),
        (0.5, {"lost": 1, "wrong": 1}, FAILED),
        (0.5, {"transmitted": 1}, FAILED),
        (0.5, {"recovered": 2, "ended": True}, FAILED),
        (0.0, {"injected": 0, "recovered": 0}, FAILED),
    ],
)
def test_lateness_and_loss_are_judged_on_a_machine_that_could_run_and_wrong_values_always(
    taken: float, counts: dict[str, Any], state: str
) -> None:
    assert row(taken=taken, **counts).state == state


def test_states_stand_in_both_reports_and_a_wrong_value_fails_anyhow(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = Report(good=row("good"), late=row("late", 0.3, recovered=2))
    assert conclude(report) == 0
    report["wrong"] = row("wrong", 0.3, wrong=1)
    assert conclude(report) == 1
    assert capsys.readouterr().out.endswith("3 faults: 1 failed, 1 good, 1 not judged\n")
    out, again = tmp_path / "out", Report()
    report.write(out)
    again.read(out)
    assert [each.state for each in again.values()] == [GOOD, NOT_JUDGED, FAILED]
    report.write_junit(out)
    cases = [[found.tag for found in case] for case in ET.parse(out).iter("testcase")]
    assert cases == [[], ["skipped"], ["failure"]]
    assert conclude(Report()) == 1, "nothing was run"


def at(*shares: float) -> list[Sample]:
    """Two samples a second, between which such shares were taken."""
    taken = itertools.accumulate([0.0, *(share / 2 for share in shares)])
    return [Sample(n / 2, each) for n, each in enumerate(taken)]


def test_the_worst_second_counts() -> None:
    assert worst_share(at(*[0.0] * 40), 0, 20) == 0
    assert worst_share(at(*[0.0] * 20, *[0.5] * 2, *[0.0] * 20), 0, 21) == 0.5
    assert worst_share(at(*[0.0] * 20, 0.5, *[0.0] * 20), 0, 20.5) == pytest.approx(0.25)
    assert worst_share(at(*[0.0] * 20, 0.5), 10, 10.5) == 0.5, "a short fault by itself"
    assert worst_share(at(*[0.5] * 20, *[0.0] * 20), 10, 20) == 0, "what was before is not its own"


def test_all_that_the_virtual_machine_started_in_sessions_of_its_own_is_watched() -> None:
    load = Load()
    load.machine = os.getpid()
    children = [subprocess.Popen(["sleep", "600"], start_new_session=True) for _ in range(2)]
    try:
        load.take()
        watched = {file.split("/")[2] for file in load.waits}
    finally:
        for child in children:
            child.kill()
            child.wait()
    assert {str(child.pid) for child in children} <= watched
    assert str(os.getpid()) not in watched


def test_bytes_to_an_esc_are_the_kernels_echo_until_the_port_is_set_and_the_gateways_from_then_on() -> (
    None
):
    adapter = SerialAdapter("x")

    def set_line(divisor: int, parity_and_bits: int) -> None:
        adapter.vendor(3, divisor, 0, 0)
        adapter.vendor(4, parity_and_bits, 0, 0)

    set_line(312, 0x0008)  # 9600 8N1, at the opening
    adapter.take(b"echo")
    set_line(26, 0x0208)  # 115200 8E1
    adapter.take(b"A")
    set_line(312, 0x0008)  # by another program
    adapter.take(b"B")
    assert adapter.received == 2


@pytest.mark.parametrize(("ends", "state"), [(True, FAILED), (False, NOT_JUDGED)])
def test_a_gateway_that_ended_fails_whatever_was_taken(ends: bool, state: str) -> None:
    class OfOneProcess(Bench):
        def __init__(self, process: "subprocess.Popen[bytes]") -> None:
            self._gateway: Any = SimpleNamespace(process=process, lines=["the last word"])

        def inject(self, _fault: object, row: Row, _given: object) -> None:
            row.injected += 1
            if ends:
                self._gateway.process.kill()
                self._gateway.process.wait()
                self.check_alive()
            self.expect(False, "not within 2 s")

    fault, report = in_order()[0], Report()
    with subprocess.Popen(["sleep", "600"]) as process:
        assert not run_one(OfOneProcess(process), fault, [None], report)
        process.kill()
    row = report.of(fault)
    row.taken = 0.5
    assert (row.state, ["the gateway ended with -9" in note for note in row.notes]) == (
        state,
        [ends],
    )
