"""Fixtures for tests on a real vcan.

With KCG_VCAN=1 a missing vcan is a failure. Otherwise the tests are skipped, and the reason names
the command that enables them.
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
    """Yield the name of a new virtual CAN interface, which is up and capable of CAN FD."""
    name = f"kcg{os.getpid() % 10000}n{next(_numbers)}"
    command = ["ip", "link", "add", name, "type", "vcan"]
    made = subprocess.run(command, capture_output=True, text=True, check=False)
    if made.returncode:
        error = made.stderr.strip() or "ip link add failed"
        remedy = "run `make test`, or `tests/vm/run -- pytest tests/vcan`"
        reason = f"no vcan can be made here ({error}): {remedy}"
        if os.environ.get("KCG_VCAN"):
            pytest.fail(reason)
        pytest.skip(reason)
    ip("link", "set", name, "mtu", "72", "up")
    yield name
    subprocess.run(["ip", "link", "del", name], capture_output=True, check=False)


@pytest.fixture
def escs(tmp_path: Path) -> Iterator[list[PtyPort]]:
    """Yield the port of an ESC, to which no byte may be sent."""
    with feeding(tmp_path) as ports:
        yield ports


@pytest.fixture
def start_gateway(tmp_path: Path) -> Iterator[Callable[..., GatewayProcess]]:
    """Yield a function that starts ``kontronik-can-gw run`` with a configuration text.

    The processes are killed at the end of the test.
    """
    started: list[GatewayProcess] = []

    def start(toml: str, *options: str) -> GatewayProcess:
        path = tmp_path / f"gateway{len(started)}.toml"
        path.write_text(toml)
        started.append(GatewayProcess(path, *options))
        return started[-1]

    yield start
    for process in started:
        process.kill()
