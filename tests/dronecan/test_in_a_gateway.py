"""The DroneCAN output in a gateway: configuration, `check`, captures, and its cost when off."""

import json
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import capture_bench
import pytest
import wire_world
from command_line import run
from dronecan_bench import LIVE, Bench, loaded
from test_replay_is_identical import replayed

from kontronik_can_gw.assembly.capture_setup import CaptureSetup
from kontronik_can_gw.dronecan.wire import STATUS, Assembler
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("dronecan")

ON = {"enabled": True, "node_id": 42, "per_esc_nodes": True, "extended_hz": 7}
TOML = """
[can]
interface = "virtual"
bitrate = {bitrate}
[dbc]
{dbc}
[dronecan]
enabled = true
{more}
"""
ESC = "[[esc]]\nport = '/dev/tty{0}'\nname = '{0}'\npole_pairs = {1}\n"
DBC = """VERSION ""
BU_: Gw
BO_ {number} Voltage: 8 Gw
 SG_ LeftBatteryVoltage : 0|16@1+ (0.01,0) [0|655] "V" Vector__XXX
"""


def checked(
    folder: Path,
    more: str,
    *how: str,
    dbc: str = "enabled = false",
    kbit: int = 1000,
    poles: int = 7,
) -> tuple[object, str, str]:
    text = TOML.format(more=more, dbc=dbc, bitrate=kbit * 1000)
    text += ESC.format("left", 7) + ESC.format("right", poles)
    (folder / "a.toml").write_text(text)
    done = run("check", "-c", folder / "a.toml", *how)
    return done.code, done.out, done.err


def test_check_shows_nodes_resolution_and_load(tmp_path: Path) -> None:
    more = "node_id = 42\nfirst_index = 4\nextended_hz = 10"
    code, out, err = checked(tmp_path, more, "--json")
    assert err == ""
    assert code == 0
    found = json.loads(out)
    lines = found["outputs"]["dronecan"]
    (node,) = [line for line in lines if line.startswith("node 42, kontronik_can_gw, unique id")]
    assert node.endswith("left is esc_index 4, right is esc_index 5")
    assert "float16: voltage in steps of 0.016 V from 16 V on, 0.031 V from 32 V" in "".join(lines)
    assert "rpm is motor_speed, limited to 131071" in "".join(lines)
    # 2 x (50 x (8, 8, 3 bytes) + 10 x 8 bytes + 8 + 6 bytes) + 8 bytes, 29 bits, worst stuffing
    bits = 2 * (50 * (160 + 160 + 110) + 10 * 160 + 160 + 140) + 160
    assert found["bus_load"] == pytest.approx(bits / 1e6)
    assert found["frames_per_second"] == 325


@pytest.mark.parametrize(
    ("more", "given", "code", "said"),
    [
        ("", {"kbit": 500}, 0, "can.bitrate is 500 kbit/s, but autopilots run DroneCAN at"),
        ("rate_hz = 100", {"kbit": 125}, 0, "the DroneCAN nodes need 69% of 125 kbit/s"),
        ("rate_hz = 200", {"kbit": 125}, 2, "the DroneCAN nodes need"),
        ("", {"poles": 1}, 0, "rpm of right is computed for one pole pair. Set pole_pairs in"),
        ("rpm = 'electrical'", {"poles": 1}, 0, ""),
        (
            "rate_hz = 9",
            {},
            0,
            "dronecan.rate_hz is 9: below 10 ArduPilot may take a running motor",
        ),
        ("extended_hz = 1", {}, 0, "sent as -256 degC, which PX4 takes for a measurement"),
        ("rate_hz = 10", {"poles": 7}, 0, ""),
        ("", {}, 0, "Give each gateway on a bus its own dronecan.name"),
    ],
)
def test_check_warns_of_unusual_settings(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    more: str,
    given: dict[str, int],
    code: int,
    said: str,
) -> None:
    """One warning is for a machine without an id, whose unique ids depend on names alone."""
    if not given:
        monkeypatch.setattr("kontronik_can_gw.assembly.this_machine.identity_digest", lambda: b"")
    found, _, err = checked(tmp_path, f"node_id = 42\n{more}", **given)  # type: ignore[arg-type]
    assert found == code
    if said:
        assert said in err
    else:
        assert not err


@pytest.mark.parametrize(
    ("table", "reason"),
    [
        ({"node_id": 125, "per_esc_nodes": True}, "node_id: the last node would have node-ID 126."),
        ({"first_index": 31}, "first_index: the last ESC would have esc_index 32."),
        ({"name": "Left"}, 'name: "Left" is not a name of 1 to 60 lower-case letters'),
    ],
)
def test_mistake_is_refused_in_one_line(table: dict[str, Any], reason: str) -> None:
    with pytest.raises(UserError) as caught:
        loaded(2, **table)
    (line,) = caught.value.problems
    assert line.startswith(f"bench.toml: dronecan.{reason}")


@pytest.mark.parametrize(
    ("can_id", "more", "user"),
    [
        (0x2B, "node_id = 42\nper_esc_nodes = true", "DroneCAN node 43"),
        (
            0x10345210,
            "node_id = 0",
            "DroneCAN, because an allocation server may assign any node-ID",
        ),
        (0x1034522B, "node_id = 42", ""),
        (0x2B - (1 << 31), "node_id = 42\nper_esc_nodes = true", ""),  # 11 bits: another frame
    ],
)
def test_dbc_whose_ids_are_frames_of_our_node_is_refused(
    tmp_path: Path,
    can_id: int,
    more: str,
    user: str,
) -> None:
    (tmp_path / "own.dbc").write_text(DBC.format(number=can_id + (1 << 31)))
    code, _, err = checked(tmp_path, more, dbc='file = "own.dbc"')
    assert code == (2 if user else 0)
    assert not user or f"Voltage: id {can_id:X}h is used by {user}" in err


@pytest.mark.parametrize("is_on", [False, True])
def test_its_modules_are_only_loaded_if_it_is_on_and_openssl_never(is_on: bool) -> None:
    tables = {
        "can": {"interface": "virtual"},
        "dronecan": {"enabled": is_on},
        "esc": [{"port": "p"}],
    }
    code = (
        "import sys\n"
        "from kontronik_can_gw.assembly.assemble import assemble\n"
        "from kontronik_can_gw.config.parse import parse\n"
        "import kontronik_can_gw.cli.run, kontronik_can_gw.gateway.gateway\n"
        "import kontronik_can_gw.runtime.loop, kontronik_can_gw.assembly.capture_setup\n"
        f"assemble(parse({tables!r}, 'a.toml'))\n"
        "print('hashlib' in sys.modules, any('dronecan' in m for m in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", str(is_on)]


@pytest.mark.parametrize("canopen", [False, True])
def test_other_outputs_send_the_same_frames_with_and_without_it(canopen: bool) -> None:
    """Every 11-bit frame has the same bytes and time. SDO responses are included."""
    found = []
    for enabled in (True, False):
        given = loaded(
            2,
            dbc=True,
            canopen=canopen,
            enabled=enabled,
            extended_hz=33,
        )
        bench = Bench(2, given=given)
        rng = random.Random(6)
        for _ in range(80):
            for esc in range(2):
                live = LIVE._replace(electrical_speed=rng.randrange(70_000))
                live = live._replace(operating_errors=1 << rng.randrange(24))
                bench.live[esc] = live if rng.random() < 0.9 else None
            bench.run(0.1)
            if canopen:
                index = rng.choice([0x1000, 0x1018, 0x2000, 0x2011])
                request = bytes((0x40, index & 0xFF, index >> 8, rng.randrange(3), 0, 0, 0, 0))
                bench.receive(CanFrame(0x601, request))
        found.append([each for each in bench.frames if not each[1].extended])
        assert any(each[1].extended for each in bench.frames) == enabled
    assert found[0] == found[1]
    assert len(found[0]) > 1000


def test_replay_of_nodes_that_wait_for_node_ids_is_identical() -> None:
    """Requests for node-IDs have random pauses, which follow from the seed in the header."""
    setup, layout = capture_bench.made(2, dronecan=ON | {"node_id": 0})
    bench = capture_bench.Bench(setup, layout).live(0, 6)
    frames = [frame for frame in replayed(bench) if not frame.received]
    assert frames == bench.sent
    assert any(each.frame.extended for each in frames)


def test_capture_header_that_no_recorder_writes_is_refused() -> None:
    setup, _ = capture_bench.made(2, dronecan=ON)
    header: dict[str, Any] = json.loads(json.dumps(setup.header()))
    ours = header["outputs"].pop("dronecan")
    assert CaptureSetup.of(header).outputs == ()  # as in a capture of 0.5.0
    wrong = ({"table": {"rate_hz": 0}}, {"identity": "zz"}, {"seed": -1}, {"version": 6})
    invalid: list[Any] = [{"dronecan": ours | change} for change in wrong]
    invalid += [{"xyzzy": {}}, 7]
    for outputs in invalid:
        with pytest.raises(ValueError, match="the header cannot be used"):
            CaptureSetup.of(header | {"outputs": outputs})


def test_measurements_do_not_need_python() -> None:
    """Iterations in C continue: the core sends the measurements, and Python sends once a second."""
    bench = Bench(2, extended_hz=20)
    if bench.gateway.core.language != "C":
        pytest.skip(bench.gateway.core.note)
    followed: list[int] = []
    followers = [*bench.gateway.core.followers]
    follower = followers[0]  # the output's; the last one is the gateway's own

    def noted(esc: int, events: int, now: int) -> None:
        followed.append(events)
        follower.on_event(esc, events, now)

    followers[0] = follower._replace(on_event=noted)
    bench.gateway.core.followers = followers
    spoken = set()
    for _ in range(1000):
        bench.run(0.01)
        spoken.add(bench.gateway.next_deadline(with_core=False))
    assert len(followed) == 2  # the first of 1000 live frames of each ESC
    assert len(spoken) <= 11
    assert len(bench.of("Status")) == 2 * 500
    assert len(bench.of("StatusExtended")) in (2 * 200, 2 * 201)


def test_bus_that_is_too_slow_gets_complete_transfers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Newer values of two ESCs replace waiting ones, but a transfer that began is completed."""
    world = wire_world.World(2)
    setup = loaded(2)
    layout = MessageLayout("", "", ())
    loop = wire_world.loop_in(world, monkeypatch, setup.escs, layout, outputs=setup.outputs)
    loop.open()
    loop.begin()
    begun = world.now
    for wire in world.wires:
        wire.stream(begun, begun + 5 * SECOND, 10 * MS)
    wire_world.run(loop, world, begun + SECOND)
    world.bus.frame_ns = 5 * MS  # 200 of 300 frames a second
    wire_world.run(loop, world, begun + 5 * SECOND)
    assembler = Assembler()
    sent = [frame for _, frame in world.bus.sent if frame.can_id == 0x18040A2A]
    seed = STATUS.seed
    whole = [assembler.receive(frame.can_id, frame.data, seed, 0) for frame in sent]
    assert assembler.errors == 0
    assert sum(each is not None for each in whole) == len(sent) // 3 > 150
    assert loop.can._gateway.status.replaced_frames > 200
    loop.close()
