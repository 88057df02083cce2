"""The two lines that wait to be sent: the queue that keeps its order, the slots of which the newest wins, and their turns."""

from collections import Counter
from collections.abc import Callable, Sequence
from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st

from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.transmit_queue import QUEUE_LENGTH, Sent, TransmitQueue


def queued(number: int, can_id: int = 0x581) -> CanFrame:
    return CanFrame(can_id, number.to_bytes(2, "little"), queued=True)


def slot(can_id: int, number: int = 0) -> CanFrame:
    return CanFrame(can_id, number.to_bytes(2, "little"))


Send = Callable[[Sequence[CanFrame]], tuple[int, Sent]]


def taking(sent: list[CanFrame], count: int, then: Sent = Sent.BUSY) -> Send:
    """An interface that takes ``count`` frames and then answers otherwise."""
    end = len(sent) + count

    def send(frames: Sequence[CanFrame]) -> tuple[int, Sent]:
        taken = frames[: end - len(sent)]
        sent.extend(taken)
        return len(taken), Sent.OK if len(taken) == len(frames) else then

    return send


def test_the_turns_go_on_where_a_full_interface_broke_them_off() -> None:
    mailboxes, sent = TransmitQueue(), list[CanFrame]()
    for n in range(6):
        mailboxes.put(queued(n))
    for n in range(6):
        mailboxes.put(slot(0x181 + n))
    while len(mailboxes):
        assert mailboxes.flush(taking(sent, 1))[0] == 1
    assert [frame.queued for frame in sent] == [True, False] * 6


def test_a_refused_frame_stays_first_in_its_line() -> None:
    mailboxes, sent = TransmitQueue(), list[CanFrame]()
    mailboxes.put(queued(0))
    mailboxes.put(slot(0x181, 1))
    for _ in range(3):
        assert mailboxes.flush(taking(sent, 0)) == (0, Sent.BUSY)
    mailboxes.put(queued(1))
    mailboxes.put(slot(0x182, 1))
    mailboxes.put(slot(0x181, 2))
    assert mailboxes.flush(taking(sent, 9)) == (4, Sent.OK)
    assert sent == [queued(0), slot(0x181, 2), queued(1), slot(0x182, 1)]
    assert mailboxes.replaced == 1


def test_the_queue_is_bounded_and_counts_what_it_loses() -> None:
    mailboxes, sent = TransmitQueue(), list[CanFrame]()
    for n in range(QUEUE_LENGTH + 10):
        mailboxes.put(queued(n))
    assert (len(mailboxes), mailboxes.dropped) == (QUEUE_LENGTH, 10)
    mailboxes.put(slot(0x181))
    assert len(mailboxes) == QUEUE_LENGTH + 1, "slots are not held by a full queue"
    mailboxes.flush(taking(sent, 2))
    mailboxes.put(queued(7))
    mailboxes.clear()
    assert (len(mailboxes), mailboxes.dropped, mailboxes.replaced) == (0, 10 + QUEUE_LENGTH, 0)
    assert mailboxes.flush(taking(sent, 9)) == (0, Sent.OK)


def test_each_page_of_a_multiplexed_message_has_its_own_slot() -> None:
    mailboxes, sent = TransmitQueue(), list[CanFrame]()
    for number in range(10):
        mailboxes.put(CanFrame(1, bytes((number,)), page=number % 2))
    mailboxes.flush(taking(sent, 9))
    assert [(frame.page, frame.data) for frame in sent] == [(0, b"\x08"), (1, b"\x09")]


PUTS = st.tuples(st.booleans(), st.integers(0x181, 0x184))
STEPS = st.lists(st.one_of(PUTS, st.integers(0, 6)), max_size=80)


@settings(deadline=None)  # a busy machine is no fault
@given(STEPS)
def test_nothing_queued_is_lost_or_overtaken_and_of_each_slot_the_newest_is_sent(
    steps: list[tuple[bool, int] | int],
) -> None:
    """``steps``: put a (queued?, id) frame, or let the interface take so many frames."""
    mailboxes, sent = TransmitQueue(), list[CanFrame]()
    put: list[CanFrame] = []
    newest: dict[int, CanFrame] = {}  # slots that wait
    for number, step in enumerate(steps):
        if isinstance(step, tuple):
            frame = CanFrame(step[1], number.to_bytes(2, "little"), queued=step[0])
            put.append(frame)
            if not frame.queued:
                newest[frame.can_id] = frame
            mailboxes.put(frame)
            continue
        before, both = len(sent), 0 < len(newest) < len(mailboxes)
        mailboxes.flush(taking(sent, step))
        now_sent = sent[before:]
        for frame in now_sent:
            if not frame.queued:
                assert newest.pop(frame.can_id) == frame, "not the newest of its id"
        if both:
            lines = [frame.queued for frame in now_sent]
            shorter = min(Counter(lines).values()) if len(set(lines)) == 2 else 0
            assert all(a != b for a, b in pairwise(lines[: 2 * shorter])), (
                "no turns while both waited"
            )
    mailboxes.flush(taking(sent, 1000))
    assert [f for f in sent if f.queued] == [f for f in put if f.queued]
    slots_put, slots_sent = sum(not f.queued for f in put), sum(not f.queued for f in sent)
    assert slots_sent + mailboxes.replaced == slots_put
    assert (len(mailboxes), mailboxes.dropped) == (0, 0)
