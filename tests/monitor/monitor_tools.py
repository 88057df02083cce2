"""What a bus sees of simulated ESCs: the frames of a real gateway core, with their times. And a screen as text."""

import io
import re
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.text import Text

from kontronik_can_gw.cli.common import assemble
from kontronik_can_gw.cli.status import Line
from kontronik_can_gw.config import parse
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.offline.layouts import BusLayout
from kontronik_can_gw.protocol.states import OperatingError, SelfTestError
from kontronik_can_gw.simulator import FLIGHT, SECOND_NS, ErrorWindow, EscOptions, Faults, SimulatedEsc
from kontronik_can_gw.sources import GatewayState

STEP_NS = 10_000_000
FLYING = tuple(phase._replace(duration_s=phase.duration_s * 0.4, ramp_s=phase.ramp_s * 0.4) for phase in FLIGHT)
Timed = list[tuple[int, CanFrame]]


def layout_of(names: Sequence[str]) -> BusLayout:
    """The shipped DBC for these ESCs."""
    escs = [{"port": f"/dev/tty{name}", "name": name, "pole_pairs": 7, "gear": 9.8} for name in names]
    loaded = assemble(parse({"can": {"bitrate": 1_000_000}, "esc": escs}, "test.toml"))
    assert loaded.database is not None
    return BusLayout(loaded.database, loaded.layout, loaded.escs, loaded.config)


def flight(
    bus: BusLayout, seconds: float, options: Sequence[EscOptions] = (), *, replay: bool = False, until: float = 1e9
) -> Timed:
    """What the gateway sends while ESCs fly. ``until``: from then on (s) all lines are silent."""
    given = [*options, *[EscOptions(profile=FLYING)] * (len(bus.escs) - len(options))]
    simulated = [SimulatedEsc(each, seed=index) for index, each in enumerate(given)]
    gateway = Gateway(bus.escs, bus.layout, 0)
    for index in range(len(simulated)):
        gateway.port_opened(index, 0)
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
        frames += [(now, frame) for frame in gateway.take_frames()]
    return frames


def with_errors(*bits: OperatingError | SelfTestError) -> EscOptions:
    """An ESC that has these bits set all the time."""
    return EscOptions(profile=FLYING, faults=Faults(errors=tuple(ErrorWindow(bit, 0) for bit in bits)))


def write_log(path: Path, frames: Timed, channel: str = "can0", start_s: float = 1_790_000_000.0) -> Path:
    """A candump log."""
    lines = []
    for now, frame in frames:
        can_id = f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:03X}"
        lines.append(f"({start_s + now / 1e9:.6f}) {channel} {can_id}#{frame.data.hex().upper()}\n")
    path.write_text("".join(lines))
    return path


def as_texts(lines: Sequence[Line]) -> list[str]:
    """The words alone."""
    return ["".join(piece.text for piece in line) for line in lines]


def drawn(lines: Sequence[Line], size: tuple[int, int], *, colour: bool = True) -> str:
    """What a terminal is sent for a screen."""
    console = Console(
        file=io.StringIO(), force_terminal=True, width=size[0], height=size[1], no_color=not colour,
        color_system="truecolor", highlight=False, record=True,
    )  # fmt: skip
    for line in lines:
        console.print(Text.assemble(*((p.text, p.style) for p in line), no_wrap=True, overflow="crop", end="\n"))
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def plain(text: str) -> str:
    """Without control sequences."""
    return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", text)
