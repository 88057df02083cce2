"""``kontronik-can-gw mqtt`` as a process, against a real mosquitto, with its frames from an adapter on a pseudo terminal or a recording."""

import io
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import redirect_stderr, redirect_stdout
from itertools import pairwise
from pathlib import Path

import cantools.database
import pytest
from mqtt_bench import (
    PROGRAM,
    Mosquitto,
    Process,
    Slcan,
    Subscriber,
    Traffic,
    flight,
    free_port,
    kept,
    kept_by_mosquitto_sub,
    layout_of,
    slcan,
    wait_for,
    write_log,
)

from kontronik_can_gw.cli import main
from kontronik_can_gw.config import shipped
from kontronik_can_gw.protocol.states import OperatingError, OperatingState
from kontronik_can_gw.simulator import ErrorWindow, EscOptions, Faults, Phase

pytestmark = pytest.mark.extended

QUIET = EscOptions(profile=(Phase("off", 1000, 0, OperatingState.MotorOff, 0),))
FLIES = EscOptions(profile=(Phase("go", 1000, 60, OperatingState.Forward, 1),))


@pytest.fixture(scope="module")
def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Mosquitto]:
    made = Mosquitto(tmp_path_factory.mktemp("broker"))
    yield made
    made.stop()


@pytest.fixture
def adapter(tmp_path: Path) -> Iterator[Slcan]:
    with slcan(tmp_path) as made:
        yield made


def live(adapter: Slcan, broker: Mosquitto, name: str, *words: object) -> Process:
    """The program on the adapter's bus."""
    return Process("-c", adapter.configuration, "--broker", broker.address, "--gateway", name, *words)


def inside(*words: object) -> tuple[int, str]:
    """Exit code and talk of the program within this process."""
    out, talk = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(talk):
        code = main(list(map(str, words)))
    assert out.getvalue() == ""
    return code, talk.getvalue()


def refused(*words: object) -> tuple[int, str]:
    """Exit code and the one line that is said where it cannot work."""
    code, said = inside("mqtt", *words)
    assert said.count("\n") == 1, said
    return code, said.strip()


def put(port: int, messages: Mapping[str, bytes]) -> None:
    """Let the broker keep something that is not ours."""
    for topic, payload in messages.items():
        command = ["mosquitto_pub", "-h", "127.0.0.1", "-p", str(port), "-r", "-q", "1", "-t", topic, "-s"]
        subprocess.run(command, input=payload, check=True)


# --- the whole way


def test_what_is_on_the_bus_is_published_and_nothing_is_sent(adapter: Slcan, broker: Mosquitto) -> None:
    frames = flight(layout_of("esc1"), 30, FLIES)
    with live(adapter, broker, "way", "--rate", 5) as program, Subscriber(broker.port, "kontronik/way/#") as heard:
        wait_for(lambda: adapter.is_open, 20, lambda: program.log)
        with Traffic(adapter, frames) as traffic:
            heard.wait("kontronik/way/esc1/state", count=9)
        assert program.end()[0] == 0
    assert "Traceback" not in program.log
    database = cantools.database.load_file(shipped("dbc/kontronik_esc.dbc"))
    assert isinstance(database, cantools.database.Database)
    signals = {
        "electrical_speed": "ElectricalSpeed",
        "battery_voltage": "BatteryVoltage",
        "throttle": "ThrottlePercent",
    }
    speed = database.get_message_by_name("EscSpeed")
    for state in heard.of("kontronik/way/esc1/state")[2:]:
        # one of the frames shortly before it was published
        shortly = [f for when, f in traffic.put if f.can_id == speed.frame_id and -0.5 < when - state.when < 0]
        decoded = [speed.decode(f.data) for f in shortly]
        assert any(
            all(found[signal] == pytest.approx(state.json[source]) for source, signal in signals.items())  # type: ignore[call-overload]
            for found in decoded
        ), state
    times = [state.when for state in heard.of("kontronik/way/esc1/state")[2:]]
    assert all(0.05 < b - a < 0.5 for a, b in pairwise(times))
    assert heard.of("kontronik/way/online")[-1].payload == b"offline"
    assert heard.of("kontronik/way/esc1/available")[0].payload == b"online"
    assert adapter.sent == []


def test_a_fault_is_told_at_once_though_the_rate_is_slow(adapter: Slcan, broker: Mosquitto) -> None:
    window = ErrorWindow(OperatingError.OVERVOLTAGE, 1500 * 1_000_000)
    frames = flight(layout_of("esc1"), 10, EscOptions(profile=QUIET.profile, faults=Faults(errors=(window,))))
    with (
        live(adapter, broker, "fault", "--rate", 0.01) as program,
        Subscriber(broker.port, "kontronik/fault/#") as heard,
    ):
        wait_for(lambda: adapter.is_open, 20, lambda: program.log)
        with Traffic(adapter, frames) as traffic:
            topic = "kontronik/fault/esc1/state"
            wait_for(lambda: any(state.json["problem"] for state in heard.of(topic)), 10, lambda: heard.heard)
    told = next(state for state in heard.of(topic) if state.json["problem"])
    assert next(error["name"] for error in told.json["errors"] if error["severity"] == "error") == "overvoltage"
    happened = next(w for w, f in traffic.put if f.can_id == 0x680 and f.data[0] & 2)
    assert told.when - happened < 0.2 + 0.3  # and what a busy machine adds


def test_online_is_kept_by_the_broker_and_goes_offline_with_sigterm_within_half_a_second(
    adapter: Slcan, broker: Mosquitto
) -> None:
    with live(adapter, broker, "term") as program:
        program.wait_for_line("connected as kontronik-can-gw-term")
        wait_for(lambda: kept(broker.port, "kontronik/term/#").get("kontronik/term/online") == b"online", 5, "online")
        code, lasted = program.end()
    assert code == 0
    assert lasted < 0.5 + 0.3  # and what a busy machine adds
    found = kept_by_mosquitto_sub(broker.port, "kontronik/term/#")
    assert found["kontronik/term/online"] == b"offline"
    assert not any(topic.endswith("/state") for topic in found)


def test_the_last_will_says_offline_where_it_was_killed(adapter: Slcan, broker: Mosquitto) -> None:
    with live(adapter, broker, "killed") as program, Subscriber(broker.port, "kontronik/killed/online") as heard:
        heard.wait("kontronik/killed/online", b"online")
        program.end(signal.SIGKILL)
        heard.wait("kontronik/killed/online", b"offline", 5)
    assert kept(broker.port, "kontronik/killed/online") == {"kontronik/killed/online": b"offline"}


def test_a_bus_without_frames_is_told_while_the_publisher_stays_online(adapter: Slcan, broker: Mosquitto) -> None:
    frames = flight(layout_of("esc1"), 1, QUIET)
    with live(adapter, broker, "quiet") as program, Subscriber(broker.port, "kontronik/quiet/#") as heard:
        wait_for(lambda: adapter.is_open, 20, lambda: program.log)
        with Traffic(adapter, frames):
            heard.wait("kontronik/quiet/available", b"online")
            heard.wait("kontronik/quiet/esc1/available", b"offline", 6)
            heard.wait("kontronik/quiet/available", b"offline", 6)
        last = heard.of("kontronik/quiet/state")[-1].json
        assert (last["available"], last["gateway_state"]) == (False, None)
        assert last["age"] >= 3000
        assert heard.of("kontronik/quiet/online")[-1].payload == b"online"


def test_states_are_kept_if_that_is_wanted(tmp_path: Path, broker: Mosquitto) -> None:
    file = write_log(tmp_path / "a.log", flight(layout_of("esc1"), 2))
    with Process(file, "--broker", broker.address, "--gateway", "kept", "--retain", "--topic", "a/b") as program:
        assert program.process.wait(20) == 0
    found = kept(broker.port, "a/b/kept/#")
    assert json.loads(found["a/b/kept/esc1/state"])["operating_state"]
    assert set(found) == {
        *(f"a/b/kept/{topic}" for topic in ("online", "available", "state", "esc1/available", "esc1/state"))
    }


def test_a_recording_that_nobody_takes_fails(tmp_path: Path) -> None:
    file = write_log(tmp_path / "a.log", flight(layout_of("esc1"), 1))
    code, said = inside("mqtt", file, "--broker", f"127.0.0.1:{free_port()}", "--gateway", "nobody")
    assert code == 1
    last = said.splitlines()[-1]
    assert last.startswith("kontronik-can-gw mqtt: the end of the recording was not published. MQTT broker 127.0.0.1:")
    assert last.endswith(": connection refused. Does it run, and is the port right?")


def test_several_escs_come_by_their_names_from_a_configuration(tmp_path: Path, broker: Mosquitto) -> None:
    toml = tmp_path / "gateway.toml"
    toml.write_text(
        f'[mqtt]\nbroker = "{broker.address}"\ngateway = "two"\ntopic = "fleet"\nrate = 5\n'
        + "".join(f'[[esc]]\nport = "/dev/{name}"\nname = "{name}"\npole_pairs = 7\n' for name in ("left", "right"))
    )
    file = write_log(tmp_path / "a.log", flight(layout_of("left", "right"), 3, QUIET, FLIES))
    with Subscriber(broker.port, "fleet/#") as heard, Process(file, "-c", toml, "--gateway", "three") as program:
        assert program.process.wait(20) == 0
    left, right = (heard.of(f"fleet/three/{name}/state")[-1].json for name in ("left", "right"))
    assert (left["motor"], right["motor"]) == ("idle", "run")
    assert (left["electrical_speed"], right["electrical_speed"] > 1000) == (0, True)
    assert left["time"].startswith("2026-09-21T14:13:2")
    assert left["replay"] is True
    assert 10 <= len(heard.of("fleet/three/left/state")) <= 16


# --- Home Assistant


def test_discovery_is_kept_and_can_be_removed_again(tmp_path: Path, broker: Mosquitto) -> None:
    bus = layout_of("esc1")
    frames = flight(bus, 2)
    with Process(
        write_log(tmp_path / "a.log", frames), "--broker", broker.address, "--gateway", "ha", "--discovery"
    ) as program:
        assert program.process.wait(20) == 0
    found = {topic: json.loads(text) for topic, text in kept(broker.port, "homeassistant/#").items()}
    mine = {"homeassistant/device/kontronik_ha/config", "homeassistant/device/kontronik_ha_esc1/config"}
    assert set(found) == mine
    esc = found["homeassistant/device/kontronik_ha_esc1/config"]
    assert esc["device"]["sw_version"] == "4.17"
    assert esc["components"]["battery_voltage"]["unique_id"] == "kontronik_ha_esc1_battery_voltage"
    # what others have there: a gateway whose name begins alike, and another program
    theirs = {"homeassistant/device/kontronik_ha_2/config": b"", "homeassistant/device/x/config": b'{"a": 1}'}
    theirs["homeassistant/device/kontronik_ha_2/config"] = (
        json.dumps(found[min(mine)]).replace("/ha/", "/ha_2/").encode()
    )
    theirs["kontronik/ha_2/online"] = b"offline"
    put(broker.port, theirs)
    words = ("mqtt", "--broker", broker.address, "--gateway", "ha", "--remove-discovery")
    code, said = inside(*words)
    assert code == 0
    assert "homeassistant/device/kontronik_ha_esc1/config: cleared" in said
    # it is offline: nothing of it remains
    assert {**kept(broker.port, "homeassistant/#"), **kept(broker.port, "kontronik/+/online")}.items() >= theirs.items()
    assert not mine & set(kept(broker.port, "homeassistant/#"))
    assert kept(broker.port, "kontronik/ha/#") == {}
    code, said = inside(*words)
    assert (code, f"MQTT broker {broker.address} keeps nothing of ha" in said) == (0, True)


def test_removing_the_discovery_of_a_gateway_that_is_online_leaves_it_online(adapter: Slcan, broker: Mosquitto) -> None:
    with live(adapter, broker, "on", "--discovery", "ha2") as program:
        wait_for(lambda: "ha2/device/kontronik_on/config" in kept(broker.port, "ha2/#"), 10, "a discovery")
        words = ("mqtt", "--broker", broker.address, "--gateway", "on", "--remove-discovery", "--discovery", "ha2")
        code, said = inside(*words)
        assert (code, "on is online: only its discovery was cleared" in said) == (0, True)
        assert kept(broker.port, "ha2/#") == {}
        assert kept(broker.port, "kontronik/on/online") == {"kontronik/on/online": b"online"}
        assert program.process.poll() is None
        assert program.log.count("connected") == 1


# --- brokers that are missing, go away, do not want us


def test_a_broker_that_comes_late_goes_and_comes_again(tmp_path: Path, adapter: Slcan) -> None:
    port = free_port()
    words = ("-c", adapter.configuration, "--gateway", "late", "--rate", 20)
    with Process(*words, "--broker", f"127.0.0.1:{port}") as program:
        program.wait_for_line(f"MQTT broker 127.0.0.1:{port}: connection refused. Does it run, and is the port right?")
        wait_for(lambda: adapter.is_open, 20, lambda: program.log)
        with Traffic(adapter, flight(layout_of("esc1"), 120, QUIET)):
            made = Mosquitto(tmp_path, port=port)
            try:
                program.wait_for_line("connected as kontronik-can-gw-late", 30)
                made.stop()
                program.wait_for_line("the connection was lost")
                made.start()
                with Subscriber(port, "kontronik/late/#") as heard:
                    heard.wait("kontronik/late/online", b"online", 30)
                    heard.wait("kontronik/late/esc1/available", b"online")  # the broker had lost it
                    heard.wait("kontronik/late/esc1/state")
                program.wait_for_line(": connected, after")
                assert program.log.count("connection refused") <= 3  # not one line an attempt
                assert program.end()[0] == 0
            finally:
                made.stop()
    assert "Traceback" not in program.log


def test_a_wrong_password_is_said_once_and_a_new_one_is_taken_without_a_restart(tmp_path: Path, adapter: Slcan) -> None:
    users = tmp_path / "users"
    subprocess.run(["mosquitto_passwd", "-b", "-c", str(users), "boat", "right horse"], check=True, capture_output=True)
    made = Mosquitto(tmp_path, f"allow_anonymous false\npassword_file {users}\n")
    secret = tmp_path / "password"
    secret.write_text("wrong donkey\nmore\n")
    secret.chmod(0o644)
    try:
        with live(adapter, made, "pw", "--username", "boat", "--password-file", secret) as program:
            program.wait_for_line("refuses user 'boat': not authorized. Check user name and password.")
            assert f"{secret}: can be read by everybody on this machine. Run: chmod o= {secret}" in program.log
            time.sleep(0.5)
            assert program.log.count("refuses user") == 1
            secret.write_text("right horse\n")
            program.wait_for_line(f"MQTT broker {made.address}: connected", 30)
            command = Path(f"/proc/{program.process.pid}/cmdline").read_bytes()
            assert program.end()[0] == 0
        for text in ("donkey", "horse"):
            assert text not in program.log
            assert text.encode() not in command
        with live(adapter, made, "nobody") as program:
            program.wait_for_line("refuses us without a user name: not authorized. Check --username, --password-file.")
    finally:
        made.stop()


def test_the_same_gateway_twice_on_a_machine_is_refused(adapter: Slcan, broker: Mosquitto, tmp_path: Path) -> None:
    file = write_log(tmp_path / "a.log", flight(layout_of("esc1"), 1))
    with live(adapter, broker, "twice") as program:
        program.wait_for_line("connected as")
        code, said = refused(file, "--broker", broker.address, "--gateway", "twice")
        assert code == 1
        assert f"another process on this machine publishes as twice to MQTT broker {broker.address}" in said
        assert program.process.poll() is None


# --- mistakes of people


def test_each_mistake_is_one_line_with_the_remedy(tmp_path: Path) -> None:
    there = ("--broker", "127.0.0.1:1")
    code, said = refused()
    assert (code, said) == (
        2,
        "kontronik-can-gw mqtt: no broker is given: --broker HOST, or broker in the table [mqtt] of the configuration",
    )
    code, said = refused("--broker", "mqtt://x")
    assert (code, "--broker: 'mqtt://x' is not a broker, as broker.example" in said) == (2, True)
    code, said = refused(*there, "--rate", 21)
    assert (code, "--rate: 21.0 is outside 0.01..20" in said) == (2, True)
    code, said = refused(*there, "--ca-file", "x")
    assert (code, "--tls" in said) == (2, True)
    code, said = refused(*there, "--username", "x", "--password-file", tmp_path / "none")
    assert (code, said.endswith(f"{tmp_path}/none: the password cannot be read: No such file or directory")) == (
        1,
        True,
    )
    (tmp_path / "empty").write_text("\nx")
    code, said = refused(*there, "--username", "x", "--password-file", tmp_path / "empty")
    assert (code, said.endswith("has no password on its first line")) == (1, True)
    code, said = refused(*there, "--tls", "--ca-file", tmp_path / "empty")
    assert (code, said.endswith("is not a certificate in PEM form")) == (1, True)
    code, said = refused(*there, "--tls", "--ca-file", tmp_path / "none")
    assert (code, said.endswith("none: mqtt.ca_file cannot be read")) == (1, True)
    code, said = refused(*there, "--interface", "socketcan", "--channel", "no0")
    assert code == 1
    assert "no0" in said
    code, said = refused(*there, tmp_path / "none.log")
    assert (code, "none.log: there is no such file" in said) == (1, True)
    code, said = refused(*there, "--discovery", tmp_path / "empty")
    assert (code, said.endswith("is a file. Give FILE before the options.")) == (2, True)


def test_without_the_library_its_extra_is_named(tmp_path: Path) -> None:
    (tmp_path / "paho").mkdir()
    (tmp_path / "paho" / "__init__.py").write_text("raise ImportError('hidden')\n")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *filter(None, sys.path)])}
    done = subprocess.run([*PROGRAM, "--broker", "x"], capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 1
    assert done.stderr == "kontronik-can-gw mqtt: needs paho-mqtt 2: pip install 'kontronik-can-gw[mqtt]'\n"


def test_a_password_without_tls_to_another_machine_is_warned_of(tmp_path: Path, adapter: Slcan) -> None:
    secret = tmp_path / "password"
    secret.write_text("x")
    secret.chmod(0o600)
    bus = ("-c", adapter.configuration, "--username", "a", "--password-file", secret)
    with Process(*bus, "--broker", "broker.invalid") as program:
        program.wait_for_line("without TLS the password can be read by all on the way. Use --tls.")
        program.wait_for_line("MQTT broker broker.invalid:1883: the host's name is not known", 30)
        assert "everybody" not in program.log
        assert program.end()[1] < 0.8


# --- systemd


def test_the_service_manager_is_told_and_the_watchdog_fed(tmp_path: Path, adapter: Slcan, broker: Mosquitto) -> None:
    told: list[str] = []
    path = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(path)
        manager.settimeout(10)
        words = ("-c", adapter.configuration, "--broker", broker.address, "--gateway", "sd")
        with Process(*words, environment={"NOTIFY_SOCKET": path, "WATCHDOG_USEC": "1000000"}) as program:
            while not any("STATUS=connected" in text for text in told) or sum("WATCHDOG=1" in t for t in told) < 5:
                told.append(manager.recv(4096).decode())
            assert program.end()[0] == 0
            while "STOPPING=1" not in told[-1]:
                told.append(manager.recv(4096).decode())
    assert "READY=1" in told[0]


def test_as_a_service_it_waits_for_the_interface(tmp_path: Path, broker: Mosquitto) -> None:
    path = str(tmp_path / "notify")
    with (
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager,
        Subscriber(broker.port, "kontronik/wait/#") as heard,
    ):
        manager.bind(path)
        words = (
            "--interface",
            "slcan",
            "--channel",
            tmp_path / "none",
            "--broker",
            broker.address,
            "--gateway",
            "wait",
        )
        with Process(*words, environment={"NOTIFY_SOCKET": path}) as program:
            heard.wait("kontronik/wait/online", b"online")
            heard.wait("kontronik/wait/available", b"offline")
            assert program.log.count(f"CAN slcan {tmp_path}/none") == 1
            assert program.end()[0] == 0
