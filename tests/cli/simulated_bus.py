"""The frames that a real gateway core sends for simulated ESCs, and a clock set by tests."""

from collections.abc import Sequence
from pathlib import Path

from kontronik_can_gw.assembly.assemble import assemble
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.esc.kontronik.simulator import (
    FLIGHT,
    SECOND_NS,
    ErrorWindow,
    EscOptions,
    Faults,
    SimulatedEsc,
)
from kontronik_can_gw.esc.kontronik.states import OperatingError, SelfTestError
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.status import GatewayState

STEP_NS = 10_000_000
START_S = 1_790_000_000
FLYING = tuple(
    phase._replace(duration_s=phase.duration_s * 0.4, ramp_s=phase.ramp_s * 0.4) for phase in FLIGHT
)
Timed = list[tuple[int, CanFrame]]


def layout_of(names: Sequence[str]) -> BusLayout:
    """Return the layout of the shipped DBC for ESCs of these names."""
    escs = []
    for name in names:
        escs.append({"port": f"/dev/tty{name}", "name": name, "pole_pairs": 7, "gear": 9.8})
    loaded = assemble(parse({"can": {"bitrate": 1_000_000}, "esc": escs}, "test.toml"))
    assert loaded.database is not None
    return BusLayout(loaded.database, loaded.layout, loaded.escs, loaded.config)


def flight(
    bus: BusLayout,
    seconds: float,
    options: Sequence[EscOptions] = (),
    *,
    replay: bool = False,
    until: float = 1e9,
) -> Timed:
    """Return the frames of a gateway with ESCs in flight. All lines are silent after ``until`` (s).

    ESCs without options fly without faults.
    """
    others = len(bus.escs) - len(options)
    given = [*options, *[EscOptions(profile=FLYING)] * others]
    simulated = [SimulatedEsc(each, seed=index) for index, each in enumerate(given)]
    gateway = Gateway(CoreSettings(bus.escs, bus.layout), 0)
    for index in range(len(simulated)):
        gateway.port(index, True, 0)
    gateway.start(0)
    if replay:
        gateway.status.state = GatewayState.REPLAY
    frames: Timed = []
    for now in range(0, round(seconds * SECOND_NS), STEP_NS):
        for index, esc in enumerate(simulated):
            for sent in esc.frames_until(now):
                if now < until * SECOND_NS:
                    gateway.receive_bytes(index, sent.wire, now, now)
        gateway.advance(now)
        frames += [(now, frame) for frame in gateway.take_frames(now)]
    return frames


def with_errors(*bits: OperatingError | SelfTestError) -> EscOptions:
    """Return the options of an ESC that always has these bits set."""
    errors = tuple(ErrorWindow(bit, 0) for bit in bits)
    return EscOptions(profile=FLYING, faults=Faults(errors=errors))


def write_log(
    path: Path,
    frames: Timed,
    channel: str = "can0",
    start_s: float = START_S,
) -> Path:
    """Write a candump log."""
    lines = []
    for now, frame in frames:
        time_s = start_s + now / 1e9
        digits = 8 if frame.extended else 3
        text = f"{frame.can_id:0{digits}X}#{frame.data.hex().upper()}"
        lines.append(f"({time_s:.6f}) {channel} {text}\n")
    path.write_text("".join(lines))
    return path


class Clock:
    """A clock that replaces the module ``time`` and advances only in ``sleep``."""

    def __init__(self, now: float = 100.0) -> None:
        self.now = now

    def monotonic(self) -> float:
        return self.now

    def monotonic_ns(self) -> int:
        return round(self.now * 1e9)

    def sleep(self, seconds: float) -> None:
        assert seconds > 0, "a busy loop"
        self.now += seconds
