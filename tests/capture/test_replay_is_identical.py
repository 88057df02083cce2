"""A replay gives the frames of the live gateway with the same bytes and times."""

from pathlib import Path

import pytest
from capture_bench import START, Bench, made

from kontronik_can_gw.assembly.capture_setup import CaptureSetup
from kontronik_can_gw.capture.format import (
    SETTLE_NS,
    VERSION,
    Block,
    Entry,
    EntryKind,
    Scanner,
    block,
    data_payload,
    json_payload,
    read_entries,
    read_json,
)
from kontronik_can_gw.capture.recorded_gateway import state_of
from kontronik_can_gw.desk.recordings.inputs import open_input
from kontronik_can_gw.desk.recordings.replay import Replay, TimedFrame
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.times import SECOND

pytestmark = pytest.mark.promise("replay")

GATEWAY_STATUS = 0x6D8
WITH_LOSSES = range(0x680, 0x688)
"""The messages with LinkLosses, one for each ESC."""
CAPTURES = Path(__file__).resolve().parents[1] / "golden" / "captures"
OF_0_5_0 = sorted(CAPTURES.glob("wild*.kcap"))


def replayed(bench: Bench, marked: bool = False) -> list[TimedFrame]:
    """Replay a recording from the bytes of a capture, with a gateway made from its header."""
    data = block(b"H", 0, json_payload(bench.setup.header()))
    for number, at in enumerate(range(0, len(bench.entries), 500)):
        data += block(b"D", number + 1, data_payload(bench.entries[at : at + 500]))
    scanner = Scanner()
    found = [*scanner.feed(data), *scanner.flush()]
    assert all(isinstance(b, Block) for b in found)
    blocks = [b for b in found if isinstance(b, Block)]
    setup = CaptureSetup.of(read_json(blocks[0].payload))
    made_again = setup.database()
    layout = MessageLayout("", "", ()) if made_again is None else made_again[1]
    replay = Replay(setup.gateway(layout, START), None, marked)
    entries: list[Entry] = []
    for b in blocks[1:]:
        entries += read_entries(b.payload)
    frames = list(replay.follow(entries))
    assert replay.lost == 0
    assert replay.rejected == 0
    return frames


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    ("escs", "canopen", "on_loss"),
    [(2, False, "silent"), (1, True, "not_available"), (3, True, "not_available")],
)
def test_frames_and_times_of_a_replay_equal_the_live_ones(
    seed: int,
    escs: int,
    canopen: bool,
    on_loss: str,
) -> None:
    bench = Bench(*made(escs, canopen, on_loss=on_loss)).live(seed, 8)
    frames = replayed(bench)
    assert len(bench.sent) > 500
    assert [frame for frame in frames if not frame.received] == bench.sent
    received = sum(entry.kind == EntryKind.FRAME for entry in bench.entries)
    assert sum(frame.received for frame in frames) == received
    assert received > 3


def test_replay_is_quiet_at_the_same_times_as_the_live_gateway() -> None:
    bench = Bench(*made(2, quiet_after_s=1)).live(1, 12)
    assert bench.quiet_turns > 50
    frames = replayed(bench)
    assert [frame for frame in frames if not frame.received] == bench.sent


def test_replay_that_begins_in_quiet_mode_is_quiet_at_once() -> None:
    """The file before it is missing, so only the state in the header has the time."""
    bench = Bench(*made(2, quiet_after_s=1))
    run = bench.running(1, wild=False)
    now = run(3.5)
    assert bench.gateway.status.is_quiet
    state = state_of(bench.gateway)
    bench.entries.clear()
    bench.sent.clear()
    run(2)
    found = bench.setup.database()
    assert found is not None
    frames = list(Replay(bench.setup.gateway(found[1], now), state).follow(bench.entries))
    telemetry = next(sent.time_ns for sent in bench.sent)
    before = [each.frame.can_id for each in frames if each.time_ns < telemetry]
    assert before == [GATEWAY_STATUS]
    assert {each.frame.can_id for each in frames} == {each.frame.can_id for each in bench.sent}


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("is_wild", [False, True])
def test_messages_of_a_later_part_alone_are_exact_once_it_has_settled(
    seed: int,
    is_wild: bool,
) -> None:
    """The recorder writes the state every two seconds. A disturbed stream takes longer."""
    bench = Bench(*made(2))
    run = bench.running(seed, wild=is_wild)
    begin = now = run(7.3)
    first_entry = len(bench.entries)
    first_frame = len(bench.sent)
    state = state_of(bench.gateway)
    for _ in range(12):
        data = json_payload(state_of(bench.gateway))
        bench.entries.append(Entry(now, EntryKind.STATE, data=data))
        now = run(2)
    replay = Replay(bench.setup.gateway(bench.layout, START), state)
    frames = list(replay.follow(bench.entries[first_entry:]))
    assert replay.rejected == 0
    settled = begin + SETTLE_NS + (10 if is_wild else 2) * SECOND
    live = [frame for frame in bench.sent[first_frame:] if frame.time_ns >= settled]
    assert len(live) > 300
    found = [frame for frame in frames if frame.time_ns >= settled and not frame.received]
    assert found == live


def test_frames_that_waited_when_the_state_was_noted_count_as_sent() -> None:
    """The socket takes six frames at once. The others of an iteration are sent after the state."""
    bench = Bench(*made(1))
    run = bench.running(1, wild=False)
    now = run(3)
    gateway = bench.gateway
    state = state_of(gateway)
    first_entry = len(bench.entries)
    for _ in range(12):
        now += SECOND
        gateway.advance(now)
        frames = gateway.take_frames(now)
        assert len(frames) > 6
        gateway.status.sent_frames += 6
        data = json_payload(state_of(gateway))
        bench.entries.append(Entry(now, EntryKind.STATE, data=data))
        gateway.status.sent_frames += len(frames) - 6
    later = bench.setup.gateway(bench.layout, START)
    replay = Replay(later, state)
    list(replay.follow(bench.entries[first_entry:]))
    assert replay.rejected == 0
    assert later.status.sent_frames == gateway.status.sent_frames


def test_marked_replay_differs_only_in_the_state() -> None:
    bench = Bench(*made(1)).live(3, 4, wild=False)
    found = bench.setup.database()
    assert found is not None
    database, _ = found
    differing: set[str] = set()
    states: list[object] = []
    marked = replayed(bench, marked=True)
    for one, other in zip(bench.sent, marked, strict=True):
        message = database.get_message_by_frame_id(one.frame.can_id)
        if any(signal.name == "GatewayState" for signal in message.signals):
            states.append(str(message.decode_simple(other.frame.data)["GatewayState"]))
        if one != other:
            assert one.time_ns == other.time_ns
            a = message.decode_simple(one.frame.data)
            b = message.decode_simple(other.frame.data)
            differing |= {name for name in a if a[name] != b[name]}
    assert differing == {"GatewayState"}
    assert states[-1] == "Stopping"
    assert set(states[:-1]) == {"Replay"}


def _copy_in_version_2(old: Path, new: Path) -> None:
    """Write the entries of a capture of 0.5.0 as the current version writes them."""
    scanner = Scanner()
    found = [*scanner.feed(old.read_bytes()), *scanner.flush()]
    written = []
    for part in found:
        assert isinstance(part, Block)
        payload = part.payload
        if part.kind == b"H":
            header = read_json(payload)
            assert header["version"] == 1
            payload = json_payload(header | {"version": VERSION})
        elif part.kind == b"D":
            entries = read_entries(payload, version=1)
            payload = data_payload(entry._replace(came_ns=entry.time_ns) for entry in entries)
        written.append(block(part.kind, part.number, payload))
    new.write_bytes(b"".join(written))


@pytest.mark.parametrize("path", OF_0_5_0, ids=lambda path: path.stem)
def test_capture_of_0_5_0_is_replayed_in_the_current_order(path: Path, tmp_path: Path) -> None:
    """Only version 2 counts a lost port as a loss of telemetry."""
    _copy_in_version_2(path, tmp_path / "new.kcap")
    with open_input(path) as old, open_input(tmp_path / "new.kcap") as new:
        frames = list(old.frames())
        current = list(new.frames())
    assert len(frames) > 500
    of_both = []
    for each in (frames, current):
        of_both.append([timed for timed in each if timed.frame.can_id not in WITH_LOSSES])
    assert of_both[0] == of_both[1]
    assert frames != current, "each of these captures has a lost port"
    messages = [each for each in frames if not (each.received or each.frame.queued)]
    in_steps = [(each.time_ns, each.frame.key, each.frame.page) for each in messages]
    assert len(in_steps) == len(set(in_steps)), "a message is sent once in a step"
