"""Runs one tier of the project's checks: what `make test`, `make test-all` and `make release` call.

    python tests/run.py test|test-all|release [--only STEP]... [-- PYTEST-ARGUMENTS...]

test      lint (ruff), types (mypy), unit (pytest on this machine), vcan (pytest on a real vcan: this kernel's, or a VM's)
test-all  what `test` leaves out: faults (the fault programme in User Mode Linux) and, by the marker "extended", tools (the service
          under a real systemd, a browser, a broker ...) and masters (CANopen masters of others, and more, on a vcan).
          tools repeats the tests marked "rights": CI runs `test` as an ordinary user and `test-all` as root
release   by hand, on a quiet machine: qemu (the fault programme on emulated hardware), soak (random faults), hour (recorded),
          put-in (a list of faults that the tests must see), machines (the exported core on other machines),
          fuzz (the core in C under fuzzers, ten minutes each), wheels, deb (the Debian packages in fresh roots of both releases)

The lanes of a tier run side by side. A step runs once, and what it prints appears when it ends. Exit code 0: all that ran has
passed. What could not be run is listed with the line that enables it; with CI=true that and each skipped test is a failure. The
last line has the totals, `N passed, M failed, K skipped`.
"""

import argparse
import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn
from xml.etree import ElementTree as ET

from child_signals import use_defaults_in_children

PROJECT = Path(__file__).resolve().parent.parent
PATH = os.pathsep.join(
    [str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin"]
)
MESSAGE = 2000
"""Characters of a failed test's message that the summary repeats, for who sees no more than the end of the output."""

PYTEST = "python -m pytest -q --junitxml={report}"
ON_VCAN = f"KCG_VCAN=1 HYPOTHESIS_STORAGE_DIRECTORY={{scratch}} python tests/vm/vm_run.py --timeout=1500 --rw={{scratch}} -- {PYTEST} "
ON_VCAN += "-p no:cacheprovider tests/vcan"
FAULTS = "python tests/faults/programme.py {0} --junit={{report}}"
STEPS = {
    "lint": "ruff check . && ruff format --check .",
    "types": "mypy",
    "unit": f"{PYTEST} -n logical --maxprocesses=8 -m 'not extended' --ignore=tests/vcan {{args}}",
    "vcan": f"{ON_VCAN} -m 'not extended' {{args}}",
    "faults": FAULTS.format("uml"),
    "tools": f"{PYTEST} -m 'extended or rights' --ignore=tests/vcan {{args}}",
    "masters": f"{ON_VCAN} -m extended {{args}}",
    "qemu": FAULTS.format("qemu"),
    "soak": FAULTS.format("soak") + " --minutes=240",
    "hour": "python tests/hour/hour_programme.py",
    "put-in": "python tests/mutants/put_in_faults.py",
    "wheels": "python tests/native/wheels.py {scratch}",
    "machines": f"{PYTEST} -s tests/native/on_machines.py",
    "fuzz": f"KCG_FUZZ_SECONDS=600 {PYTEST} -s -o faulthandler_timeout=900 tests/native/test_fuzz.py",
    "deb": f"{PYTEST} -o faulthandler_timeout=900 tests/deb/in_fresh_roots.py",
}
TIERS = {
    "test": (("lint", "types", "unit"), ("vcan",)),
    "test-all": (("masters", "faults"), ("tools",)),
    "release": (("qemu", "soak", "hour", "put-in", "machines", "fuzz", "wheels", "deb"),),
}
LIMIT_S = {"test": 1800, "test-all": 2400, "release": 6 * 3600}
"""Of one step: the two that CI runs end within its 90 minutes whatever happens."""
ENABLE_UML = "sudo apt-get install user-mode-linux can-utils iproute2 busybox-static gcc libc6-dev"
ENABLE_CROSS = (
    "sudo apt-get install gcc-arm-none-eabi libnewlib-arm-none-eabi gcc-arm-linux-gnueabihf libc6-dev-armhf-cross "
    "gcc-aarch64-linux-gnu libc6-dev-arm64-cross gcc-s390x-linux-gnu libc6-dev-s390x-cross qemu-system-arm qemu-user"
)
ENABLE_VCAN = (
    f"{ENABLE_UML}  (or, on Ubuntu, linux-modules-extra-{platform.release()} can-utils iproute2)"
)
WHEELS = "aarch64-linux-gnu-gcc arm-linux-gnueabihf-gcc qemu-arm"
ENABLE_WHEELS = "gcc-aarch64-linux-gnu gcc-arm-linux-gnueabihf qemu-user"
NEEDS = {
    **dict.fromkeys(("vcan", "masters"), ("ip candump vcan", ENABLE_VCAN)),
    **dict.fromkeys(("faults", "soak"), ("linux.uml cc", ENABLE_UML)),
    "qemu": ("qemu-system-x86_64", "sudo tests/vm/setup.sh qemu"),
    "wheels": (WHEELS, f"sudo apt-get install {ENABLE_WHEELS}"),
    "machines": (
        f"{WHEELS} arm-none-eabi-gcc s390x-linux-gnu-gcc qemu-system-arm",
        ENABLE_CROSS,
    ),
    "fuzz": ("clang", "sudo apt-get install clang"),
    "deb": (
        f"{WHEELS} debootstrap lintian linux.uml",
        f"{ENABLE_UML} debootstrap lintian {ENABLE_WHEELS}",
    ),
}
"""What a step needs besides Python, "vcan" being a kernel with one, and the line that enables it."""

printing = threading.Lock()
running: set[subprocess.Popen[bytes]] = set()


@dataclass
class Result:
    """What came of a step. One without a JUnit report counts as one check."""

    step: str
    seconds: float = 0.0
    passed: int = 0
    failed: int = 0
    skipped: list[tuple[str, str]] = field(default_factory=list)
    """Name and reason of each."""
    failures: list[str] = field(default_factory=list)
    """Name and message of each failed test of a JUnit report."""
    note: str = ""
    enable: str = ""

    @property
    def state(self) -> str:
        return "not run" if self.enable else "FAILED" if self.failed else "passed"


def read_report(report: Path, result: Result) -> None:
    """Add the counts of a JUnit report."""
    for case in ET.parse(report).getroot().iter("testcase"):
        name = f"{case.get('classname', '')}.{case.get('name', '')}"
        skipped = case.find("skipped")
        failures = [*case.findall("failure"), *case.findall("error")]
        if failures:
            result.failed += 1
            result.failures += [f"{name}: {each.get('message', '')}" for each in failures]
        elif skipped is None or skipped.get("type") == "pytest.xfail":
            result.passed += 1
        else:
            result.skipped.append((name, skipped.get("message", "")))


def missing(step: str) -> str:
    """What a step needs and is not there."""
    for program in NEEDS.get(step, ("", ""))[0].split():
        if program == "vcan":
            which = ["python", "tests/vm/vm_run.py", "--which"]
            if subprocess.run(which, cwd=PROJECT, capture_output=True, check=False).returncode:
                return "a kernel with vcan, or a virtual machine that has it"
        elif shutil.which(program) is None:
            return program
    return ""


def run(step: str, limit_s: float, scratch: Path, arguments: Sequence[str], live: bool) -> Result:
    """Run a step; its output comes at once if ``live``, else as a whole at its end."""
    result = Result(step)
    if lacking := missing(step):
        result.note = f"there is no {lacking}"
        result.enable = NEEDS[step][1]
        return result
    report = scratch / f"{step}.xml"
    words = {"report": report, "scratch": scratch}
    quoted = {key: shlex.quote(str(value)) for key, value in words.items()}
    command = STEPS[step].format(args=shlex.join(arguments), **quoted)
    with printing:
        print(f"== {step}: {command}", flush=True)
    begin = time.monotonic()
    with (scratch / f"{step}.log").open("w+b") as log:
        out = None if live else log
        process = subprocess.Popen(
            command,
            shell=True,
            cwd=PROJECT,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=out,
            start_new_session=True,
        )
        running.add(process)
        try:
            code = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            code = 124
            result.note = f"no end within {limit_s:g} s"
            end(process)
        running.discard(process)
        result.seconds = time.monotonic() - begin
        log.seek(0)
        printed = f"\n== {step}, what it printed\n{log.read().decode(errors='replace')}"
        with printing:
            print("" if live else printed, flush=True)
    if "{report}" not in STEPS[step]:
        result.passed = int(not code)
        result.failed = int(bool(code))
    elif report.exists():
        read_report(report, result)
    nothing_chosen = code == 5 and arguments
    if not nothing_chosen and not result.failed and (code or not (result.passed or result.skipped)):
        result.failed = 1
        result.note = result.note or f"ended with {code}"
    return result


def end(process: subprocess.Popen[bytes]) -> None:
    """End a step and all that it has started; a virtual machine is given the time to do so itself."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGTERM)
        try:
            process.wait(15)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)


def leave(folder: str, number: int) -> NoReturn:
    for process in list(running):
        end(process)
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(128 + number)  # or the lanes would go on with their next steps


def summarize(results: Sequence[Result], strict: bool) -> int:
    """Print the summary; the exit code of it all."""
    print("\n== summary")
    for result in results:
        counts = f"{result.passed} passed, {result.failed} failed, {len(result.skipped)} skipped"
        print(
            f"{result.step:8}{result.state:8} {result.seconds:7.1f} s  {counts}  {result.note}".rstrip()
        )
    skipped = [each for result in results for each in result.skipped]
    unrun = [result for result in results if result.enable]
    for result in unrun:
        print(f"not run: {result.step}: {result.note}\n    to enable it:  {result.enable}")
    for reason, count in Counter(reason for _, reason in skipped).most_common():
        names = [name for name, why in skipped if why == reason]
        print(f"skipped: {names[0] if count == 1 else f'{count} tests'}: {reason}")
    for failure in (each for result in results for each in result.failures):
        print(f"failed: {failure[:MESSAGE]}")
    if strict and (unrun or skipped):
        print("CI=true: what was not run is a failure")
    failed = sum(result.failed for result in results)
    print(
        f"{sum(result.passed for result in results)} passed, {failed} failed, {len(skipped)} skipped",
        flush=True,
    )
    return int(bool(failed or (strict and (unrun or skipped))))


def main() -> int:
    own = sys.argv[1:]
    arguments = list[str]()
    if "--" in own:
        at = own.index("--")
        own, arguments = own[:at], own[at + 1 :]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tier", choices=TIERS)
    parser.add_argument("--only", action="append", choices=STEPS, metavar="STEP")
    args = parser.parse_args(own)
    lanes = [
        [step for step in lane if args.only is None or step in args.only]
        for lane in TIERS[args.tier]
    ]
    lanes = [lane for lane in lanes if lane]
    if not lanes:
        parser.error(
            f"{args.tier} has the steps {', '.join(step for lane in TIERS[args.tier] for step in lane)}"
        )
    os.environ["PATH"] = PATH
    with tempfile.TemporaryDirectory(prefix="kcg-test.", ignore_cleanup_errors=True) as folder:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, lambda number, _frame: leave(folder, number))
        use_defaults_in_children()
        scratch = Path(folder)

        def run_lane(lane: Sequence[str]) -> list[Result]:
            return [
                run(step, LIMIT_S[args.tier], scratch, arguments, len(lanes) == 1) for step in lane
            ]

        with ThreadPoolExecutor(len(lanes)) as pool:
            results = [result for found in pool.map(run_lane, lanes) for result in found]
    return summarize(results, os.environ.get("CI", "").lower() not in ("", "0", "false", "no"))


if __name__ == "__main__":
    sys.exit(main())
