"""The results of the fault programme, their table in docs, and the time of its machine."""

import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from xml.etree import ElementTree as ET

import pytest
from fault_report import FAILED, FAULTS, GOOD, PAGE, Report, Row, in_order, put, shown
from harness import Bench
from memory_slope import HOUR_S, Sample, faults_in, slope_kib_per_hour
from programme import PROJECT, conclude, main
from qemu_adapter import SerialAdapter

pytestmark = pytest.mark.promise("unstoppable")


def row(
    name: str = "x",
    injected: int = 3,
    recovered: int = 3,
    **counts: Any,
) -> Row:
    return Row(name, 2.0, injected=injected, recovered=recovered, **counts)


@pytest.mark.parametrize(
    ("counts", "state"),
    [
        ({}, GOOD),
        ({"recovered": 2}, FAILED),
        ({"lost": 1}, FAILED),
        ({"wrong": 1}, FAILED),
        ({"transmitted": 1}, FAILED),
        ({"injected": 0, "recovered": 0}, FAILED),
    ],
)
def test_fault_is_good_if_it_always_healed_without_wrong_or_lost_values(
    counts: dict[str, Any],
    state: str,
) -> None:
    assert row(**counts).state == state


def test_both_reports_contain_the_states(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    report = Report(good=row("good"))
    assert conclude(report) == 0
    report["wrong"] = row("wrong", wrong=1)
    assert conclude(report) == 1
    assert capsys.readouterr().out.endswith("2 faults: 1 failed, 1 good\n")
    out = tmp_path / "out"
    again = Report()
    report.write(out)
    again.read(out)
    assert [each.state for each in again.values()] == [GOOD, FAILED]
    report.write_junit(out)
    cases = [[found.tag for found in case] for case in ET.parse(out).iter("testcase")]
    assert cases == [[], ["failure"]]
    assert conclude(Report()) == 1, "nothing was run"


@pytest.mark.extended
@pytest.mark.usefixtures("c_compiler")
def test_machine_with_virtual_time_sleeps_an_hour_at_once() -> None:
    busy = "import time; end = time.monotonic() + 0.1\nwhile time.monotonic() < end: pass"
    command = [
        sys.executable,
        str(PROJECT / "tests/vm/vm_run.py"),
        "--backend=uml",
        "--timeout=100",
    ]
    script = f"date +%s; sleep 3600; date +%s; {sys.executable} -c '{busy}'"
    which = subprocess.run([*command[:2], "--which"], capture_output=True, text=True, check=False)
    if "uml" not in which.stdout:
        pytest.skip(
            "no User Mode Linux: sudo apt-get install user-mode-linux busybox-static gcc libc6-dev"
        )
    done = subprocess.run([*command, "--", "sh", "-c", script], check=True, stdout=subprocess.PIPE)
    begin, end = map(int, done.stdout.split())
    assert end - begin in (3600, 3601)


def test_bytes_to_an_esc_count_only_after_the_gateway_has_set_the_port() -> None:
    adapter = SerialAdapter("x")

    def set_line(divisor: int, parity_and_bits: int) -> None:
        adapter.vendor(3, divisor, 0, 0)
        adapter.vendor(4, parity_and_bits, 0, 0)

    set_line(312, 0x0008)  # 9600 8N1, when the port is opened
    adapter.take(b"echo")
    set_line(26, 0x0208)  # 115200 8E1
    adapter.take(b"A")
    set_line(312, 0x0008)  # by another program
    adapter.take(b"B")
    assert adapter.received == 2


def test_gateway_that_ended_is_reported_as_ended() -> None:
    bench = Bench.__new__(Bench)
    row = Row("x", None)
    with subprocess.Popen(["false"]) as process:
        pass
    bench._gateway = cast(Any, SimpleNamespace(process=process, lines=["the last word"]))
    assert not bench.inject(FAULTS[0], row, None)
    assert row.state == FAILED
    assert row.notes == ["the gateway ended with 1; the gateway's last lines: the last word"]


def test_page_shows_each_fault_healed_without_wrong_or_lost_values() -> None:
    found = shown(PAGE.read_text())
    assert list(found) == [str(fault) for fault in in_order()]
    assert len(set(map(str, FAULTS))) == len(FAULTS)
    for fault, line in found.items():
        assert re.search(r" \| ([1-9]\d*) \| \1 \| [^|]+ \| 0 \| 0 \| good \|$", line), fault


def test_new_rows_replace_older_ones_whatever_their_state() -> None:
    before = PAGE.read_text()
    fault = str(in_order()[3])
    run = Row(
        fault,
        2.0,
        injected=3,
        recovered=3,
        worst_s=0.1,
        wrong=1,
    )
    after = put(before, Report({fault: run}))
    line = f"| {fault} | 3 | 3 | 0.10 s (limit 2 s) | 1 | 0 | failed |"
    assert shown(after) == shown(before) | {fault: line}
    assert put(before, Report()) == before


@pytest.mark.parametrize(
    ("kib_per_hour", "hours", "is_good"),
    [(0, 4, True), (100, 4, True), (160, 4, False), (12_000, 4, False), (12_000, 0.9, True)],
)
def test_memory_is_judged_by_its_slope(kib_per_hour: float, hours: float, is_good: bool) -> None:
    """Memory varies by pages, and the growth at the beginning of a run is ignored."""
    samples = []
    for second in range(0, round(hours * HOUR_S), 20):
        first = 4000 if second > 600 else second * 6
        noise = second * 7919 % 300
        rss = 27_000 + first + noise + kib_per_hour * second / HOUR_S
        samples.append(Sample(second, round(rss)))
    assert (faults_in(samples) == []) == is_good
    late = [each for each in samples if each.seconds > 600]
    assert slope_kib_per_hour(late) == pytest.approx(kib_per_hour, rel=0.02, abs=15)


def test_slope_of_few_samples_is_zero() -> None:
    assert slope_kib_per_hour([]) == slope_kib_per_hour([Sample(1, 2)]) == 0
    assert faults_in([]) == []


@pytest.mark.parametrize("hours", ["0", "-1", "1e9", "nan"])
def test_hours_out_of_range_are_refused_in_one_line(
    hours: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["programme.py", "hours", f"--hours={hours}"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert "error: --hours is 0.1 to 1000" in capsys.readouterr().err
