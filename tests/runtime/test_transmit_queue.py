"""Frames that wait to be sent: the queue keeps its order, and in a slot the newest frame wins.

If both have frames left over, queue and slots send in turn.
"""

from collections import Counter
from itertools import pairwise

import pytest
from dbc_bench import compiled
from hypothesis import given, settings
from hypothesis import strategies as st

from kontronik_can_gw.frames import FIRST_PART, CanFrame
from kontronik_can_gw.gateway.transmit_queue import QUEUE_LENGTH, TransmitQueue
from kontronik_can_gw.signals.packer import compile_frame
from kontronik_can_gw.status import GatewayStatus

pytestmark = pytest.mark.promise("newest-wins")


def queued(number: int, can_id: int = 0x581) -> CanFrame:
    return CanFrame(can_id, number.to_bytes(2, "little"), queued=True)


def slot(can_id: int, number: int = 0) -> CanFrame:
    return CanFrame(can_id, number.to_bytes(2, "little"))


def send(queue: TransmitQueue, sent: list[CanFrame], count: int) -> int:
    """Let an interface take at most ``count`` frames. Return the number that it took."""
    frames = queue.in_order()
    taken = frames[:count]
    sent += taken
    queue.remove(frames, len(taken))
    return len(taken)


def test_queue_is_bounded_and_counts_its_losses() -> None:
    queue = TransmitQueue()
    sent = list[CanFrame]()
    for n in range(QUEUE_LENGTH + 10):
        queue.put_all([queued(n)])
    assert len(queue) == QUEUE_LENGTH
    assert queue.counters.dropped_frames == 10
    queue.put_all([slot(0x181)])
    assert len(queue) == QUEUE_LENGTH + 1, "slots are not held by a full queue"
    send(queue, sent, 2)
    queue.put_all([queued(7)])
    queue.clear()
    assert len(queue) == 0
    assert queue.counters.dropped_frames == 10 + QUEUE_LENGTH - 1
    assert queue.counters.replaced_frames == 1
    assert send(queue, sent, 9) == 0


@pytest.mark.promise("order")
def test_frames_of_a_step_keep_their_order_and_leftovers_alternate() -> None:
    queue = TransmitQueue()
    sent = list[CanFrame]()
    step = [queued(1, 0x81), slot(0x18040A2A), queued(2, 0x82), slot(0x181), slot(0x182)]
    queue.put_all(step)
    assert queue.in_order() == step
    queue.put_all([queued(3, 0x83), slot(0x181, 9), slot(0x183)])
    in_order = [*step[:3], slot(0x181, 9), step[4], queued(3, 0x83), slot(0x183)]
    assert queue.in_order() == in_order, "not all were put before the interface was asked"
    assert send(queue, sent, 1) == 1
    queue.put_all([queued(4, 0x84)])
    send(queue, sent, 100)
    expected = [in_order[0], slot(0x18040A2A), queued(2, 0x82), slot(0x181, 9), queued(3, 0x83)]
    assert sent == [*expected, slot(0x182), queued(4, 0x84), slot(0x183)]
    queue.put_all(step)
    assert queue.in_order() == step, "nothing is left over any more"


@given(st.lists(st.one_of(st.none(), st.integers(1, 7)), max_size=60))
def test_sent_transfers_are_complete_and_the_newest(steps: list[int | None]) -> None:
    """A step puts newer transfers of two and three frames, or lets the interface take frames."""
    queue = TransmitQueue()
    sent = list[CanFrame]()
    pages = {0x18040A2A: (64, 65, 66), 0x18040C2A: (67, 68)}
    wanted = 0
    for number, step in enumerate(steps):
        if step is None:
            for can_id, parts in pages.items():
                queue.put_all([CanFrame(can_id, bytes((number,)), True, page=p) for p in parts])
            wanted += 1
        else:
            send(queue, sent, step)
    send(queue, sent, 100)
    for can_id, parts in pages.items():
        found = [(frame.page, frame.data) for frame in sent if frame.can_id == can_id]
        begun = [data for page, data in found if page == parts[0]]
        assert found == [(page, data) for data in begun for page in parts]
        assert begun == sorted(set(begun))
        assert bool(begun) == bool(wanted)


PUTS = st.tuples(st.booleans(), st.integers(0x181, 0x184))
STEPS = st.lists(st.one_of(PUTS, st.integers(0, 6)), max_size=80)


@settings(deadline=None)  # a busy machine must not fail the test
@given(STEPS, st.booleans())
def test_queued_frames_keep_their_order_and_each_slot_sends_its_newest(
    steps: list[tuple[bool, int] | int],
    one_by_one: bool,
) -> None:
    """A step puts a frame, given as (is queued, id), or lets the interface take frames.

    The interface takes the frames at once, or one by one in separate turns.
    """
    queue = TransmitQueue()
    sent = list[CanFrame]()
    put: list[CanFrame] = []
    newest: dict[int, CanFrame] = {}  # the waiting slots
    has_leftovers = False
    for number, step in enumerate(steps):
        if isinstance(step, tuple):
            frame = CanFrame(step[1], number.to_bytes(2, "little"), queued=step[0])
            put.append(frame)
            if not frame.queued:
                newest[frame.can_id] = frame
            queue.put_all([frame])
            continue
        before = len(sent)
        both = has_leftovers and 0 < len(newest) < len(queue)
        for _ in range(step if one_by_one else 1):
            send(queue, sent, 1 if one_by_one else step)
        now_sent = sent[before:]
        for frame in now_sent:
            if not frame.queued:
                assert newest.pop(frame.can_id) == frame, "not the newest of its id"
        has_leftovers = len(queue) > 0
        if both:
            lines = [frame.queued for frame in now_sent]
            shorter = min(Counter(lines).values()) if len(set(lines)) == 2 else 0
            turns = pairwise(lines[: 2 * shorter])
            assert all(a != b for a, b in turns), "no turns while both waited"
    send(queue, sent, 1000)
    assert [f for f in sent if f.queued] == [f for f in put if f.queued]
    slots_put = sum(not f.queued for f in put)
    slots_sent = sum(not f.queued for f in sent)
    assert slots_sent + queue.counters.replaced_frames == slots_put
    assert len(queue) == 0
    assert queue.counters.dropped_frames == 0


def test_pages_of_a_message_are_never_parts_of_a_transfer() -> None:
    """Each of 70 waiting pages is replaced by its newer version separately."""
    numbers = range(FIRST_PART + 6)
    rows = "".join(f' SG_ S{n} m{n} : 8|8@1+ (1,0) [0|0] "" X\n' for n in numbers)
    text = f'VERSION ""\nBU_: G X\nBO_ 256 M: 2 G\n SG_ Page M : 0|8@1+ (1,0) [0|0] "" X\n{rows}'
    bind: dict[str, str | float] = {f"S{n}": n for n in numbers}
    (plan,) = compiled(text, bind=bind).messages
    make = compile_frame(plan)
    queue = TransmitQueue()
    sent = list[CanFrame]()
    queue.put_all([make((), GatewayStatus(), 0, 0, FIRST_PART + 1)])
    queue.put_all([make((), GatewayStatus(), 0, 0, at) for at in numbers])
    send(queue, sent, 100)
    assert sorted(frame.data[0] for frame in sent) == list(numbers)
    assert queue.counters.replaced_frames == 1
