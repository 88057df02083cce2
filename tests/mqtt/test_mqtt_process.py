"""``kontronik-can-gw mqtt`` as a process, against a real mosquitto, on a bus without frames."""

import signal
import socket
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from command_line import refused, written
from mqtt_bench import (
    PATIENCE,
    Mosquitto,
    Process,
    Subscriber,
    free_port,
    kept,
    wait_for,
)
from paho.mqtt import publish

pytestmark = pytest.mark.extended


@pytest.fixture(scope="module")
def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Mosquitto]:
    made = Mosquitto(tmp_path_factory.mktemp("broker"))
    yield made
    made.stop()


def configuration(folder: Path, address: str, name: str, more: str = "") -> Path:
    """Of a gateway on a bus that is quiet."""
    text = '[can]\ninterface = "virtual"\nchannel = "mqtt"\n[[esc]]\nport = "/dev/ttyS0"\n'
    text += f'[mqtt]\nbroker = "{address}"\ngateway = "{name}"\nrate = 20.0\n{more}'
    return written(folder / "gateway.toml", text)


@pytest.fixture
def live(tmp_path: Path, broker: Mosquitto) -> Callable[..., Process]:
    """The program on the bus."""
    return lambda name, **how: Process("-c", configuration(tmp_path, broker.address, name), **how)


def test_online_is_kept_by_the_broker_and_goes_offline_with_sigterm(
    live: Callable[..., Process], broker: Mosquitto
) -> None:
    with live("term") as program:
        program.wait_for_line("connected as kontronik-can-gw-term")
        wait_for(
            lambda: kept(broker.port, "kontronik/term/#").get("kontronik/term/online") == b"online",
            "online",
        )
        assert program.end() == 0
    found = kept(broker.port, "kontronik/term/#")
    assert found["kontronik/term/online"] == b"offline"
    assert not any(topic.endswith("/state") for topic in found)


def test_the_last_will_says_offline_where_it_was_killed(
    live: Callable[..., Process], broker: Mosquitto
) -> None:
    with (
        live("killed") as program,
        Subscriber(broker.port, "kontronik/killed/online") as heard,
    ):
        heard.wait("kontronik/killed/online", b"online")
        program.end(signal.SIGKILL)
        heard.wait("kontronik/killed/online", b"offline")
    assert kept(broker.port, "kontronik/killed/online") == {"kontronik/killed/online": b"offline"}


# --- Home Assistant


def test_what_is_kept_of_discovery_can_be_removed_as_the_removed_option_says(
    broker: Mosquitto,
) -> None:
    topics = {f"homeassistant/device/kontronik_ha{end}/config" for end in ("", "_esc1", "_2")}
    for topic in topics:
        publish.single(topic, b"{}", 1, True, "127.0.0.1", broker.port)
    advice = refused(2, "mqtt", "--remove-discovery").partition("Type ")[2]
    command, _, each = advice.replace("kontronik_GATEWAY", "kontronik_ha").partition(", and for ")
    command += each.partition("each ESC")[2].rstrip(".").replace("_ESC", "_esc1")
    words = command.replace("BROKER", f"127.0.0.1 -p {broker.port}").split()
    subprocess.run(words, check=False, capture_output=True, timeout=PATIENCE)
    theirs = {"homeassistant/device/kontronik_ha_2/config"}
    assert set(kept(broker.port, "homeassistant/#")) == theirs


# --- brokers that are missing, go away, do not want us


def test_a_broker_that_comes_late_goes_and_comes_again(tmp_path: Path) -> None:
    port = free_port()
    with Process("-c", configuration(tmp_path, f"127.0.0.1:{port}", "late")) as program:
        program.wait_for_line(
            f"MQTT broker 127.0.0.1:{port}: cannot be reached: Connection refused"
        )
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
    tmp_path: Path,
) -> None:
    users, secret = tmp_path / "users", written(tmp_path / "password", "wrong donkey\nmore\n")
    command = ["mosquitto_passwd", "-b", "-c", str(users), "boat", "right horse"]
    subprocess.run(command, check=True, capture_output=True)
    made = Mosquitto(tmp_path, f"allow_anonymous false\npassword_file {users}\n")
    try:
        more = 'username = "boat"\npassword_file = "password"\n'
        with Process("-c", configuration(tmp_path, made.address, "pw", more)) as program:
            program.wait_for_line(
                "refuses the connection: not authorized. Check username, password_file"
            )
            secret.write_text("right horse\n")
            program.wait_for_line(f"MQTT broker {made.address}: connected")
            shown = Path(f"/proc/{program.process.pid}/cmdline").read_text()
            assert program.log.count("refuses the connection") == 1
            assert program.end() == 0
        for text in ("donkey", "horse"):
            assert text not in program.log + shown
    finally:
        made.stop()


# --- systemd


def test_the_same_gateway_twice_on_a_machine_is_refused(
    live: Callable[..., Process], broker: Mosquitto, tmp_path: Path
) -> None:
    with live("twice") as program:
        program.wait_for_line("connected as")
        said = refused(1, "mqtt", "-c", tmp_path / "gateway.toml")
        assert (
            f"another process on this machine publishes as twice to MQTT broker {broker.address}"
            in said
        )
        assert program.process.poll() is None


def test_the_service_manager_is_reported_and_the_watchdog_fed(
    tmp_path: Path, live: Callable[..., Process]
) -> None:
    told: list[str] = []
    path = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(path)
        manager.settimeout(PATIENCE)
        environment = {"NOTIFY_SOCKET": path, "WATCHDOG_USEC": "1000000"}
        with live("sd", environment=environment) as program:
            while (
                "STATUS=connected" not in "".join(told)
                or sum("WATCHDOG=1" in text for text in told) < 5
            ):
                told.append(manager.recv(4096).decode())
            assert program.end() == 0
            while "STOPPING=1" not in told[-1]:
                told.append(manager.recv(4096).decode())
    assert "READY=1" in told[0]
