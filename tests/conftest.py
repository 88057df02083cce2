"""Fixtures and settings of all tests.

python-can is imported first, and asammdf with it. The gateway's own code imports python-can
without asammdf, and the rest of the process would then lack it. Tests on a vcan import neither
so early.
"""

import gc
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from child_signals import use_defaults_in_children

use_defaults_in_children()

LOCAL_ZONE = "IST-5:30"
"""Local time of all tests: India's, written so that no database of zones is needed.

If it were UTC, no test would notice that local time and UTC are exchanged.
"""
os.environ["TZ"] = LOCAL_ZONE
time.tzset()

if not os.environ.get("KCG_VCAN"):
    import can  # noqa: F401
    from hypothesis import HealthCheck, settings

    # Every run uses the same examples, and the duration of an example is not judged.
    settings.register_profile(
        "suite",
        deadline=None,
        derandomize=True,
        suppress_health_check=[HealthCheck.too_slow],
    )
    settings.load_profile("suite")


def pytest_collection_finish() -> None:
    """Exclude the imported modules from garbage collection.

    A collection that walks through large libraries such as pandas would hold up a gateway in this
    process for a long time.
    """
    gc.collect()
    gc.freeze()


TESTS = Path(__file__).parent
ON_BOTH_CORES = (
    "gateway/test_output_of_its_own.py",
    "gateway/test_quiet_mode.py",
    "gateway/test_values_on_the_bus.py",
    "golden/test_golden.py::test_frames_have_not_changed",
    "dbc/test_schedule_and_messages.py",
    "dbc/test_binding.py",
    "capture/test_replay_is_identical.py",
    "canopen/test_outages_and_order.py",
    "canopen/test_dialogues.py",
    "canopen/test_sync_at_once.py",
    "dronecan/test_in_a_gateway.py::test_bus_that_is_too_slow_gets_complete_transfers",
    "runtime/test_hold_ups.py",
    "runtime/test_esc_input.py",
    "runtime/test_quiet_mode_in_the_loop.py",
    "runtime/test_snapshot.py",
    "recordings/test_plain_bytes.py",
    "recordings/test_tables.py",
)
"""Tests of the core, given as folders, files or single tests. They run on both cores."""


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run the tests of the core on the core in C and on the core in Python."""
    file = Path(str(metafunc.module.__file__)).relative_to(TESTS)
    places = [str(file), f"{file}::{metafunc.function.__name__}"]
    places += [str(folder) for folder in file.parents]
    if any(place in ON_BOTH_CORES for place in places):
        metafunc.parametrize("core_language", ["C", "Python"], indirect=True)


@pytest.fixture(autouse=True)
def core_language(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Give every gateway of the test the core of this language, if the test names one."""
    language = getattr(request, "param", "")
    if not language:
        yield ""
        return
    from kontronik_can_gw.native import load

    if language == "C":
        request.getfixturevalue("c_compiler")  # for a core with a simulated kernel
    monkeypatch.setenv(load.PURE, str(int(language == "Python")))
    library = load.library
    library.cache_clear()
    found, why = library()
    if found is None and language == "C":
        remedy = "sudo apt-get install gcc libc6-dev; python -m kontronik_can_gw.native.compile"
        pytest.skip(f"the core in C: {why}; {remedy}")
    yield language
    library.cache_clear()


@pytest.fixture(scope="session")
def hidden_compilers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make compilers that only fail. They hide those of the machine."""
    from built import hide_compilers

    return hide_compilers(tmp_path_factory.mktemp("path"))


@pytest.fixture(autouse=True)
def without_compiler(hidden_compilers: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Let a test that does not ask for a compiler find none. Return PATH with compilers."""
    before = os.environ.get("PATH", os.defpath)
    monkeypatch.setenv("PATH", f"{hidden_compilers}:{before}")
    return before


@pytest.fixture
def c_compiler(without_compiler: str, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Let the test use a C compiler.

    Returns ``built.there``, which returns the path of a compiler by its name. The test is skipped
    if this machine has none.
    """
    from built import there

    monkeypatch.setenv("PATH", without_compiler)
    there()
    return there


OF_SYSTEMD = (
    "NOTIFY_SOCKET",
    "WATCHDOG_USEC",
    "WATCHDOG_PID",
    "JOURNAL_STREAM",
    "INVOCATION_ID",
    "RUNTIME_DIRECTORY",
    "STATE_DIRECTORY",
    "XDG_STATE_HOME",
)
"""Variables that systemd sets for a service. A gateway would take them for its own."""
OF_TERMINALS = ("COLUMNS", "LINES", "NO_COLOR", "FORCE_COLOR", "CLICOLOR_FORCE")


def clear_environment(patch: pytest.MonkeyPatch) -> None:
    """Remove variables that change how the gateway runs or prints. Set zone and umask."""
    for name in (*OF_SYSTEMD, *OF_TERMINALS):
        patch.delenv(name, raising=False)
    patch.setenv("TZ", LOCAL_ZONE)
    time.tzset()
    os.umask(0o022)


@pytest.fixture(autouse=True, scope="session")
def plain_machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Make the tests independent of how this machine is set up.

    - No variables that change how the gateway runs or prints, one zone as local time, umask 022.
    - A machine id: containers and fresh roots have none, and the configuration warns about that.
    - No configuration in /etc: an installed gateway has one.
    - A separate runtime folder for this process and its children. A user without a session has
      no such folder, and a gateway of the system must not meet the locks of the tests.
    """
    from kontronik_can_gw.cli import arguments
    from kontronik_can_gw.runtime.system import folders, machine

    file = tmp_path_factory.mktemp("machine") / "machine-id"
    file.write_text("0123456789abcdef0123456789abcdef\n")
    runtime = tmp_path_factory.mktemp("runtime")
    with pytest.MonkeyPatch.context() as patch:
        clear_environment(patch)
        patch.setenv("XDG_RUNTIME_DIR", str(runtime))
        patch.setenv("KONTRONIK_RUN", str(runtime))
        patch.setattr(folders, "RUN", runtime)
        patch.setattr(machine, "_IDENTITIES", (str(file), "/etc/machine-id"))
        patch.setattr(arguments, "CONFIG_PLACES", arguments.CONFIG_PLACES[:1])
        yield


@pytest.fixture(scope="session")
def native_library(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Compile the optimised C core, which serves any layout. A compiler warning is an error."""
    from built import STRICT, built

    from kontronik_can_gw.native.binding import load
    from kontronik_can_gw.native.objects import OPTIONS

    library = tmp_path_factory.mktemp("native") / "core.so"
    return load(built(library, *STRICT, "-O2", *OPTIONS))
