"""The examples of docs/canopen.md with ``canopen`` as master, run as they stand but for the interface, against a whole gateway."""

import contextlib
import gc
import io
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import can
import pytest

from kontronik_can_gw.canopen.storage import decode
from kontronik_can_gw.config.assemble import assemble
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.desk import pty
from kontronik_can_gw.esc.kontronik.simulator import (
    SECOND_NS,
    ErrorWindow,
    EscOptions,
    Faults,
    SimulatedEsc,
)
from kontronik_can_gw.esc.kontronik.states import OperatingError
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.runtime.loop import Loop
from kontronik_can_gw.runtime.store import ParameterStore

PROJECT = Path(__file__).resolve().parents[2]
PAGE = (PROJECT / "docs" / "canopen.md").read_text(encoding="utf-8")
CONNECT = 'network.connect(interface="socketcan", channel="can0")'
EXAMPLES = [
    block for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if CONNECT in block
]
POLL, PDOS, EMERGENCIES, STORE, LSS = EXAMPLES
pytestmark = pytest.mark.extended


@pytest.fixture(autouse=True, scope="module")
def patient_master() -> Iterator[None]:
    """The master waits for an answer however loaded the machine is."""
    with patch("canopen.sdo.client.SdoClient.RESPONSE_TIMEOUT", 60.0):
        yield


@contextmanager
def gateway(channel: str, store: Path, node_id: int) -> Iterator[None]:
    """A gateway with one simulated ESC that has an error for a second in every three."""
    windows = tuple(
        ErrorWindow(OperatingError.BEC_OVERCURRENT, (1 + 3 * n) * SECOND_NS, SECOND_NS)
        for n in range(100)
    )
    stop = threading.Event()
    with pty.PtyEsc() as esc:
        tables = {
            "can": {"interface": "virtual", "channel": channel},
            "canopen": {"enabled": True, "node_id": node_id, "store": str(store)},
            "esc": [{"port": esc.path}],
        }
        kept = ParameterStore(store)
        loaded = assemble(parse(tables, "test"), kept)
        core = Gateway(loaded.escs, loaded.layout, time.monotonic_ns(), canopen=loaded.canopen)
        loop = Loop(core, [esc.path], loaded.config.can, store=kept)
        loop.open()
        simulated = SimulatedEsc(EscOptions(faults=Faults(errors=windows)), seed=1)
        feeder = threading.Thread(target=lambda: pty.run([(simulated, esc)], stop=stop.is_set))
        runner = threading.Thread(target=loop.run)
        gc.freeze()  # objects left by thousands of earlier tests must not be scanned while the gateway has to answer
        feeder.start()
        runner.start()
        # it has come round: a node that waits for LSS does not say when it listens
        until(lambda: loop._housekeeping.due > 0)
        try:
            yield
        finally:
            loop.stop()
            stop.set()
            runner.join(60)
            feeder.join(60)
        assert esc.received == 0


def run(example: str, channel: str) -> str:
    """What an example prints."""
    code = example.replace(CONNECT, f'network.connect(interface="virtual", channel="{channel}")')
    assert code != example
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.chdir(PROJECT):
        exec(compile(code, "<example of docs/canopen.md>", "exec"), {})
    return out.getvalue()


@pytest.fixture(scope="module")
def channel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with gateway("examples", tmp_path_factory.mktemp("store"), 1):
        until(lambda: "link 2" in run(POLL, "examples"))
        yield "examples"


def until(holds: object, seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        with contextlib.suppress(Exception):
            if holds():  # type: ignore[operator]
                return
    raise AssertionError("it did not come about in time")


def test_poll(channel: str) -> None:
    said = run(POLL, channel)
    assert re.search(r"^voltage 2\d\.\d+ V$", said, re.MULTILINE)
    assert said.endswith("link 2\n")


def test_receive_pdos(channel: str) -> None:
    said = run(PDOS, channel).splitlines()
    assert len(said) == 15
    assert [line.rpartition(" ")[0] for line in said[:3]] == [
        "Live data.Electrical speed",
        "Live data.Battery voltage",
        "Live data.Battery current",
    ]
    assert all(2000 < int(line.rpartition(" ")[2]) < 3000 for line in said if "voltage" in line)


def test_emergencies(channel: str) -> None:
    said = run(EMERGENCIES, channel)
    assert re.search(r"^(2220|0000)h, error word", said, re.MULTILINE)
    assert re.search(r"^register \d+$", said, re.MULTILINE)
    assert "history 1: 2220h" in said


def test_change_settings_and_a_pdo_and_keep_them(channel: str, tmp_path: Path) -> None:
    with gateway("storing", tmp_path, 1):
        until(lambda: "link 2" in run(POLL, "storing"))
        run(STORE, "storing")
        stored = decode((tmp_path / "esc1.params").read_bytes())
        assert stored.application == {0x210001: b"\x07"}
        assert stored.communication[0x101700] == (500).to_bytes(2, "little")
        assert stored.communication[0x180401] == (0x400001A1).to_bytes(4, "little")
    with gateway("storing", tmp_path, 1), can.Bus(interface="virtual", channel="storing") as bus:
        until(lambda: "link 2" in run(POLL, "storing"))
        bus.send(can.Message(arbitration_id=0, data=[1, 0], is_extended_id=False))
        until(lambda: bus.recv(1).arbitration_id == 0x1A1)  # type: ignore[union-attr]


def test_give_a_waiting_node_its_id(tmp_path: Path) -> None:
    with gateway("lss", tmp_path, 255), can.Bus(interface="virtual", channel="lss") as bus:
        # a fastscan learns from time that it is not answered: on a loaded machine it may have to be repeated
        until(lambda: run(LSS, "lss").startswith("found True"))
        until(lambda: bus.recv(1).arbitration_id == 0x705)  # type: ignore[union-attr]
        assert decode((tmp_path / "esc1.params").read_bytes()).node_id == 5
