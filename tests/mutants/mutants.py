"""How strong the tests of the core packages are: a fixed sample of 100 mutants of each, run against the package's tests.

    python tests/mutants/mutants.py [PACKAGE...] [--json OUT] [--compare OLD] [--only KEY...]

A mutant runs in a process of its own that imports the project afresh, with the tests that execute the mutated lines, the
quickest first, until one fails. Nothing depends on the speed of the machine: hypothesis is derandomised, limits are CPU time
in proportion to the unmutated tests. --compare exits with 1 where a package's share killed is lower than in OLD.
"""

import argparse
import builtins
import gc
import importlib
import json
import os
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Mapping, Sequence
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, NoReturn

from mutations import Mutation, mutations, noting_lines

PROJECT = Path(__file__).resolve().parents[2]
SAMPLE, EXAMPLES = 100, 25
LIMIT_FACTOR, MIN_LIMIT_S, COLLECTION_LIMIT_S = 20, 2.0, 60.0  # CPU time
BLOCKED_S = 900  # wall time after which a mutant that waits is given up, undecided
MEMORY = 6 << 30
NOT_DECIDED = (70, -signal.SIGALRM)
PACKAGES = {
    "protocol": (("esc/kontronik",), ("tests/esc",)),
    "dbc_output": (("dbc", "signals"), ("tests/signals", "tests/dbc")),
    "cia301": (("canopen",), ("tests/canopen",)),
}
Result = dict[str, Any]
NOTE = "_note_of_mutants"


class Watch:
    """A pytest plugin: chooses and orders tests, limits each one's CPU time, notes what it takes and the lines it executes."""

    def __init__(self, limits: Mapping[str, float] | None = None) -> None:
        self.limits = limits
        self.seconds: dict[str, float] = {}
        self.failed: list[str] = []
        self.executed: set[tuple[str, int]] = set()
        self.lines: dict[str, set[tuple[str, int]]] = {}  # by test; "": while all was imported

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        if self.limits is not None:
            by_id = {item.nodeid: item for item in items}
            items[:] = [by_id[test] for test in self.limits]
        for item in items:
            _derandomise(getattr(item.obj, "__func__", item.obj))

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self.pytest_runtest_logfinish("")
        self.seconds[nodeid] = -time.process_time()
        limit_cpu(COLLECTION_LIMIT_S if self.limits is None else self.limits[nodeid])

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        self.seconds[nodeid] = self.seconds.get(nodeid, 0.0) + time.process_time()
        self.lines.setdefault(nodeid, set()).update(self.executed)
        self.executed.clear()
        limit_cpu(COLLECTION_LIMIT_S)

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed:
            self.failed.append(report.nodeid)


def _derandomise(test: Any) -> None:
    """A test of hypothesis: few examples, always the same, and no search for a smaller one."""
    from hypothesis import HealthCheck, Phase, settings

    if hasattr(test, "hypothesis"):
        own = getattr(test, "_hypothesis_internal_use_settings", None) or settings()
        test._hypothesis_internal_use_settings = settings(
            own,
            max_examples=min(EXAMPLES, own.max_examples),
            derandomize=True,
            database=None,
            deadline=None,
            phases=(Phase.explicit, Phase.generate),
            suppress_health_check=list(HealthCheck),
        )


def limit_cpu(seconds: float) -> None:
    """The process ends after so much more CPU time."""
    signal.setitimer(signal.ITIMER_PROF, seconds)


def in_child(
    watch: Watch, tests: Sequence[str], mutant: Mutation | None = None
) -> tuple[int, Result]:
    """Runs pytest in a forked process: the status of that, and without a mutant what has been seen."""
    with tempfile.TemporaryFile() as result:
        sys.stdout.flush()
        if not (child := os.fork()):
            _run(watch, tests, mutant, result.fileno())
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        result.seek(0)
        return status, eval(result.read() or b"{}")


def _run(watch: Watch, tests: Sequence[str], mutant: Mutation | None, result: int) -> NoReturn:
    status = NOT_DECIDED[0]
    try:
        import pytest

        signal.alarm(BLOCKED_S)
        limit_cpu(COLLECTION_LIMIT_S)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        for stream in (0, 1, 2) if mutant else (0, 1):
            os.dup2(os.open(os.devnull, os.O_RDWR), stream)
        _import_otherwise(watch, mutant)
        options = [
            "-q",
            "-p",
            "no:cacheprovider",
            "--assert=plain",
            "--tb=no",
            *(["-x"] if mutant else []),
        ]
        status = int(pytest.main([*options, *tests], plugins=[watch]))
        if not mutant:
            others = [name for name, module in sys.modules.items() if _is_of_others(module)]
            found = {
                "seconds": {test: s for test, s in watch.seconds.items() if test},
                "lines": watch.lines,
                "failed": watch.failed,
                "others": others,
            }
            os.write(result, repr(found).encode())
    finally:
        os._exit(status)


def _import_otherwise(watch: Watch, mutant: Mutation | None) -> None:
    """From now on the mutant's file is imported with it; without a mutant, in the first run, the project's notes its lines."""
    whole = SourceFileLoader.get_code
    setattr(builtins, NOTE, watch.executed.add)

    def get_code(self: SourceFileLoader, name: str) -> CodeType | None:
        if mutant and name == mutant.module:
            return compile(mutant.tree, self.path, "exec")
        if not mutant and watch.limits is None and name.startswith("kontronik_can_gw."):
            file = str(Path(self.path).relative_to(PROJECT))
            return compile(noting_lines(Path(self.path).read_text(), file, NOTE), self.path, "exec")
        return whole(self, name)

    if mutant:
        mutant.put_in()
    SourceFileLoader.get_code = get_code  # type: ignore[method-assign,assignment]


def _is_of_others(module: ModuleType) -> bool:
    file = Path(getattr(module, "__file__", None) or "/")
    return not file.is_relative_to(PROJECT) or ".venv" in file.parts


def unmutated(tests: Sequence[str]) -> Result:
    """Which test executes which lines and takes how long; and that all pass in the order in which mutants meet them."""
    status, known = in_child(Watch(), tests)
    if status == 0:
        for name in known["others"]:  # so that a mutant's process has them from the start
            try:
                importlib.import_module(name)
            except Exception:  # a test had its reasons to import it in another way
                continue
        gc.freeze()
        order = sorted(known["seconds"], key=known["seconds"].__getitem__)
        status, timed = in_child(Watch(dict.fromkeys(order, COLLECTION_LIMIT_S)), tests)
        known |= {"seconds": timed.get("seconds"), "failed": timed.get("failed")}
    if status:
        raise SystemExit(
            f"The tests fail without a mutant, pytest's status {status}: {known.get('failed')}"
        )
    return known


def is_killed(mutant: Mutation, known: Result) -> bool:
    place, seconds, lines = (str(mutant.file), mutant.line), known["seconds"], known["lines"]
    seeing = {test for test in seconds if place in lines[test] or place in lines[""]}
    files = sorted({test.partition("::")[0] for test in seeing})
    # what a fixture or a cache executes is noted for the first test only: the others of these files follow
    chosen = [test for test in seconds if test.partition("::")[0] in files]
    chosen.sort(key=lambda test: (test not in seeing, seconds[test]))
    return fails(mutant, files, {test: seconds[test] for test in chosen})


def fails(mutant: Mutation, files: Sequence[str], seconds: Mapping[str, float]) -> bool:
    """Whether one of these tests, tried in this order, does; an endless one fails by its limit."""
    if not seconds:
        return False
    limits = {test: max(MIN_LIMIT_S, LIMIT_FACTOR * each) for test, each in seconds.items()}
    status, _ = in_child(Watch(limits), files, mutant)
    if status in NOT_DECIDED:
        print(f"  not decided, counted as surviving: {mutant.key} {mutant}", flush=True)
    return status not in (0, *NOT_DECIDED)


def sample(package: str) -> list[Mutation]:
    found: list[Mutation] = []
    for folder in PACKAGES[package][0]:
        for file in sorted((PROJECT / "kontronik_can_gw" / folder).rglob("*.py")):
            found += mutations(file.relative_to(PROJECT), file.read_text())
    return sorted(found, key=lambda mutation: mutation.key)[:SAMPLE]


def judge(package: str, only: Sequence[str]) -> Result:
    known = unmutated(PACKAGES[package][1])
    killed, survived = [], {}
    for mutant in [each for each in sample(package) if not only or each.key in only]:
        if is_killed(mutant, known):
            killed.append(mutant.key)
        else:
            survived[mutant.key] = str(mutant)
            print(f"  {mutant.key} {mutant}", flush=True)
    print(f"{package}: {len(killed)} of {len(killed) + len(survived)} killed", flush=True)
    return {"killed": " ".join(killed), "survived": survived}


def compare(old: Result, new: Result) -> bool:
    """Prints what has changed; True if no package has lost."""
    lost = False
    for package, now in new.items():
        was = old[package]
        killed = [set(each["killed"].split()) for each in (was, now)]
        shares = [
            len(k) / (len(k) + len(each["survived"]))
            for k, each in zip(killed, (was, now), strict=True)
        ]
        lost |= shares[1] < shares[0]
        print(f"{package}: share killed {shares[0]:.0%} -> {shares[1]:.0%}")
        for key, text in now["survived"].items():
            if key not in was["survived"]:
                print(f"  survives{', was killed' if key in killed[0] else ' (new)'}: {key} {text}")
    return not lost


def settle() -> None:
    """What runs depend on is the same in each."""
    if os.environ.get("PYTHONHASHSEED") != "0":
        os.execve(
            sys.executable, [sys.executable, *sys.argv], {**os.environ, "PYTHONHASHSEED": "0"}
        )
    os.environ["KONTRONIK_PURE"] = "1"  # what is mutated is Python
    os.chdir(PROJECT)
    sys.path.insert(0, str(PROJECT))
    warnings.simplefilter("ignore")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("packages", nargs="*", metavar="PACKAGE", help=", ".join(PACKAGES))
    parser.add_argument(
        "--json", type=Path, metavar="OUT", help="write what was killed and what survived"
    )
    parser.add_argument(
        "--compare", type=Path, metavar="OLD", help="a file of --json to compare with"
    )
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="KEY", help="only these mutants of the sample"
    )
    options = parser.parse_args()
    packages = options.packages or list(PACKAGES)
    if wrong := set(packages) - set(PACKAGES):
        parser.error(f"{', '.join(wrong)}: no such package; there are {', '.join(PACKAGES)}")
    settle()
    found = {package: judge(package, options.only) for package in packages}
    if options.json:
        options.json.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n")
    return (
        0
        if options.compare is None or compare(json.loads(options.compare.read_text()), found)
        else 1
    )


if __name__ == "__main__":
    sys.exit(main())
