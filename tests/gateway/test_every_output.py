"""The rules of the seam of an output (core/output.py), for each output of OUTPUTS.

An output gets this suite with its name in OUTPUTS. SETTINGS has the keys that it needs to send
measurements without a master or a server. The output of outputs/voltages follows the recipe for an
output, so it passes the suite as well.
"""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import example_output
import pytest
from capture_bench import START, Bench, esc
from test_replay_is_identical import replayed

from kontronik_can_gw.assembly.assemble import assemble
from kontronik_can_gw.assembly.capture_setup import CaptureSetup
from kontronik_can_gw.cli.recording import setup_of
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.core.output_setup import OUTPUTS, OutputSetup
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData
from kontronik_can_gw.frames import CanFrame, block_of
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.times import MS, NEVER, SECOND

pytestmark = pytest.mark.promise("outputs")

PACKAGE = Path(__file__).resolve().parents[2] / "kontronik_can_gw"
SETTINGS: dict[str, dict[str, object]] = {
    "canopen": {"self_start": True, "store": "/nonexistent/store"},
    "dronecan": {"node_id": 42, "per_esc_nodes": True, "extended_hz": 10},
}
ESCS = 2
NO_MESSAGES = MessageLayout("", "", ())
ONE = LiveData(battery_voltage=2400, electrical_speed=42_000, power_stage_temperature=30)
OTHER = LiveData(battery_voltage=1800, electrical_speed=21_000, power_stage_temperature=55)


@pytest.fixture(params=[*OUTPUTS, example_output.NAME])
def name(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the name of an output."""
    if request.param == example_output.NAME:
        example_output.add_to_package(monkeypatch)
    return str(request.param)


def configured(*names: str, quiet_after_s: int = 0) -> CaptureSetup:
    """Return the setup of a gateway that has these outputs and no DBC."""
    tables: dict[str, object] = {
        "can": {"interface": "virtual", "bitrate": 1_000_000, "quiet_after_s": quiet_after_s},
        "dbc": {"enabled": False},
        "esc": [{"port": f"/dev/ttyUSB{number}"} | esc(number) for number in range(ESCS)],
    }
    for name in names:
        tables[name] = {"enabled": True} | SETTINGS.get(name, {})
    setup = setup_of(assemble(parse(tables, "bench.toml")))
    assert [output.name for output in setup.outputs] == list(names)
    return setup


def setup_alone(name: str) -> OutputSetup:
    """Return the output's own setup."""
    (setup,) = configured(name).outputs
    return setup


class SteadyBench:
    """A gateway with one output. Each ESC sends the same telemetry 100 times a second."""

    def __init__(self, name: str, live: LiveData = ONE, quiet_after_s: int = 0) -> None:
        setup = configured(name, quiet_after_s=quiet_after_s)
        settings = CoreSettings(
            setup.escs, NO_MESSAGES, quiet_after_ns=setup.core_numbers["quiet_after_ns"]
        )
        self.gateway = Gateway(settings, START, outputs=setup.outputs)
        self.now = START
        self._live: bytes | None = encode(live, WireLayout.V4)
        self._ticks = 0
        for number in range(ESCS):
            self.gateway.port(number, True, self.now)
        self.gateway.start(self.now)

    def silence(self) -> None:
        """Let the ESCs send nothing more."""
        self._live = None

    def run(self, seconds: float) -> list[CanFrame]:
        """Let time pass. Return the frames sent."""
        found = self.gateway.take_frames(self.now)
        end = self.now + int(seconds * SECOND)
        while self.now < end:
            tick = min(end, self.now + 10 * MS)
            while (due := self.gateway.next_deadline()) < tick:
                self.now = max(due, self.now + 1)
                self.gateway.advance(self.now)
                found += self.gateway.take_frames(self.now)
            self.now = tick
            self._receive()
            self.gateway.advance(self.now)
            found += self.gateway.take_frames(self.now)
        return found

    def _receive(self) -> None:
        if self._live is None:
            return
        self._ticks += 1
        for number in range(ESCS):
            data = self._live
            if self._ticks % 100 == 1:
                data = encode(InfoData(), WireLayout.V4) + data
            self.gateway.receive_bytes(number, data, self.now, self.now)


def bits(frame: CanFrame) -> int:
    """Return the bits of a frame with the most stuffing: ISO 11898-1."""
    fixed, stuffed = (67, 54) if frame.extended else (47, 34)
    length = 8 * len(frame.data)
    return fixed + length + (stuffed + length - 1) // 4


def foreign_ids(frames: Iterable[CanFrame], own: Iterable[int]) -> Iterator[int]:
    """Yield the ids of frames that are neither in ``own`` nor in one of its blocks."""
    ids = set(own)
    for key in {frame.key for frame in frames}:
        if key not in ids and block_of(key, ids) is None:
            yield key


def test_each_folder_with_a_setup_is_an_output() -> None:
    folders = {path.parent.name for path in PACKAGE.glob("*/setup.py")}
    assert folders == set(OUTPUTS), "add the folder's name to OUTPUTS in core/output_setup.py"


def test_header_of_a_capture_gives_an_equal_setup(name: str) -> None:
    setup = configured(name)
    header: dict[str, Any] = json.loads(json.dumps(setup.header()))
    assert CaptureSetup.of(header).outputs == setup.outputs
    assert CaptureSetup.of(header).header() == setup.header()


@pytest.mark.parametrize("quiet_after_s", [0, 1])
def test_replay_is_identical_to_the_run(name: str, quiet_after_s: int) -> None:
    check_replay(configured(name, quiet_after_s=quiet_after_s), seed=0)


@pytest.mark.parametrize("quiet_after_s", [0, 1])
def test_replay_of_all_outputs_together_is_identical(quiet_after_s: int) -> None:
    check_replay(configured(*OUTPUTS, quiet_after_s=quiet_after_s), seed=1)


def check_replay(setup: CaptureSetup, seed: int) -> None:
    """Compare a run with its replay. Ports, interface and requests fail and return at random."""
    bench = Bench(setup, NO_MESSAGES).live(seed, 8)
    assert bench.quiet_turns > 50 or not setup.core_numbers["quiet_after_ns"]
    frames = [frame for frame in replayed(bench) if not frame.received]
    assert frames == bench.sent
    assert len(frames) > 10, "the output sends nothing"


def test_quiet_mode_sends_nothing_and_has_no_deadline(name: str) -> None:
    bench = SteadyBench(name, quiet_after_s=2)
    bench.run(1)
    bench.silence()
    bench.run(3)
    assert bench.gateway.status.is_quiet
    assert bench.run(20) == [], "info data and emergencies have their own timeouts"
    assert bench.gateway.next_deadline() == NEVER, "next_deadline of the output in quiet mode"


def test_nothing_is_sent_while_frames_are_held_and_all_after_it(name: str) -> None:
    bench = SteadyBench(name)
    before = {frame.can_id for frame in bench.run(2)}
    bench.gateway.hold(bench.now)
    assert bench.run(2) == []
    bench.gateway.release(bench.now)
    after = {frame.can_id for frame in bench.run(2)}
    assert after >= before, "end in can_returned what hold begins"


def test_first_frame_after_an_outage_has_no_measurement(name: str) -> None:
    """It is the same for any telemetry, and other frames are not."""
    first = []
    others = []
    for live in (ONE, OTHER):
        bench = SteadyBench(name, live)
        others.append(bench.run(2))
        bench.gateway.hold(bench.now)
        bench.run(1)
        first.append(bench.gateway.first_frame(bench.now))
    assert first[0] is not None, "return a frame from first_frame of the output"
    assert first[0] == first[1], "first_frame of the output has a measurement"
    assert others[0] != others[1]


def test_own_ids_cover_each_frame_that_is_sent(name: str) -> None:
    """They are known to the locks and to the check for other devices, and no message has them."""
    bench = Bench(configured(name), NO_MESSAGES).live(2, 8)
    (output,) = bench.gateway.outputs
    frames = [sent.frame for sent in bench.sent]
    assert len(frames) > 10
    assert list(foreign_ids(frames, output.own_ids())) == [], "add to own_ids of the output"
    assert list(foreign_ids(frames, setup_alone(name).taken_ids())) == [], "add to taken_ids"


def test_traffic_is_close_to_its_estimate(name: str) -> None:
    bench = SteadyBench(name)
    bench.run(2)
    frames = bench.run(20)
    frames_per_s, bits_per_s = setup_alone(name).traffic()
    assert len(frames) / 20 == pytest.approx(frames_per_s, rel=0.1), "traffic of the setup"
    sent_bits_per_s = sum(map(bits, frames)) / 20
    assert sent_bits_per_s == pytest.approx(bits_per_s, rel=0.1), "traffic of the setup"
    worst = setup_alone(name).traffic(is_worst=True)
    assert worst[0] >= frames_per_s
    assert worst[1] >= bits_per_s
