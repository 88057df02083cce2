"""The age of values at the far end of a slow interface, in both cores.

A vxcan pair is the interface, and ``tc`` limits the frames that leave it.
"""

import itertools
import os
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from harness import PtyPort
from packer_oracle import Msg, Sig, dbc_text
from raw_bus import RawBus
from vcan_tools import GatewayProcess, configuration, ip

from kontronik_can_gw.native import load

pytestmark = pytest.mark.promise("slow-bus")

TIMEOUT_NS = 250_000_000
QUARTER_NS = TIMEOUT_NS // 4
SLACK_NS = 30_000_000
"""For the scheduling of the machine: the ages are judged by another process."""
MEASURED_S = 6
TIMES = """BA_DEF_DEF_ "GenMsgCycleTime" 20;
BA_DEF_DEF_ "GenMsgSendType" "CyclicAndEvent";
"""
_numbers = itertools.count()


@contextmanager
def slow_pair(rate: int) -> Iterator[tuple[str, str]]:
    """Yield both ends of a vxcan pair whose near end lets ``rate`` frames a second leave."""
    number = next(_numbers)
    near, far = f"kn{os.getpid() % 10000}n{number}", f"kf{os.getpid() % 10000}n{number}"
    made = subprocess.run(
        ["ip", "link", "add", near, "type", "vxcan", "peer", "name", far],
        capture_output=True,
        text=True,
        check=False,
    )
    if made.returncode:
        if os.environ.get("KCG_VCAN"):
            pytest.fail(made.stderr)
        pytest.skip(f"no vxcan can be made here ({made.stderr.strip()}): run `make test`")
    try:
        ip("link", "set", near, "up")
        ip("link", "set", far, "up")
        let_leave("add", near, 128 * rate)
        yield near, far
    finally:
        subprocess.run(["ip", "link", "del", near], capture_output=True, check=False)


def let_leave(command: str, near: str, bits: int) -> None:
    """Add or change the limit of an interface, in bit/s. A frame has 128."""
    limit = f"dev {near} root tbf rate {bits}bit burst 16 limit 16000"
    subprocess.run(["tc", "qdisc", command, *limit.split()], check=True)


def start_gateway(
    near: str, escs: list[PtyPort], folder: Path, language: str, patch: pytest.MonkeyPatch
) -> GatewayProcess:
    """Start a gateway that sends three messages with values."""
    if language == "Python":
        patch.setenv(load.PURE, "1")
    elif load.library()[0] is None:
        pytest.skip("this machine has no core in C")
    messages = [Msg(f"M{n}", 0x100 + n, 8, [Sig("Charge", 0, 16)]) for n in range(3)]
    (folder / "own.dbc").write_text(dbc_text(messages, TIMES))
    bind = "".join(f'"M{n}.Charge" = "consumed_charge"\n' for n in range(3))
    toml = f'[dbc]\nfile = "{folder}/own.dbc"\n[dbc.bind]\n{bind}'
    config = folder / "gateway.toml"
    config.write_text(configuration(near, escs, toml, "telemetry_timeout_ms = 250"))
    gateway = GatewayProcess(config)
    gateway.wait_for_line("CAN socketcan")
    escs[0].on = True
    return gateway


class Other:
    """Another program that sends 100 frames a second through the same interface."""

    def __init__(self, interface: str) -> None:
        self._interface = interface
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._send)
        self._thread.start()

    def _send(self) -> None:
        with RawBus(self._interface) as bus:
            bus._socket.setsockopt(1, 7, 1)  # SO_SNDBUF: about six frames, as the gateway's
            while not self._is_over.wait(0.01):
                bus.send(0x50, b"other", wait=False)

    def close(self) -> None:
        self._is_over.set()
        self._thread.join()


def ages_at(far: str, port: PtyPort, seconds: float) -> tuple[list[int], int]:
    """Return the ages of the values that arrive in ns, and the number of all frames."""
    ages = []
    frames = 0
    end = time.monotonic() + seconds
    with RawBus(far, (0, 0)) as witness:
        while time.monotonic() < end:
            got = witness.receive(0.1)
            if got is None:
                continue
            frames += 1
            can_id, data = got
            charge = int.from_bytes(data[:2], "little")
            if 0x100 <= can_id < 0x108 and charge < 65_000:
                ages.append(time.monotonic_ns() - port.sent[charge])
    return ages, frames


@pytest.mark.parametrize("language", ["C", "Python"])
@pytest.mark.parametrize("has_other", [False, True])
@pytest.mark.parametrize(
    "rate",
    [pytest.param(each, marks=pytest.mark.extended) for each in (100, 40, 28, 10)] + [20, 5],
)
def test_no_value_is_old_at_the_far_end_of_a_slow_bus(
    rate: int,
    has_other: bool,
    language: str,
    escs: list[PtyPort],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with slow_pair(rate) as (near, far):
        gateway = start_gateway(near, escs, tmp_path, language, monkeypatch)
        other = Other(near) if has_other else None
        try:
            in_kernel = 13 if has_other else 7
            time.sleep(1 + in_kernel / rate)  # frames that were under way at the slow-down
            ages, frames = ages_at(far, escs[0], MEASURED_S)
            assert gateway.end() == 0, gateway.log
        finally:
            if other is not None:
                other.close()
            gateway.kill()
    one_frame_ns = (7 if has_other else 1) * 1_000_000_000 // rate
    limit_ns = TIMEOUT_NS + QUARTER_NS + one_frame_ns + SLACK_NS
    oldest_ms = max(ages, default=0) / 1e6
    print(
        f"{language:6} {rate:3} frames/s, other {has_other!s:5}: {frames / MEASURED_S:5.1f} left, "
        f"{len(ages):3} values, oldest {oldest_ms:4.0f} ms, limit {limit_ns / 1e6:.0f} ms"
    )
    assert ages or has_other
    assert oldest_ms * 1e6 <= limit_ns
    assert frames >= 0.95 * MEASURED_S * rate - 1
    assert "restart" not in gateway.log
    assert "no frame can be sent" not in gateway.log


@pytest.mark.promise("late-frames")
@pytest.mark.parametrize("language", ["C", "Python"])
def test_values_of_a_start_on_an_unplugged_bus_are_not_sent_after_a_restart(
    language: str, escs: list[PtyPort], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The interface has sent nothing yet. One frame is in the controller, the others wait."""
    with slow_pair(1) as (near, far):
        ip("link", "set", far, "down")  # a frame that leaves the queue is not counted as sent
        let_leave("change", near, 8)
        gateway = start_gateway(near, escs, tmp_path, language, monkeypatch)
        try:
            gateway.wait_for_line("no frame can be sent")
            ip("link", "set", near, "down")
            time.sleep(0.5)
            ip("link", "set", near, "up")
            time.sleep(4)
            assert Path("/sys/class/net", near, "statistics/tx_packets").read_text() == "0\n"
            ip("link", "set", far, "up")
            let_leave("change", near, 128_000)
            ages, _ = ages_at(far, escs[0], 2)
            assert gateway.end() == 0, gateway.log
        finally:
            gateway.kill()
    assert len(ages) > 100
    assert max(ages) <= TIMEOUT_NS + SLACK_NS
