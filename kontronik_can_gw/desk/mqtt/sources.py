"""Where the frames come from that MQTT publishes: the CAN bus, or a recording in its own time."""

import time
from collections.abc import Generator, Sequence
from typing import NamedTuple

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.desk.recordings.recording import Input
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.frames import CanFrame

TURN_S = 0.02
"""Maximum time between two turns: delay of what is due, and of a signal."""
_REOPEN_S = 1.0


class Turn(NamedTuple):
    """What came until now. ``now`` and the frames' times: nanoseconds of the source's clock; ``problem``: one line, or empty."""

    now: int
    wall_ns: int
    frames: Sequence[tuple[int, CanFrame]] = ()
    problem: str = ""


def from_bus(can: CanConfig, keys: frozenset[int], patient: bool) -> Generator[Turn, None, None]:
    """The frames of a bus, without an end. RunError where it cannot be opened, unless ``patient``: then it is tried again."""
    from kontronik_can_gw.runtime.bus_listener import BusListener

    listener: BusListener | None = None
    try:
        while listener is None:
            try:
                listener = BusListener(can, keys)
            except RunError as error:
                if not patient:
                    raise
                end = time.monotonic() + _REOPEN_S
                while time.monotonic() < end:
                    yield Turn(time.monotonic_ns(), time.time_ns(), (), error.problems[0])
                    time.sleep(TURN_S)
        while True:
            frames = listener.receive(TURN_S)
            now = time.monotonic_ns()
            yield Turn(now, time.time_ns(), [(now, frame) for frame in frames], listener.problem)
    finally:
        if listener is not None:
            listener.close()


def from_recording(recorded: Input) -> Generator[Turn, None, None]:
    """The frames of a recording, each when its time has come. RunError for one without frames."""
    ahead: int | None = None
    for entry in recorded.frames():
        if ahead is None:
            ahead = entry.time_ns - time.monotonic_ns()
        while (now := time.monotonic_ns() + ahead) < entry.time_ns:
            yield Turn(now, _wall_ns(recorded, now))
            time.sleep(min((entry.time_ns - now) / SECOND, TURN_S))
        yield Turn(now, _wall_ns(recorded, now), [(entry.time_ns, entry.frame)])
    if ahead is None:
        raise RunError(f"{recorded.name}: has no frames of the gateway")


def _wall_ns(recorded: Input, now: int) -> int:
    wall = recorded.wall_ns(now)
    return time.time_ns() if wall is None else wall
