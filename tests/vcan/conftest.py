"""Fixtures for tests on a real vcan.

In the run that is to have it (KCG_VCAN=1) a missing vcan is a failure, elsewhere a skip that says how to enable it.
"""

import itertools
import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from harness import PtyPort
from vcan_tools import GatewayProcess, feeding, ip

_numbers = itertools.count()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker("vcan")


@pytest.fixture
def vcan() -> Iterator[str]:
    """The name of a fresh virtual CAN interface (CAN FD capable), up."""
    name = f"kcg{os.getpid() % 10000}n{next(_numbers)}"
    made = subprocess.run(
        ["ip", "link", "add", name, "type", "vcan"], capture_output=True, text=True, check=False
    )
    if made.returncode:
        said = made.stderr.strip() or "ip link add failed"
        reason = f"no vcan can be made here ({said}): run `make test`, or `tests/vm/run -- pytest tests/vcan`"
        if os.environ.get("KCG_VCAN"):
            pytest.fail(reason)
        pytest.skip(reason)
    ip("link", "set", name, "mtu", "72", "up")
    yield name
    subprocess.run(["ip", "link", "del", name], capture_output=True, check=False)


@pytest.fixture
def escs(tmp_path: Path) -> Iterator[list[PtyPort]]:
    """The port of an ESC, to which nothing may be sent."""
    with feeding(tmp_path) as ports:
        yield ports


@pytest.fixture
def start_gateway(tmp_path: Path) -> Iterator[Callable[..., GatewayProcess]]:
    """A function that starts ``kontronik-can-gw run`` with a configuration text; ended at the test's end."""
    started: list[GatewayProcess] = []

    def start(toml: str, *options: str) -> GatewayProcess:
        path = tmp_path / f"gateway{len(started)}.toml"
        path.write_text(toml)
        started.append(GatewayProcess(path, *options))
        return started[-1]

    yield start
    for process in started:
        process.kill()
