"""All checks of the project, one after the other: what `make test` calls.

    python tests/run.py [--only lint|types|unit|vcan|faults|soak]... [-- PYTEST-ARGUMENTS...]

lint   ruff: mistakes and format
types  mypy --strict
unit   pytest on this machine, all but tests/vcan
vcan   pytest tests/vcan on real vcan interfaces: here if this kernel has them, else in a VM (tests/vm/run), beside ``unit``
       if both are run and there is more than one processor
faults the fault programme on real drivers (tests/faults): in User Mode Linux, and on the emulated hardware of QEMU
soak   random faults for --minutes from one --seed; only when it is asked for

--long lets the faults come more often and longer (an hour); --keep FOLDER keeps the results as JSON, --table puts them into the README.

Exits with 0 when all that ran passed. Says what was not run, why, and the line that enables it; with CI=true in the
environment whatever was not run, each skipped test included, is a failure. A few tests that fail are run once more by
themselves, and named. The last line printed has the totals of all tests: `N passed, M failed, K skipped`.
"""

import argparse
import json
import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import IO, Any, NoReturn
from xml.etree import ElementTree as ET

PROJECT = Path(__file__).resolve().parent.parent
STEPS = ("lint", "types", "unit", "vcan", "faults")
ON_DEMAND = ("soak",)
FAULTS = PROJECT / "tests" / "faults"
FAULTS_TIMEOUT_S = {False: 1200, True: 4 * 3600}
VM_RUN = PROJECT / "tests" / "vm" / "vm_run.py"
VCAN_TIMEOUT_S = 2400
STEP_TIMEOUT_S = 2500
RUNNING: set[subprocess.Popen[bytes]] = set()
LEAVING: list[int] = []
IN_ITS_VM = "tests/service/test_under_systemd.py"
MOST_REPEATED = 4
"""So many failed tests are looked at once more; with more than that something is wrong."""
SEARCH_PATH = os.environ.get("PATH", os.defpath) + ":/usr/sbin:/sbin"

ENABLE_VM = "sudo apt-get install user-mode-linux can-utils iproute2 busybox-static"
ENABLE_VCAN_UBUNTU = f"sudo apt-get install linux-modules-extra-{platform.release()} can-utils iproute2"
ENABLE_QEMU = "sudo tests/vm/setup.sh qemu"
ENABLE_TOOLS = "sudo apt-get install can-utils iproute2"
ENABLE_VENV = "python3 -m pip install -e '.[test]'"


@dataclass
class Suite:
    """What one pytest run counted."""

    passed: int = 0
    failed: int = 0
    failures: list[str] = field(default_factory=list)  # as pytest takes them
    xfailed: int = 0
    skipped: list[str] = field(default_factory=list)  # "test: reason"


@dataclass
class Result:
    step: str
    state: str  # "passed", "FAILED" or "not run"
    seconds: float = 0.0
    detail: str = ""
    reason: str = ""
    enable: str = ""
    suite: Suite | None = None


def read_junit(report: Path) -> Suite | None:
    """The counts of a JUnit report, None if there is no readable one."""
    try:
        root = ET.parse(report).getroot()
    except (OSError, ET.ParseError):
        return None
    suite = Suite()
    for case in root.iter("testcase"):
        name = f"{case.get('classname', '')}.{case.get('name', '')}".lstrip(".")
        skipped = case.find("skipped")
        if case.find("failure") is not None or case.find("error") is not None:
            suite.failed += 1
            suite.failures.append(f"{case.get('classname', '').replace('.', '/')}.py::{case.get('name', '')}")
        elif skipped is None:
            suite.passed += 1
        elif skipped.get("type") == "pytest.xfail":
            suite.xfailed += 1
        else:
            suite.skipped.append(f"{name}: {skipped.get('message', '')}")
    return suite


def say(line: str) -> None:
    print(line, flush=True)


def call(
    command: Sequence[str],
    environment: Mapping[str, str] | None = None,
    timeout_s: float = STEP_TIMEOUT_S,
    output: IO[str] | None = None,
) -> int:
    """Runs a command with our stdout and stderr, or ``output`` for both, and the environment's programs.

    Its exit code, 124 if it took too long.
    """
    if LEAVING:
        return 128 + signal.SIGTERM
    say("$ " + shlex.join(command))
    path = os.pathsep.join([str(Path(sys.executable).parent), SEARCH_PATH])
    with subprocess.Popen(
        command,
        cwd=PROJECT,
        env={**os.environ, "PATH": path, **(environment or {})},
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=None if output is None else subprocess.STDOUT,
    ) as process:
        RUNNING.add(process)
        try:
            return process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            say(f"{command[0]}: no end within {timeout_s:g} s")
            return 124
        finally:  # ours to end, also when we are interrupted
            RUNNING.discard(process)
            if process.poll() is None:
                process.terminate()
                try:
                    process.wait(10)
                except subprocess.TimeoutExpired:
                    process.kill()


def missing(module: str) -> bool:
    command = [sys.executable, "-c", f"import importlib.util, sys; sys.exit(not importlib.util.find_spec({module!r}))"]
    return subprocess.run(command, check=False).returncode != 0


def timed(step: str, commands: Sequence[Sequence[str]]) -> Result:
    start = time.monotonic()
    codes = [call(command) for command in commands]
    return Result(step, "FAILED" if any(codes) else "passed", time.monotonic() - start)


def lint() -> Result:
    if missing("ruff"):
        return Result("lint", "not run", reason="ruff is not installed", enable=ENABLE_VENV)
    ruff = [sys.executable, "-m", "ruff"]
    return timed("lint", [[*ruff, "check", "."], [*ruff, "format", "--check", "."]])


def types() -> Result:
    if missing("mypy"):
        return Result("types", "not run", reason="mypy is not installed", enable=ENABLE_VENV)
    return timed("types", [[sys.executable, "-m", "mypy"]])


def pytest(
    step: str,
    command: Sequence[str],
    what: Sequence[str],
    arguments: Sequence[str],
    report: Path,
    environment: Mapping[str, str],
    output: IO[str] | None = None,
) -> Result:
    """Runs pytest on ``what``. A few tests that fail are run once more, by themselves, which is told: on a busy machine all is late."""
    start = time.monotonic()
    code = call([*command, *what, *arguments, f"--junitxml={report}"], environment, output=output)
    suite = read_junit(report)
    repeated: list[str] = []
    if suite is not None and code == 1 and 0 < suite.failed <= MOST_REPEATED and not arguments:
        say(f"\n== {step}: once more: " + ", ".join(suite.failures))
        second = report.with_name(f"again_{report.name}")
        code = call([*command, *suite.failures, f"--junitxml={second}"], environment, output=output)
        better = read_junit(second)
        if better is None or better.passed + better.failed != suite.failed:
            code = code or 1  # one of them was not found again
        else:
            repeated = suite.failures
            suite.passed, suite.failed = suite.passed + better.passed, better.failed
    seconds = time.monotonic() - start
    if suite is None:  # it did not come to its end: that is not "0 failed"
        suite = Suite(failed=1)
        detail = f"ended with {code} and without a report"
    else:
        detail = f"{suite.passed} passed, {suite.failed} failed, {len(suite.skipped)} skipped"
        if suite.xfailed:
            detail += f", {suite.xfailed} failed as expected"
        if repeated:
            detail += f", {len(repeated)} at the second attempt: {', '.join(repeated)}"
        if code == 5:
            detail = "no tests found"
        elif code and not suite.failed:
            detail += f"; pytest ended with {code}"
    return Result(step, "FAILED" if code or suite.failed else "passed", seconds, detail, suite=suite)


def unit(arguments: Sequence[str], scratch: Path, but: Sequence[str] = ()) -> Result:
    if missing("pytest"):
        return Result("unit", "not run", reason="pytest is not installed", enable=ENABLE_VENV)
    command = [sys.executable, "-m", "pytest", "-q", "-rs"]
    what = ["tests", *(f"--ignore={path}" for path in ("tests/vcan", *but))]
    return pytest("unit", command, what, arguments, scratch / "unit.xml", {})


def side_by_side(scratch: Path) -> list[Result]:
    """``unit`` on one processor, and what runs in virtual machines on another: ``vcan``, and the service under systemd from ``unit``."""
    with (scratch / "beside.log").open("w+") as output, ThreadPoolExecutor(1) as beside:

        def in_machines() -> list[Result]:
            command = [sys.executable, "-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider"]
            service = pytest("systemd", command, [IN_ITS_VM], (), scratch / "systemd.xml", {}, output)
            return [service, vcan((), scratch, output)]

        machines = beside.submit(in_machines)
        results = [unit((), scratch, but=[IN_ITS_VM]), *machines.result()]
        output.seek(0)
        say("\n== systemd, vcan: what they said\n" + output.read())
        return results


def in_a_vm(scratch: Path) -> dict[str, str]:
    """The environment of what runs in a VM, where the project is read-only: only the scratch folder is written to."""
    # python-can imports asammdf where it is installed, and with it numpy and pandas: 4 s of each process in UML.
    without = scratch / "without"
    without.mkdir(exist_ok=True)
    (without / "asammdf.py").write_text('raise ImportError("kept out of the tests in a VM by tests/run.py")\n')
    path = os.pathsep.join(filter(None, (str(without), os.environ.get("PYTHONPATH"))))
    return {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}


def vcan(arguments: Sequence[str], scratch: Path, output: IO[str] | None = None) -> Result:
    if missing("pytest"):
        return Result("vcan", "not run", reason="pytest is not installed", enable=ENABLE_VENV)
    if not list(PROJECT.glob("tests/vcan/**/test_*.py")):
        return Result("vcan", "not run", reason="there are no tests in tests/vcan", enable="git checkout tests/vcan")
    which = subprocess.run(
        [sys.executable, str(VM_RUN), "--which"], stdout=subprocess.PIPE, text=True, check=False
    ).stdout.strip()
    if which not in ("native", "uml", "qemu"):
        reason = "this kernel has no vcan that we may use, and there is no VM that has"
        return Result("vcan", "not run", reason=reason, enable=enable_vcan())
    tools = [tool for tool in ("ip", "candump") if not shutil.which(tool, path=SEARCH_PATH)]
    if tools:
        return Result("vcan", "not run", reason=f"there is no {' and no '.join(tools)}", enable=ENABLE_TOOLS)
    environment = {
        **in_a_vm(scratch),
        "KCG_VCAN": "1",
        "HYPOTHESIS_STORAGE_DIRECTORY": str(scratch / "hypothesis"),
    }
    command = [sys.executable, str(VM_RUN), f"--timeout={VCAN_TIMEOUT_S}", "--verbose", f"--rw={scratch}", "--"]
    command += [sys.executable, "-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider"]
    result = pytest("vcan", command, ["tests/vcan"], arguments, scratch / "vcan.xml", environment, output)
    result.detail += f" ({which})"
    return result


def faults(scratch: Path, long: bool) -> list[Result]:
    """The fault programme: what User Mode Linux can show, then the emulated hardware."""
    limit = FAULTS_TIMEOUT_S[long]
    options = ["--long"] if long else []
    results: list[Result] = []
    parts: list[Part] = []
    if not shutil.which("linux.uml", path=SEARCH_PATH):
        results.append(Result("faults", "not run", reason="there is no User Mode Linux", enable=ENABLE_VM))
    else:

        def half(part: int) -> Part:
            out = scratch / f"faults_uml{part}.json"
            command = [
                *uml_run(scratch, limit),
                str(FAULTS / "programme.py"),
                f"--out={out}",
                f"--part={part}",
                *options,
            ]
            return Part(
                f"uml{part}", command, out, limit + 60, programme(f"uml{part}", command, out, scratch, limit + 60)
            )

        at_once = 2 if (os.cpu_count() or 1) > 1 else 1  # each takes one processor
        with ThreadPoolExecutor(at_once) as machines:
            parts += machines.map(half, (1, 2))
    qemu = scratch / "faults_qemu.json"
    kernels = (Path(os.environ.get("VM_CACHE") or VM_RUN.parent / ".cache")).glob("*/vmlinux")
    if not shutil.which("qemu-system-x86_64", path=SEARCH_PATH) or not any(kernels):
        results.append(
            Result("qemu", "not run", reason="there is no QEMU, or no kernel unpacked for it", enable=ENABLE_QEMU)
        )
    else:
        command = [sys.executable, str(FAULTS / "qemu_programme.py"), f"--out={qemu}", *options]
        parts.append(Part("qemu", command, qemu, limit + 60, programme("qemu", command, qemu, scratch, limit + 60)))
    return results + [again(part, scratch) for part in parts]


@dataclass
class Part:
    """A part of the fault programme that was run."""

    step: str
    command: list[str]
    out: Path
    timeout_s: float
    result: Result


def is_good(row: Mapping[str, Any]) -> bool:
    return bool(row["injected"] == row["recovered"] > 0 and not row["wrong"] and not row["lost"])


def again(part: Part, scratch: Path) -> Result:
    """Repeats faults that were not healed in time, by themselves, up to twice: a machine that has other work makes everything late.

    What was found at which attempt is kept in the results and told.
    """
    seconds = part.result.seconds
    repeated: set[str] = set()
    for attempt in (2, 3):
        try:
            found = json.loads(part.out.read_text())
        except (OSError, ValueError):
            return part.result
        bad = [row for row in found["rows"] if not is_good(row)]
        if not bad:
            break
        say(f"\n== {part.step}: attempt {attempt} of " + "; ".join(row["name"] for row in bad))
        out = scratch / f"again_{part.out.name}"
        out.unlink(missing_ok=True)
        command = [word for word in part.command if not word.startswith("--out=")]
        command += [f"--out={out}", *(f"--only={row['name']}" for row in bad)]
        result = programme(part.step, command, out, scratch, part.timeout_s)
        seconds += result.seconds
        if not out.exists():
            continue
        new = {row["name"]: row for row in json.loads(out.read_text())["rows"]}
        for row in bad:
            if (better := new.get(row["name"])) is not None:
                better["figures"]["attempts"] = attempt
                better["notes"] = row["notes"] + better["notes"]
                found["rows"][found["rows"].index(row)] = better
                repeated.add(row["name"])
        part.out.write_text(json.dumps(found, indent=1) + "\n")
    final = counted(part.step, part.out, 0, seconds)
    if repeated:
        final.detail += f", {len(repeated)} repeated"
    return final


def soak(scratch: Path, minutes: float, seed: int | None) -> Result:
    """Random faults from one seed for so many minutes."""
    if not shutil.which("linux.uml", path=SEARCH_PATH):
        return Result("soak", "not run", reason="there is no User Mode Linux", enable=ENABLE_VM)
    limit = 60 * minutes + 300
    out = scratch / "soak.json"
    command = [*uml_run(scratch, limit), str(FAULTS / "soak.py"), f"--out={out}", f"--minutes={minutes:g}"]
    if seed is not None:
        command.append(f"--seed={seed}")
    return programme("soak", command, out, scratch, limit + 60)


def uml_run(scratch: Path, timeout_s: float) -> list[str]:
    """The beginning of a command that runs Python in User Mode Linux: the faults set clocks and mount, which no usual machine may bear."""
    command = [sys.executable, str(VM_RUN), "--backend=uml", f"--timeout={timeout_s:g}", f"--rw={scratch}", "--"]
    return [*command, sys.executable]


def programme(step: str, command: Sequence[str], out: Path, scratch: Path, timeout_s: float) -> Result:
    """Runs a part of the fault programme; each fault counts as a test."""
    start = time.monotonic()
    code = call(command, in_a_vm(scratch), timeout_s)
    return counted(step, out, code, time.monotonic() - start)


def counted(step: str, out: Path, code: int, seconds: float) -> Result:
    """What the results of a part of the fault programme come to."""
    try:
        rows = json.loads(out.read_text())["rows"]
    except (OSError, ValueError, KeyError):
        return Result(step, "FAILED", seconds, f"ended with {code} and without results", suite=Suite(failed=1))
    good = sum(is_good(row) for row in rows)
    suite = Suite(passed=good, failed=len(rows) - good)
    injected, wrong, lost = (sum(row[key] for row in rows) for key in ("injected", "wrong", "lost"))
    detail = f"{good} of {len(rows)} faults healed, {injected} injected, {wrong} wrong values, {lost} lost"
    return Result(step, "FAILED" if code or suite.failed else "passed", seconds, detail, suite=suite)


def enable_vcan() -> str:
    """Ubuntu keeps vcan in a package of its own; elsewhere a kernel without it needs a VM."""
    try:
        ubuntu = platform.freedesktop_os_release().get("ID") == "ubuntu"
    except OSError:
        ubuntu = False
    return ENABLE_VCAN_UBUNTU if ubuntu else ENABLE_VM


def summarize(results: Sequence[Result], strict: bool) -> int:
    """Prints the summary; the exit code of it all."""
    failed = any(result.state == "FAILED" for result in results)
    not_run = [result for result in results if result.state == "not run"]
    skipped = [test for result in results if result.suite for test in result.suite.skipped]
    say("\n== summary")
    for result in results:
        say(f"{result.step:7} {result.state:8} {result.seconds:7.1f} s  {result.detail}".rstrip())
    for result in not_run:
        say(f"not run: {result.step}: {result.reason}\n    to enable it:  {result.enable}")
    for test in skipped:
        say(f"skipped: {test}")
    if strict and (not_run or skipped):
        say("CI=true: what was not run is a failure")
        failed = True
    suites = [result.suite for result in results if result.suite]
    passed_count, failed_count = sum(suite.passed for suite in suites), sum(suite.failed for suite in suites)
    say(f"{passed_count} passed, {failed_count} failed, {len(skipped)} skipped")
    return 1 if failed else 0


def leave(number: int, _frame: FrameType | None) -> NoReturn:
    LEAVING.append(number)
    for process in list(RUNNING):  # those of other threads would be waited for
        process.terminate()
    sys.exit(128 + number)


def main() -> int:
    parser = argparse.ArgumentParser(
        usage="run.py [--only STEP]... [-- PYTEST-ARGUMENTS]", description=__doc__.partition("\n")[0] if __doc__ else ""
    )
    parser.add_argument(
        "--only", action="append", choices=STEPS + ON_DEMAND, help="run this step only; may be repeated"
    )
    parser.add_argument("--long", action="store_true", help="faults: more often and longer")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="faults, soak: keep the results there")
    parser.add_argument("--table", action="store_true", help="faults: put what they showed into README.md")
    parser.add_argument("--minutes", type=float, default=10, help="soak: for so long")
    parser.add_argument("--seed", type=int, help="soak: the faults of this seed")
    own, separator, pytest_arguments = list(sys.argv[1:]), "--" in sys.argv[1:], list[str]()
    if separator:
        at = own.index("--")
        own, pytest_arguments = own[:at], own[at + 1 :]
    args = parser.parse_args(own)
    only = args.only or STEPS
    strict = os.environ.get("CI", "").lower() not in ("", "0", "false", "no")

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, leave)
    results: list[Result] = []
    with tempfile.TemporaryDirectory(prefix="kcg-test.", ignore_cleanup_errors=True) as folder:
        scratch = Path(folder)
        at_once = {"unit", "vcan"} <= set(only) and not pytest_arguments and (os.cpu_count() or 1) > 1
        at_once = at_once and not missing("pytest")
        for step in STEPS + ON_DEMAND:
            if step not in only or (at_once and step == "vcan"):
                continue
            say(f"\n== {step}" + (" and vcan, side by side" if at_once and step == "unit" else ""))
            if step == "lint":
                found = [lint()]
            elif step == "types":
                found = [types()]
            elif step == "unit":
                found = side_by_side(scratch) if at_once else [unit(pytest_arguments, scratch)]
            elif step == "vcan":
                found = [vcan(pytest_arguments, scratch)]
            elif step == "faults":
                found = faults(scratch, args.long)
            else:
                found = [soak(scratch, args.minutes, args.seed)]
            for result in found:
                say(f"== {result.step}: {result.state}, {result.seconds:.1f} s")
            results += found
        if args.keep:
            args.keep.mkdir(parents=True, exist_ok=True)
            for file in scratch.glob("*.json"):
                shutil.copy(file, args.keep)
        if args.table and (kept := sorted(map(str, scratch.glob("faults_*.json")))):
            call([sys.executable, str(FAULTS / "table.py"), *kept, str(PROJECT / "README.md")])
    return summarize(results, strict)


if __name__ == "__main__":
    sys.exit(main())
