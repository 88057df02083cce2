"""``kontronik-can-gw mqtt`` as a process, against a real mosquitto, on a bus without frames."""

import signal
import socket
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from command_line import written
from mqtt_bench import PATIENCE, Mosquitto, Subscriber, free_port, kept
from vcan_tools import GatewayProcess, wait_for

pytestmark = pytest.mark.extended
Live = Callable[..., GatewayProcess]


@pytest.fixture(scope="module")
def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Mosquitto]:
    made = Mosquitto(tmp_path_factory.mktemp("broker"))
    yield made
    made.stop()


@pytest.fixture
def live(tmp_path: Path, broker: Mosquitto) -> Iterator[Live]:
    """Starts the program for a gateway of this name, on a bus that is quiet."""
    started = []

    def start(name: str, address: str = broker.address, more: str = "") -> GatewayProcess:
        text = '[can]\ninterface = "virtual"\nchannel = "mqtt"\n[[esc]]\nport = "/dev/ttyS0"\n'
        text += f'[mqtt]\nbroker = "{address}"\ngateway = "{name}"\nrate = 20.0\n{more}'
        started.append(GatewayProcess(written(tmp_path / "gateway.toml", text), command="mqtt"))
        return started[-1]

    yield start
    for each in started:
        each.kill()


def test_online_is_kept_by_the_broker_and_goes_offline_with_sigterm(
    live: Live, broker: Mosquitto
) -> None:
    program, state = live("term"), "kontronik/term/online"
    program.wait_for_line("connected as kontronik-can-gw-term")
    wait_for(lambda: kept(broker.port, state) == {state: b"online"}, state)
    assert program.end() == 0
    found = kept(broker.port, "kontronik/term/#")
    assert found[state] == b"offline"
    assert not any(topic.endswith("/state") for topic in found)


def test_the_last_will_says_offline_where_it_was_killed(live: Live, broker: Mosquitto) -> None:
    state = "kontronik/killed/online"
    program = live("killed")
    with Subscriber(broker.port, state) as heard:
        heard.wait(state, b"online")
        program.end(signal.SIGKILL)
        heard.wait(state, b"offline")
    assert kept(broker.port, state) == {state: b"offline"}


# --- brokers that are missing, go away, do not want us


def test_a_broker_that_comes_late_goes_and_comes_again(live: Live, tmp_path: Path) -> None:
    port = free_port()
    program = live("late", f"127.0.0.1:{port}")
    program.wait_for_line(f"MQTT broker 127.0.0.1:{port}: cannot be reached: Connection refused")
    made = Mosquitto(tmp_path, port=port)
    try:
        program.wait_for_line("connected as kontronik-can-gw-late")
        made.stop()
        program.wait_for_line("the connection was lost")
        made.start()
        with Subscriber(port, "kontronik/late/#") as heard:
            heard.wait("kontronik/late/online", b"online")
            heard.wait("kontronik/late/esc1/available", b"offline")  # the broker had lost it
            heard.wait("kontronik/late/esc1/state")
        program.wait_for_line(": connected, after")
        assert program.log.count("Connection refused") <= 3  # not one line an attempt
        assert program.end() == 0
    finally:
        made.stop()
    assert "Traceback" not in program.log


def test_a_wrong_password_is_said_once_and_a_new_one_is_taken_without_a_restart(
    live: Live, tmp_path: Path
) -> None:
    users, secret = tmp_path / "users", written(tmp_path / "password", "wrong donkey\nmore\n")
    command = ["mosquitto_passwd", "-b", "-c", str(users), "boat", "right horse"]
    subprocess.run(command, check=True, capture_output=True)
    made = Mosquitto(tmp_path, f"allow_anonymous false\npassword_file {users}\n")
    try:
        program = live("pw", made.address, 'username = "boat"\npassword_file = "password"\n')
        refusal = "refuses the connection: not authorized. Check username, password_file"
        program.wait_for_line(refusal)
        secret.write_text("right horse\n")
        program.wait_for_line(f"MQTT broker {made.address}: connected")
        shown = Path(f"/proc/{program.process.pid}/cmdline").read_text()
        assert program.end() == 0
        assert program.log.count("refuses the connection") == 1
        for text in ("donkey", "horse"):
            assert text not in program.log + shown
    finally:
        made.stop()


def test_the_service_manager_is_reported_and_the_watchdog_fed(
    live: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = ""
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    monkeypatch.setenv("WATCHDOG_USEC", "1000000")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(PATIENCE)
        program = live("sd")
        while "STATUS=connected" not in said or said.count("WATCHDOG=1") < 5:
            said += manager.recv(4096).decode()
        assert program.end() == 0
        while "STOPPING=1" not in said:
            said += manager.recv(4096).decode()
    assert said.startswith("READY=1")
