"""Random frames against the LSS slave: nothing raises, and only a valid sequence changes anything."""

from typing import Any, cast

from hypothesis import given, settings
from hypothesis import strategies as st
from lss_bench import Identity, Node

from kontronik_can_gw.canopen.lss import LssSlave

SERVICES = bytes((0x04, 0x11, 0x13, 0x15, 0x17, *range(0x40, 0x45), *range(0x46, 0x52), *range(0x5A, 0x5F)))  # fmt: skip


class Oracle:
    """The same slave told another way: it looks back over all that was received."""

    def __init__(self, identity: Identity) -> None:
        self.identity = identity
        self.parts = [number.to_bytes(4, "little") for number in identity]
        self.seen: list[bytes] = []
        self.configuring = False
        self.scan: list[bytes] = []
        """The answered fastscan frames since the last reset of the scan."""

    def _ended(self, first: int, last: int) -> list[bytes] | None:
        """The numbers of the last frames if those are the services ``first`` to ``last``, one after the other."""
        count = last - first + 1
        tail = self.seen[-count:]
        if [frame[0] for frame in tail] != list(range(first, last + 1)):
            return None
        return [frame[1:5] for frame in tail]

    def _identified(self) -> bool:
        numbers = self._ended(0x46, 0x4B)
        if numbers is None or numbers[:2] != self.parts[:2]:
            return False
        low_revision, high_revision, low_serial, high_serial = (
            int.from_bytes(n, "little") for n in numbers[2:]
        )
        return self.identity[2] in range(low_revision, high_revision + 1) and self.identity[
            3
        ] in range(low_serial, high_serial + 1)

    def _scanned(self, frame: bytes) -> bool:
        bit, part, following = frame[5:]
        if part > 3 or following > 3 or not (bit < 32 or bit == 0x80):
            return False
        if bit == 0x80:
            self.scan = [frame]
            return True
        looked_at = (self.scan[-1][7] if len(self.scan) > 1 else 0) if self.scan else None
        bits = f"{int.from_bytes(frame[1:5], 'little'):032b}"[: 32 - bit]
        if part != looked_at or not f"{self.identity[part]:032b}".startswith(bits):
            return False
        self.scan.append(frame)
        return True

    def answer(self, frame: bytes, active: int, pending: int) -> bytes | None:
        """The answer a frame must have, before what it does to the host is done. Savings are answered by nobody here."""
        if len(frame) != 8:
            return None
        self.seen.append(frame)
        service = frame[0]
        if service == 0x04 and frame[1] < 2:
            self.configuring = frame[1] == 1
            self.scan = []
        if service == 0x4B and self._identified():
            return b"\x4f"
        if service == 0x4C and (active, pending) == (255, 255):
            return b"\x50"
        if self.configuring:
            if service == 0x11:
                return bytes((0x11, frame[1] == 0 or 127 < frame[1] < 255))
            if service == 0x13:
                return b"\x13\x01"
            if service in range(0x5A, 0x5E):
                return bytes((service, *self.parts[service - 0x5A]))
            return bytes((service, active)) if service == 0x5E else None
        if service == 0x43 and self._ended(0x40, 0x43) == self.parts:
            self.configuring = True
            self.scan = []
            return b"\x44"
        if service == 0x51 and (active, pending) == (255, 255) and self._scanned(frame):
            if frame[5] == 0 and frame[7] < frame[6]:
                self.configuring = True
                self.scan = []
            return b"\x4f"
        return None


ME: Identity = (5, 0x80000000, 0, 0xFFFFFFFF)
numbers = st.one_of(
    st.sampled_from(ME), st.sampled_from((0, 0xFFFFFFFF)), st.integers(0, 0xFFFFFFFF)
)
small = st.one_of(st.integers(0, 4), st.integers(0, 255))


@st.composite
def sequences(draw: st.DrawFn) -> list[bytes]:
    """Frames of a valid selection, identification or fastscan, perhaps with one number, one frame or the order spoilt."""
    kind = draw(st.sampled_from(("select", "identify", "scan")))
    if kind == "select":
        made = [bytes((0x40 + i, *n.to_bytes(4, "little"), 0, 0, 0)) for i, n in enumerate(ME)]
    elif kind == "identify":
        made = [
            bytes((0x46 + i, *n.to_bytes(4, "little"), 0, 0, 0))
            for i, n in enumerate((ME[0], ME[1], ME[2], ME[2], ME[3], ME[3]))
        ]
    else:
        made = [bytes((0x51, 0, 0, 0, 0, 0x80, 0, 0))]
        for part, number in enumerate(ME):
            for bit in (*draw(st.lists(st.integers(0, 31), max_size=2)), None):
                following = part if bit is not None else (part + 1) % 4
                made.append(bytes((0x51, *number.to_bytes(4, "little"), bit or 0, part, following)))
    spoil = draw(st.sampled_from(("no", "no", "drop", "swap", "number", "bit", "bit", "insert")))
    at = draw(st.integers(0, len(made) - 2))
    if spoil == "drop":
        del made[at]
    elif spoil == "swap":
        made[at], made[at + 1] = made[at + 1], made[at]
    elif spoil == "number":
        made[at] = bytes((made[at][0], *draw(numbers).to_bytes(4, "little"), *made[at][5:]))
    elif spoil == "bit":
        place, mask = draw(st.integers(1, 7)), 1 << draw(st.integers(0, 7))
        made[at] = bytes(byte ^ (mask if i == place else 0) for i, byte in enumerate(made[at]))
    elif spoil == "insert":
        made.insert(at, draw(single))
    return made


single = st.one_of(
    st.builds(
        lambda service, number, tail: bytes((service, *number.to_bytes(4, "little"), *tail)),
        st.sampled_from(SERVICES),
        numbers,
        st.tuples(st.one_of(st.just(0x80), st.integers(0, 33), st.integers(0, 255)), small, small),
    ),
    st.builds(
        lambda service, first: bytes((service, first, 0, 0, 0, 0, 0, 0)),
        st.sampled_from(SERVICES),
        small,
    ),
    st.binary(min_size=8, max_size=8),
    st.binary(max_size=12),
)
traffic = st.lists(st.one_of(sequences(), single.map(lambda frame: [frame])), max_size=30).map(
    lambda parts: [frame for part in parts for frame in part]
)
node_ids = st.sampled_from((1, 127, 255, 255, 255))


@given(traffic, node_ids, node_ids)
@settings(max_examples=150, deadline=None)
def test_any_traffic_has_exactly_the_answers_and_the_state_that_looking_back_gives(
    frames: list[bytes], active: int, pending: int
) -> None:
    node = Node(ME, active, pending)
    answers: list[bytes] = []
    slave = LssSlave(cast(Any, node), answers.append)
    oracle = Oracle(ME)
    for now, frame in enumerate(frames):
        before = oracle.configuring
        expected = oracle.answer(frame, node.active_node_id, node.pending_node_id)
        answers.clear()
        node.asked.clear()
        slave.receive(frame, now)
        assert answers == ([expected.ljust(8, b"\0")] if expected is not None else [])
        assert slave.configuring == oracle.configuring
        asked = []
        if before and not oracle.configuring:
            asked = [("left", now)]
        elif before and expected == b"\x11\0":
            asked = [("configure", frame[1])]
        elif before and len(frame) == 8 and frame[0] == 0x17:
            asked = [("store", node.pending_node_id)]
        assert node.asked == asked
