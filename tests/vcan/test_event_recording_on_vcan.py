"""Captures around events of a running gateway hold the frames that were on the bus."""

import signal
from pathlib import Path

import pytest
from vcan_tools import GatewayProcess, configuration, feeding, recording, wait_for

from kontronik_can_gw.capture.format import SETTLE_NS
from kontronik_can_gw.desk.recordings.inputs import open_input
from kontronik_can_gw.times import SECOND

pytestmark = pytest.mark.promise("events")

BEFORE_S = 3
FRAMES_BEFORE = 100 * (BEFORE_S + 20)
"""Telemetry frames after which the memory no longer holds the start of the gateway."""
RECORD = """[record]
directory = "{folder}"
on_event = true
before_s = {before_s}
after_s = 1
"""


def settled(capture: Path) -> list[tuple[int, bytes]]:
    """Return the frames that a capture gives once its replay has settled."""
    with open_input(capture) as found:
        frames = [frame for frame in found.frames() if not frame.received]
        assert found.damage == []
    since = frames[0].time_ns + SETTLE_NS + 2 * SECOND
    return [(each.frame.can_id, each.frame.data) for each in frames if each.time_ns >= since]


def test_captures_around_events_have_the_frames_of_the_bus(vcan: str, tmp_path: Path) -> None:
    """The first event is a signal, the second a loss of telemetry."""
    folder = tmp_path / "captures"
    record = RECORD.format(folder=folder, before_s=BEFORE_S)
    with feeding(tmp_path) as ports, recording(vcan) as watch:
        config = tmp_path / "gateway.toml"
        config.write_text(configuration(vcan, ports, record, "telemetry_timeout_ms = 1000"))
        gateway = GatewayProcess(config)
        try:
            gateway.wait_for_line("CAN socketcan")
            ports[0].on = True
            wait_for(lambda: len(ports[0].sent) > FRAMES_BEFORE, "frames before the event")
            assert list(folder.iterdir()) == []
            gateway.process.send_signal(signal.SIGUSR1)
            gateway.wait_for_line("event: signal USR1: recording to")
            more = len(ports[0].sent) + FRAMES_BEFORE
            wait_for(lambda: len(ports[0].sent) > more, "frames before the next event")
            ports[0].on = False
            gateway.wait_for_line("event: esc1: telemetry lost: recording to")
            assert gateway.end() == 0, gateway.log
            watch.wait_for_mark()
        finally:
            gateway.kill()
        bus = [(frame.can_id, frame.data) for frame in watch.recorded]
    captures = sorted(folder.iterdir())
    assert len(captures) == 2
    for capture in captures:
        frames = settled(capture)
        assert len(frames) > 500
        places = range(len(bus) - len(frames) + 1)
        assert any(bus[place : place + len(frames)] == frames for place in places)
