"""Runs one tier of the project's checks, for the targets of the Makefile with the same names.

    python tests/run.py test|test-all|prove|release [--only STEP]... [--without STEP]...
        [-- PYTEST-ARGUMENTS...]

test, before every commit:
  lint      ruff
  types     mypy
  unit      pytest on this machine
  vcan      pytest on a real vcan of this kernel or of a virtual machine

test-all, the slow checks and the checks with other programs:
  faults    the fault programme in User Mode Linux
  tools     tests marked "extended": the service under a real systemd, a browser, a broker ...
            It repeats the tests marked "rights": CI runs `test` as an ordinary user and
            `test-all` as root.
  masters   tests marked "extended" on a vcan, with CANopen masters of other projects
  slow      tests marked "extended" that need only the processor: all states of the gate, a
            million frames in both cores, fuzzers, DBCs of real cars, a hostile bus ...
  prove     the proofs of docs/proof.md that end within five minutes
  cuts      200 states after a power loss, in User Mode Linux

prove, the same step alone

release, by hand on a quiet machine:
  qemu      the fault programme on emulated hardware
  soak      random faults
  hours     30 hours of virtual time without a fault
  hour      a recorded hour
  put-in    a list of faults that the tests must detect
  machines  the exported core on other machines
  fuzz      the C core under fuzzers, ten minutes each
  proofs    the proofs that need longer: all values of 32 bits, the DBCs of real cars
  eva       no undefined behaviour in the core, with Frama-C
  worst     the longest path through the machine code for an ARM processor
  years     ten years of virtual time through the core in C (-- --years 0.1)
  plug      10 000 states after a power loss
  wheels    wheels for other machines
  deb       the Debian packages in fresh roots of both releases

The lanes of a tier run side by side. A step runs once, and its output appears when it ends.
The exit code is 0 if every step has passed. A step that cannot run is a failure, and is listed with
the command that enables it. --without STEP leaves it out. A step whose tests were all skipped is a
failure, unless PYTEST-ARGUMENTS chose them. With CI=true each skipped test is a failure. The last
line has the totals: `N passed, M failed, K skipped`.
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
"""Characters of a failed test's message in the summary, for readers of only the output's end."""

LIMIT_AS_STEP = "--timeout=0 -o faulthandler_timeout=0"
"""For long tests: only the limit of the whole step ends a test."""
LIMIT_OF_VCAN = "--timeout=20000 -o faulthandler_timeout=0"
"""In virtual time, which passes at once while a test waits."""
PYTEST = "python -m pytest -q --junitxml={report}"
SIDE_BY_SIDE = "-n logical --maxprocesses=8 --dist worksteal"
"""Each process has neighbouring tests, so that a set-up of a file is rarely made twice."""
ON_VCAN = (
    "KCG_VCAN=1 HYPOTHESIS_STORAGE_DIRECTORY={scratch} "
    "python tests/vm/vm_run.py --timeout=1500 --rw={scratch} -- "
    f"{PYTEST} -p no:cacheprovider tests/vcan {LIMIT_OF_VCAN}"
)
ELSEWHERE = "--ignore=tests/vcan --ignore=tests/proofs"
"""Folders with steps of their own."""
SLOW = (
    "tests/gateway tests/runtime/test_gate_rows.py tests/native tests/dbc tests/dronecan tests/hour"
)
"""Places whose extended tests hardly wait. The longest tests are first."""
NOT_SLOW = " ".join(f"--ignore={place}" for place in SLOW.split())
FUZZ_OPTIONS = f"-s {LIMIT_AS_STEP}"
PROOF = (
    "python -m pytest -q -s --junitxml={{report}} "
    f"{LIMIT_AS_STEP} tests/proofs/{{0}} {{{{args}}}}"
)
LIMIT_OF_TOOLS = "--timeout=1500 -o faulthandler_timeout=1800"
"""A virtual machine of one test may run for 1200 s."""
FAULTS = "python tests/faults/programme.py {0} --junit={{report}}"
PLUG = (
    "KCG_PLUG_STATES={0} python -m pytest -q -s --junitxml={{report}} "
    f"{LIMIT_AS_STEP} tests/plug/power_cuts.py {{{{args}}}}"
)
STEPS = {
    "lint": "ruff check . && ruff format --check .",
    "types": "mypy",
    "unit": f"{PYTEST} {SIDE_BY_SIDE} -m 'not extended' {ELSEWHERE} {{args}}",
    "vcan": f"{ON_VCAN} -m 'not extended' {{args}}",
    "faults": FAULTS.format("uml"),
    "tools": f"{PYTEST} {LIMIT_OF_TOOLS} -m 'extended or rights' {ELSEWHERE} {NOT_SLOW} {{args}}",
    "slow": f"{PYTEST} -n 2 --dist worksteal {LIMIT_OF_TOOLS} "
    f"-m 'extended or rights' {SLOW} {{args}}",
    "masters": f"{ON_VCAN} -m extended {{args}}",
    "prove": f"{PYTEST} -n 2 --dist worksteal tests/proofs {{args}}",
    "cuts": PLUG.format(200),
    "plug": PLUG.format(10_000),
    "qemu": FAULTS.format("qemu"),
    "outages": FAULTS.format("uml") + " --only=Outage: --outages=20 --hangs=50",
    "soak": FAULTS.format("soak") + " --minutes=240",
    "hours": FAULTS.format("hours") + " --hours=30",
    "hour": "python tests/hour/hour_programme.py",
    "put-in": "python tests/mutants/put_in_faults.py",
    "wheels": "python tests/native/wheels.py {scratch}",
    "machines": f"{PYTEST} -s tests/native/on_machines.py",
    "fuzz": f"KCG_FUZZ_SECONDS=600 {PYTEST} {FUZZ_OPTIONS} tests/native/test_fuzz.py",
    "proofs": PROOF.format("long_proofs.py tests/proofs/real_dbcs.py"),
    "eva": PROOF.format("long_eva.py"),
    "worst": PROOF.format("long_worst_case.py"),
    "years": "python tests/proofs/years_run.py {args}",
    "deb": f"{PYTEST} {LIMIT_AS_STEP} tests/deb/in_fresh_roots.py",
}
TIERS = {
    "test": (("lint", "types", "unit"), ("vcan",)),
    "test-all": (("masters", "faults", "cuts"), ("tools",), ("slow", "prove")),
    "prove": (("prove",),),
    "release": (
        (
            *("qemu", "outages", "soak", "hours", "hour", "put-in", "machines"),
            *("fuzz", "proofs", "eva", "worst", "years", "plug", "wheels", "deb"),
        ),
    ),
}
LIMIT_S = {"test": 1800, "test-all": 2400, "prove": 1200, "release": 6 * 3600}
"""Longest duration of one step. The two tiers that CI runs end within its 90 minutes."""
LONGER_S = {"years": 24 * 3600}
"""Limits of steps that may take longer than the others of their tier."""
ENABLE_UML = "sudo apt-get install user-mode-linux can-utils iproute2 busybox-static gcc libc6-dev"
ENABLE_CROSS = (
    "sudo apt-get install gcc-arm-none-eabi libnewlib-arm-none-eabi "
    "gcc-arm-linux-gnueabihf libc6-dev-armhf-cross gcc-aarch64-linux-gnu libc6-dev-arm64-cross "
    "gcc-s390x-linux-gnu libc6-dev-s390x-cross qemu-system-arm qemu-user"
)
UBUNTU_MODULES = f"linux-modules-extra-{platform.release()}"
ENABLE_VCAN = f"{ENABLE_UML}  (or, on Ubuntu, {UBUNTU_MODULES} can-utils iproute2)"
MAKE_FILE_SYSTEMS = "linux.uml cc mkfs.ext4 mkfs.f2fs mkfs.vfat"
ENABLE_FILE_SYSTEMS = f"{ENABLE_UML} e2fsprogs f2fs-tools dosfstools"
PROVERS = "frama-c arm-none-eabi-gcc"
WHEELS = "aarch64-linux-gnu-gcc arm-linux-gnueabihf-gcc qemu-arm"
ENABLE_WHEELS = "gcc-aarch64-linux-gnu gcc-arm-linux-gnueabihf qemu-user"
ENABLE_COMPILER = "sudo apt-get install gcc libc6-dev"
NEEDS = {
    "vcan": ("ip candump vcan", ENABLE_VCAN),
    "masters": ("ip candump vcan", ENABLE_VCAN),
    "faults": ("linux.uml cc", ENABLE_UML),
    "outages": ("linux.uml cc", ENABLE_UML),
    "soak": ("linux.uml cc", ENABLE_UML),
    "hours": ("linux.uml cc", ENABLE_UML),
    "cuts": (MAKE_FILE_SYSTEMS, ENABLE_FILE_SYSTEMS),
    "plug": (MAKE_FILE_SYSTEMS, ENABLE_FILE_SYSTEMS),
    "prove": ("cc", ENABLE_COMPILER),
    "proofs": ("cc", ENABLE_COMPILER),
    "years": ("cc", ENABLE_COMPILER),
    "eva": ("frama-c", "sudo apt-get install frama-c-base"),
    "worst": ("arm-none-eabi-gcc", "sudo apt-get install gcc-arm-none-eabi"),
    "put-in": (
        f"{PROVERS} {MAKE_FILE_SYSTEMS}",
        f"{ENABLE_FILE_SYSTEMS} frama-c-base gcc-arm-none-eabi",
    ),
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
"""Programs that a step needs besides Python, and the command that installs them.

"vcan" means a kernel that has vcan interfaces.
"""

printing = threading.Lock()
running: set[subprocess.Popen[bytes]] = set()


@dataclass
class Result:
    """The result of a step. A step without a JUnit report counts as one check."""

    step: str
    seconds: float = 0.0
    passed: int = 0
    failed: int = 0
    skipped: list[tuple[str, str]] = field(default_factory=list)
    """Name and reason of each skipped test."""
    failures: list[str] = field(default_factory=list)
    """Name and message of each failed test of a JUnit report."""
    note: str = ""
    enable: str = ""

    @property
    def state(self) -> str:
        if self.enable:
            return "not run"
        return "FAILED" if self.failed else "passed"


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


def limit_s(tier: str, step: str) -> float:
    """Return the longest duration of a step."""
    return max(LIMIT_S[tier], LONGER_S.get(step, 0))


def missing(step: str) -> str:
    """Return the first requirement of a step that this machine lacks, or ""."""
    for program in NEEDS.get(step, ("", ""))[0].split():
        if program == "vcan":
            which = ["python", "tests/vm/vm_run.py", "--which"]
            if subprocess.run(which, cwd=PROJECT, capture_output=True, check=False).returncode:
                return "a kernel with vcan, or a virtual machine that has it"
        elif shutil.which(program) is None:
            return program
    return ""


def run(
    step: str,
    limit_s: float,
    scratch: Path,
    arguments: Sequence[str],
    live: bool,
) -> Result:
    """Run a step. Its output appears immediately if ``live``, otherwise when the step ends."""
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
    if result.failed or (code == 5 and arguments):  # 5: the arguments chose no test
        return result
    if not code and result.skipped and not result.passed and not arguments:
        result.failed = 1
        result.note = "every test was skipped"
    elif code or not (result.passed or result.skipped):
        result.failed = 1
        result.note = result.note or f"ended with {code}"
    return result


def end(process: subprocess.Popen[bytes]) -> None:
    """End a step and all processes that it has started.

    A virtual machine has 15 s to shut down by itself.
    """
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
    os._exit(128 + number)  # otherwise the lanes would continue with their next steps


def summarize(results: Sequence[Result], strict: bool) -> int:
    """Print the summary. Return the exit code of the whole run."""
    print("\n== summary")
    for result in results:
        counts = f"{result.passed} passed, {result.failed} failed, {len(result.skipped)} skipped"
        head = f"{result.step:8}{result.state:8} {result.seconds:7.1f} s"
        print(f"{head}  {counts}  {result.note}".rstrip())
    skipped = [each for result in results for each in result.skipped]
    unrun = [result for result in results if result.enable]
    for result in unrun:
        print(f"not run: {result.step}: {result.note}\n    to enable it:  {result.enable}")
        print(f"    to leave it out:  --without {result.step}")
    for reason, count in Counter(reason for _, reason in skipped).most_common():
        names = [name for name, why in skipped if why == reason]
        print(f"skipped: {names[0] if count == 1 else f'{count} tests'}: {reason}")
    for failure in (each for result in results for each in result.failures):
        print(f"failed: {failure[:MESSAGE]}")
    if strict and skipped:
        print("CI=true: each skipped test is a failure")
    passed = sum(result.passed for result in results)
    failed = sum(result.failed for result in results)
    print(f"{passed} passed, {failed} failed, {len(skipped)} skipped", flush=True)
    return int(bool(failed or unrun or (strict and skipped)))


def main() -> int:
    own = sys.argv[1:]
    arguments = list[str]()
    if "--" in own:
        at = own.index("--")
        arguments = own[at + 1 :]
        own = own[:at]
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("tier", choices=TIERS)
    parser.add_argument("--only", action="append", choices=STEPS, metavar="STEP")
    parser.add_argument("--without", action="append", choices=STEPS, metavar="STEP", default=[])
    args = parser.parse_args(own)
    chosen = set(args.only or STEPS).difference(args.without)
    lanes = [[step for step in lane if step in chosen] for lane in TIERS[args.tier]]
    lanes = [lane for lane in lanes if lane]
    if not lanes:
        steps = [step for lane in TIERS[args.tier] for step in lane]
        parser.error(f"{args.tier} has the steps {', '.join(steps)}")
    os.environ["PATH"] = PATH
    with tempfile.TemporaryDirectory(prefix="kcg-test.", ignore_cleanup_errors=True) as folder:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, lambda number, _frame: leave(folder, number))
        use_defaults_in_children()
        scratch = Path(folder)

        def run_lane(lane: Sequence[str]) -> list[Result]:
            return [
                run(step, limit_s(args.tier, step), scratch, arguments, len(lanes) == 1)
                for step in lane
            ]

        with ThreadPoolExecutor(len(lanes)) as pool:
            results = [result for found in pool.map(run_lane, lanes) for result in found]
    return summarize(results, os.environ.get("CI", "").lower() not in ("", "0", "false", "no"))


if __name__ == "__main__":
    sys.exit(main())
