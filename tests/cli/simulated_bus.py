"""What a bus sees of simulated ESCs: the frames of a real gateway core, with their times; and a clock that tests move."""

from collections.abc import Sequence
from pathlib import Path

from kontronik_can_gw.assembly.assemble import assemble
from kontronik_can_gw.config.parse import parse
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
    """The shipped DBC for these ESCs."""
    escs = [
        {"port": f"/dev/tty{name}", "name": name, "pole_pairs": 7, "gear": 9.8} for name in names
    ]
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
    """What the gateway sends while ESCs fly. ``until``: from then on (s) all lines are silent."""
    given = [*options, *[EscOptions(profile=FLYING)] * (len(bus.escs) - len(options))]
    simulated = [SimulatedEsc(each, seed=index) for index, each in enumerate(given)]
    gateway = Gateway(bus.escs, bus.layout, 0)
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
    """An ESC that has these bits set all the time."""
    return EscOptions(
        profile=FLYING, faults=Faults(errors=tuple(ErrorWindow(bit, 0) for bit in bits))
    )


def write_log(path: Path, frames: Timed, channel: str = "can0", start_s: float = START_S) -> Path:
    """A candump log."""
    lines = []
    for now, frame in frames:
        can_id = f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:03X}"
        lines.append(f"({start_s + now / 1e9:.6f}) {channel} {can_id}#{frame.data.hex().upper()}\n")
    path.write_text("".join(lines))
    return path


class Clock:
    """Time that passes only by being slept; for what takes the module ``time``."""

    def __init__(self, now: float = 100.0) -> None:
        self.now = now

    def monotonic(self) -> float:
        return self.now

    def monotonic_ns(self) -> int:
        return round(self.now * 1e9)

    def sleep(self, seconds: float) -> None:
        assert seconds > 0, "a busy loop"
        self.now += seconds
