"""The SDO server under random traffic, against a model, a client of our own that loses segments, and ``canopen``'s client."""

import random
from binascii import crc_hqx
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import cycle, pairwise
from typing import Any, NamedTuple

import canopen
import pytest
from canopen.objectdictionary import ObjectDictionary
from canopen.sdo.exceptions import SdoAbortedError
from hypothesis import example, given, settings
from hypothesis import strategies as st
from script import MS
from sdo_bench import Bench, Dictionary, usual_entries
from sdo_client import Refused, answer_to, download, upload, uploaded
from wire import Wire

from kontronik_can_gw.canopen.abort import Abort, SdoAbort
from kontronik_can_gw.output import NEVER

# ---- a model


class Model:
    """What the standard lets a client expect: for each answer its abort code, or None for an ordinary one.

    It follows the data too, so that after any traffic the same writes must have been made.
    """

    def __init__(self) -> None:
        self.objects = Dictionary()
        self.phase = "idle"
        self.deadline = 0
        self.where = (0, 0)
        self.chunks: list[bytes] = []
        self.indicated: int | None = None
        self.longest = 0
        self.toggle = 0
        self.left = 0  # upload: segments that are still to come
        self.with_crc = False
        self.counted = 0  # block: segments accepted, or sent, in this sub-block
        self.block_size = 0
        self.stray = 0  # number of the next segment that may still be under way
        self.stray_until = 0

    def wait(self, now: int) -> list[int | None]:
        if self.phase in ("idle", "late") or now < self.deadline:
            return []
        self.phase = "idle"
        return [Abort.TIMEOUT]

    def hear(self, data: bytes, now: int) -> list[int | None]:
        if len(data) != 8:
            return []
        try:
            answers = (
                self.block_segment(data, now)
                if self.phase == "block down"
                else self.other(data, now)
            )
        except SdoAbort as abort:
            self.phase = "idle"
            answers = [abort.code]
        self.deadline = now + 2000 * MS
        return answers

    def confirm(self, code: Abort | None) -> list[int | None]:
        if self.phase != "late":
            return []
        self.phase = "idle"
        return [code]

    def other(self, data: bytes, now: int) -> list[int | None]:
        byte = data[0]
        if self.stray:
            if byte % 128 == self.stray and now <= self.stray_until:
                self.stray = 0 if byte >= 128 or self.stray == 127 else self.stray + 1
                self.stray_until = now + 50 * MS
                return []
            self.stray = 0
        name = (
            ("down segment",) * 32
            + ("down",) * 32
            + ("up",) * 32
            + ("up segment",) * 32
            + ("abort",) * 32
            + ("block up", "block up end", "block up ack", "block up start") * 8
            + ("block down", "block down end") * 16
            + ("nothing",) * 32
        )[byte]
        if name in ("down", "up", "block up", "block down"):
            self.phase = "idle"
            self.where = (data[1] + 256 * data[2], data[3])
            return getattr(self, "start_" + name.replace(" ", "_"))(data, now)  # type: ignore[no-any-return]
        if name == "abort":
            self.phase = "idle"
            return []
        if name != self.phase:
            raise SdoAbort(Abort.COMMAND)
        return getattr(self, "go_on_" + name.replace(" ", "_"))(data, now)  # type: ignore[no-any-return]

    def begin_down(self, size: int | None) -> None:
        most = self.objects.check_download(*self.where, size)
        self.indicated, self.longest = size, most if size is None else size
        self.chunks = []

    def finish_down(self, data: bytes, now: int) -> list[int | None]:
        if self.objects.download(*self.where, data, now):
            self.phase = "idle"
            return [None]
        self.phase = "late"
        return []

    def begin_up(self, length: int) -> list[int | None]:
        if not 1 <= length <= 4:
            self.phase, self.toggle, self.left = "up segment", 0, max(1, (length + 6) // 7)
        return [None]

    def start_down(self, data: bytes, now: int) -> list[int | None]:
        if data[0] & 2:
            unused = data[0] // 4 % 4
            self.begin_down(4 - unused if data[0] & 1 else None)
            length = min(4, self.longest)
            return self.finish_down(data[4 : 4 + length], now)
        self.begin_down(int.from_bytes(data[4:], "little") if data[0] & 1 else None)
        self.phase, self.toggle = "down segment", 0
        return [None]

    def go_on_down_segment(self, data: bytes, now: int) -> list[int | None]:
        if data[0] // 16 % 2 != self.toggle:
            raise SdoAbort(Abort.TOGGLE)
        self.toggle = 1 - self.toggle
        self.chunks.append(data[1 : 8 - data[0] // 2 % 8])
        everything = b"".join(self.chunks)
        if len(everything) > self.longest:
            raise SdoAbort(Abort.TOO_LONG)
        if data[0] % 2 == 0:
            return [None]
        if self.indicated is not None and len(everything) < self.indicated:
            raise SdoAbort(Abort.TOO_SHORT)
        return self.finish_down(everything, now)

    def start_up(self, data: bytes, now: int) -> list[int | None]:
        return self.begin_up(len(self.objects.upload(*self.where, now)))

    def go_on_up_segment(self, data: bytes, now: int) -> list[int | None]:
        if data[0] // 16 % 2 != self.toggle:
            raise SdoAbort(Abort.TOGGLE)
        self.toggle = 1 - self.toggle
        self.left -= 1
        if not self.left:
            self.phase = "idle"
        return [None]

    def start_block_down(self, data: bytes, now: int) -> list[int | None]:
        self.begin_down(int.from_bytes(data[4:], "little") if data[0] & 2 else None)
        self.with_crc = bool(data[0] & 4)
        self.counted = 0
        self.phase = "block down"
        return [None]

    def block_segment(self, data: bytes, now: int) -> list[int | None]:
        number, last = data[0] % 128, data[0] >= 128
        if data[0] == 128:
            self.phase = "idle"
            return []
        self.stray, self.stray_until = (number + 1) % 128, now + 50 * MS  # should this one end it
        if number == 0:
            raise SdoAbort(Abort.SEQUENCE)
        fits = number == self.counted + 1
        if fits:
            self.counted = number
            self.chunks.append(data[1:])
            if not last and 7 * len(self.chunks) > self.longest:
                raise SdoAbort(Abort.TOO_LONG)
        self.stray = 0
        if last or number == 127:
            self.counted = 0
            if fits and last:
                self.phase = "block down end"
            return [None]
        return []

    def go_on_block_down_end(self, data: bytes, now: int) -> list[int | None]:
        everything = b"".join(self.chunks)
        everything = everything[: len(everything) - data[0] // 4 % 8]
        if len(everything) > self.longest:
            raise SdoAbort(Abort.TOO_LONG)
        if self.indicated is not None and len(everything) < self.indicated:
            raise SdoAbort(Abort.TOO_SHORT)
        if self.with_crc and crc_hqx(everything, 0) != data[1] + 256 * data[2]:
            raise SdoAbort(Abort.CRC)
        return self.finish_down(everything, now)

    def start_block_up(self, data: bytes, now: int) -> list[int | None]:
        if not 0 < data[4] < 128:
            raise SdoAbort(Abort.BLOCK_SIZE)
        length = len(self.objects.upload(*self.where, now))
        if 1 <= data[5] >= length:
            return self.begin_up(length)
        self.left, self.block_size = max(1, (length + 6) // 7), data[4]
        self.phase = "block up start"
        return [None]

    def go_on_block_up_start(self, data: bytes, now: int) -> list[int | None]:
        self.phase = "block up ack"
        self.counted = min(self.block_size, self.left)
        return [None] * self.counted

    def go_on_block_up_ack(self, data: bytes, now: int) -> list[int | None]:
        if data[1] > self.counted:
            raise SdoAbort(Abort.SEQUENCE)
        if not 0 < data[2] < 128:
            raise SdoAbort(Abort.BLOCK_SIZE)
        self.left -= data[1]
        if self.left == 0:
            self.phase = "block up end"
            return [None]
        self.counted = min(data[2], self.left)
        return [None] * self.counted

    def go_on_block_up_end(self, data: bytes, now: int) -> list[int | None]:
        self.phase = "idle"
        return []

    def fitting(self, raw: bytes) -> bytes:
        """A request that goes with the phase, as ``raw`` (8 bytes or more) decides."""
        pick, low = raw[0], raw[1]
        if self.phase == "idle" and self.stray:
            return bytes((self.stray | (pick & 0x80),)) + raw[1:8]
        if self.phase == "down segment":
            return bytes(((self.toggle ^ (low % 16 == 15)) << 4 | pick & 0x0F,)) + raw[1:8]
        if self.phase == "up segment":
            return bytes((0x60 | self.toggle << 4,)) + bytes(7)
        if self.phase == "block down":
            number = 0 if low % 16 == 15 else min(127, self.counted + 1 + (low % 8 == 7))
            return bytes((number | (pick & 0x80),)) + raw[1:8]
        if self.phase == "block down end":
            everything = b"".join(self.chunks)
            # the n that makes it fit, more often than not
            unused = (len(everything) - self.longest) % 8 if pick & 3 else pick >> 5
            crc = crc_hqx(everything[: len(everything) - unused], 0) ^ (low % 8 == 7)
            return bytes((0xC1 | unused << 2,)) + crc.to_bytes(2, "little") + bytes(5)
        if self.phase == "block up start":
            return b"\xa3" + bytes(7)
        if self.phase == "block up ack":
            return bytes(
                (0xA2, max(0, self.counted + (1, 0, 0, 0, 0, -1, -1, -2)[pick % 8]), 1 + low % 5)
            ) + bytes(5)
        if self.phase == "block up end":
            return b"\xa1" + bytes(7)
        (index, sub), command = PLACES[pick % len(PLACES)], INITIATES[low % len(INITIATES)]
        size = bytes((raw[2] % 12, raw[3] % 4 if command & 0xE0 == 0xA0 else 0, 0, 0))
        if command & 0xE0 == 0xA0 and raw[2] % 4 == 0:
            size = b"\x7f" + size[1:]
        return bytes((command,)) + index.to_bytes(2, "little") + bytes((sub,)) + size


PLACES = [
    *usual_entries(), (0x1000, 7), (0x3000, 0), (0x2003, 0), (0x2003, 0), (0x2004, 0), (0x2005, 0),
]  # fmt: skip
INITIATES = bytes.fromhex("40 21 20 23 27 2B 2F 22 A0 A4 A4 C0 C2 C4 C6 C6")
GAPS = (0, 0, 0, 1 * MS, 30 * MS, 60 * MS, 1990 * MS, 2000 * MS, 5000 * MS)


class Step(NamedTuple):
    """``how`` below 10 of 16: a fitting request; then any eight bytes, any bytes, any command to a known object, confirm."""

    how: int
    raw: bytes
    gap: int


STEPS = st.lists(
    st.builds(Step, st.integers(0, 15), st.binary(min_size=8, max_size=8), st.sampled_from(GAPS)),
    max_size=40,
)


def code_of(answer: bytes) -> int | None:
    return int.from_bytes(answer[4:8], "little") if answer[0] == 0x80 else None


@settings(max_examples=600, deadline=None)
@given(STEPS)
def test_random_traffic_gets_the_answers_of_the_model_and_never_an_exception(
    steps: list[Step],
) -> None:
    bench, model = Bench(), Model()
    for how, raw, gap in steps:
        bench.answers = []
        now = bench.now + gap
        expected = model.wait(now)
        if raw[7] % 4:
            bench.pass_time(now)
            assert [code_of(answer) for answer in bench.answers] == expected
            expected = []
        bench.now = now
        if how == 15 or (model.phase == "late" and how < 5):
            code = Abort.HARDWARE if raw[0] % 2 else None
            bench.answers = []
            bench.server.confirm(code)
            assert [code_of(answer) for answer in bench.answers] == model.confirm(code)
            bench.server.advance(now)
            continue
        if how < 10:
            data = model.fitting(raw)
        elif how < 12:
            data = raw
        elif how < 13:
            data = raw[: raw[0] % 9] * (1 + raw[1] % 2)
        else:
            index, sub = PLACES[raw[1] % len(PLACES)]
            data = bytes((raw[0],)) + index.to_bytes(2, "little") + bytes((sub,)) + raw[4:]
        answers = bench.request(data)
        assert [code_of(answer) for answer in answers] == (
            expected if len(data) == 8 else []
        ) + model.hear(data, now)
        bench.server.advance(now)  # after a frame that was none the time-out may still be due
        assert bench.server.busy == (model.phase != "idle")
        assert (bench.server.due == NEVER) == (model.phase in ("idle", "late"))
        assert bench.objects.written == model.objects.written


# ---- a client


class Client:
    """A client of block transfers with 2003h.

    ``lose``: asked before each block segment, in either direction, whether it gets lost. ``pauses``: before each request, ns.
    """

    multiplexer = b"\x03\x20\0"

    def __init__(
        self, bench: Bench, lose: Callable[[], bool] = lambda: False, pauses: Sequence[int] = (MS,)
    ) -> None:
        self.bench = bench
        self.lose = lose
        self._pauses = cycle(pauses)
        self.bursts: Counter[int] = Counter()
        """How many segments of uploads came when."""

    def answer(self, request: bytes) -> bytes:
        self.bench.now += next(self._pauses)
        (answer,) = self.bench.request(request)
        return answer

    def ask(self, request: bytes) -> bytes:
        return answer_to(self.answer, request)

    def block_download(self, data: bytes, tell_size: bool, with_crc: bool) -> int:
        """Returns how many sub-blocks it took."""
        size = len(data).to_bytes(4, "little") if tell_size else bytes(4)
        answer = self.ask(bytes((0xC0 | with_crc << 2 | tell_size << 1,)) + self.multiplexer + size)
        assert answer[:4] == b"\xa4" + self.multiplexer
        block_size, done, rounds = answer[4], 0, 0
        parts = [data[at : at + 7] for at in range(0, len(data), 7)] or [b""]
        while done < len(parts):
            rounds += 1
            block = parts[done : done + block_size]
            received, whole = 0, True
            for number, part in enumerate(block[:-1], 1):
                if self.lose():
                    whole = False
                    continue
                received += whole
                for answer in self.bench.request(bytes((number,)) + part):
                    raise Refused(answer)
            # the segment that closes a sub-block has to arrive: without it there is no acknowledgement
            end = done + len(block) == len(parts)
            answer = self.ask(bytes((len(block) | end << 7,)) + block[-1].ljust(7, b"\xee"))
            assert answer[0] == 0xA2 and answer[1] == received + whole and not any(answer[3:])
            done += answer[1]
            block_size = answer[2]
        unused = 7 - len(parts[-1])
        crc = crc_hqx(data, 0).to_bytes(2, "little") if with_crc else b"\0\0"
        assert self.ask(bytes((0xC1 | unused << 2,)) + crc) == b"\xa1" + bytes(7)
        return rounds

    def sub_block(self, request: bytes, block_size: int) -> list[bytes]:
        """The segments that follow a request, paced or not."""
        self.bench.now += next(self._pauses)
        frames = list(self.bench.request(request.ljust(8, b"\0")))
        self.bursts[self.bench.now] += len(frames)
        while len(frames) < block_size and all(frame[0] < 0x80 for frame in frames):
            due = self.bench.server.due
            self.bench.answers = []
            self.bench.pass_time(due)
            self.bursts[due] += len(self.bench.answers)
            frames += self.bench.answers
        return frames

    def block_upload(self, block_sizes: Sequence[int], with_crc: bool, threshold: int = 0) -> bytes:
        turn = 0
        answer = self.ask(
            bytes((0xA0 | with_crc << 2,)) + self.multiplexer + bytes((block_sizes[0], threshold)),
        )
        assert answer[1:4] == self.multiplexer
        if answer[0] & 0xE0 == 0x40:
            return uploaded(self.answer, answer)
        assert answer[0] == 0xC6
        size = int.from_bytes(answer[4:], "little")
        data, over = b"", False
        request = b"\xa3"
        while not over:
            block_size = block_sizes[turn % len(block_sizes)]
            turn += 1
            frames = self.sub_block(request, block_size)
            assert 1 <= len(frames) <= block_size
            assert [frame[0] & 0x7F for frame in frames] == list(range(1, len(frames) + 1))
            assert all(frame[0] < 0x80 for frame in frames[:-1])
            got = 0
            for frame in frames:
                if self.lose() or frame[0] & 0x7F != got + 1:
                    continue
                got += 1
                data += frame[1:]
                over = frame[0] >= 0x80
            request = bytes((0xA2, got, block_sizes[turn % len(block_sizes)]))
        answer = self.ask(request)
        assert answer[0] & 0xE3 == 0xC1
        data = data[: len(data) - (answer[0] >> 2 & 7)]
        assert len(data) == size
        assert int.from_bytes(answer[1:3], "little") == (crc_hqx(data, 0) if with_crc else 0)
        assert self.bench.request(b"\xa1" + bytes(7)) == []
        return data


SIZES = st.one_of(
    st.integers(0, 40),
    st.sampled_from([126, 127, 7 * 126, 7 * 127 - 1, 7 * 127, 7 * 127 + 1, 7 * 128, 7 * 254]),
    st.integers(0, 2000),
)
DATA = st.builds(
    lambda size, seed: random.Random(seed).randbytes(size), SIZES, st.integers(0, 2**32)
)


def losing(seed: int, percent: int) -> Callable[[], bool]:
    chance = random.Random(seed)
    return lambda: chance.randrange(100) < percent


@settings(max_examples=150, deadline=None)
@given(
    DATA,
    st.lists(st.integers(1, 127), min_size=1, max_size=4),
    st.booleans(),
    st.booleans(),
    st.integers(0, 2**32),
    st.sampled_from([0, 1, 10, 50]),
    st.sampled_from([0, 0, 3, 4, 20, 255]),
)
@example(b"", [1], True, True, 0, 0, 255)
def test_blocks_carry_any_data_both_ways_though_segments_get_lost(
    data: bytes,
    block_sizes: list[int],
    tell_size: bool,
    with_crc: bool,
    seed: int,
    percent: int,
    threshold: int,
) -> None:
    bench = Bench()
    client = Client(bench, losing(seed, percent))
    client.block_download(data, tell_size, with_crc)
    assert bench.objects.written == [(0x2003, 0, data)]
    assert not bench.server.busy
    assert client.block_upload(block_sizes, with_crc, threshold) == data
    assert not bench.server.busy


def test_sixty_thousand_bytes_go_both_ways() -> None:
    """As the stored EDS is read (1021h)."""
    data = random.Random(1).randbytes(60_000)
    bench = Bench()
    client = Client(bench)
    assert client.block_download(data, tell_size=True, with_crc=True) == -(-60_000 // 889)
    assert client.block_upload([127], with_crc=True) == data
    assert upload(client.answer, 0x2003, 0) == data


@pytest.mark.parametrize("in_blocks", [True, False])
def test_a_download_to_the_largest_object_ends_at_64_kib(in_blocks: bool) -> None:
    def write(client: Client, data: bytes) -> None:
        if in_blocks:
            client.block_download(data, tell_size=False, with_crc=False)
        else:
            download(client.answer, 0x2003, 0, data, tell_size=False)

    bench = Bench()
    write(Client(bench), bytes(65536))
    assert bench.objects.written == [(0x2003, 0, bytes(65536))]
    with pytest.raises(Refused) as caught:
        write(Client(bench), bytes(65537))
    assert caught.value.code == Abort.TOO_LONG


@settings(max_examples=100, deadline=None)
@given(
    DATA,
    st.lists(st.integers(1, 127), min_size=1, max_size=5),
    st.lists(st.integers(0, 20 * MS), min_size=1, max_size=5),
    st.integers(1, MS),
)
def test_paced_segments_keep_their_distance_and_carry_the_data(
    data: bytes, block_sizes: list[int], pauses: list[int], segment_ns: int
) -> None:
    bench = Bench(segment_ns)
    bench.objects.entries[0x2003, 0].value = data
    client = Client(bench, pauses=pauses)
    assert client.block_upload(block_sizes, with_crc=True) == data
    times = [(time, count) for time, count in client.bursts.items() if count]
    assert all(count <= 4 for _, count in times)
    assert all(after - time >= count * segment_ns for (time, count), (after, _) in pairwise(times))


# ---- the client of canopen


def master(bench: Bench, lose: Callable[[bytes], bool] = lambda data: False) -> Any:
    """The SDO client of a node whose other end is the server."""

    def exchange(cob_id: int, data: bytes, remote: bool) -> list[tuple[int, bytes]]:
        assert cob_id == 0x601 and not remote
        if lose(data):
            return []
        bench.now += MS
        answers = list(bench.request(data))
        while (due := bench.server.due) < bench.now + 1000 * MS:
            bench.answers = []
            bench.pass_time(due)
            answers += bench.answers
        return [(0x581, answer) for answer in answers]

    node = canopen.RemoteNode(1, ObjectDictionary())  # type: ignore[no-untyped-call]
    Wire(exchange).add_node(node)
    return node.sdo


CANOPEN_SIZES = [1, 2, 3, 4, 5, 7, 8, 14, 100, 7 * 127 - 1, 7 * 127, 7 * 127 + 1, 5000]


@pytest.mark.parametrize("size", CANOPEN_SIZES)
def test_canopen_transfers_expedited_and_segmented(size: int) -> None:
    data = random.Random(size).randbytes(size)
    bench = Bench()
    sdo = master(bench)
    sdo.download(0x2003, 0, data)
    assert bench.objects.written == [(0x2003, 0, data)]
    assert sdo.upload(0x2003, 0) == data
    sdo.download(0x2003, 0, data[::-1], force_segment=True)
    assert sdo.upload(0x2003, 0) == data[::-1]
    assert not bench.server.busy


def test_canopen_uploads_no_bytes() -> None:
    assert master(Bench()).upload(0x2001, 0) == b""


@pytest.mark.parametrize("segment_ns", [0, MS // 2])
@pytest.mark.parametrize("with_crc", [True, False])
@pytest.mark.parametrize("size", CANOPEN_SIZES)
def test_canopen_transfers_blocks(size: int, with_crc: bool, segment_ns: int) -> None:
    data = random.Random(size).randbytes(size)
    bench = Bench(segment_ns)
    sdo = master(bench)
    with sdo.open(
        0x2003,
        0,
        "wb",
        size=size,
        block_transfer=True,
        request_crc_support=with_crc,
        buffering=1024,
    ) as stream:
        stream.write(data)
    assert bench.objects.written == [(0x2003, 0, data)]
    # this client takes "the server supports a CRC" for "there is one", so it has to ask for it
    with sdo.open(0x2003, 0, "rb", block_transfer=True, request_crc_support=True) as stream:
        assert stream.read() == data
    assert not bench.server.busy


def test_canopen_repeats_block_segments_that_got_lost() -> None:
    data = random.Random(3).randbytes(3000)
    lost = [40, 20, 100]

    def lose(frame: bytes) -> bool:
        if lost and frame[0] == lost[0]:
            lost.pop(0)
            return True
        return False

    bench = Bench()
    with master(bench, lose).open(
        0x2003, 0, "wb", size=3000, block_transfer=True, buffering=1024
    ) as stream:
        stream.write(data)
    assert lost == []
    assert bench.objects.written == [(0x2003, 0, data)]


@pytest.mark.parametrize(
    ("act", "code"),
    [
        (lambda sdo: sdo.upload(0x1000, 3), Abort.NO_SUB_INDEX),
        (lambda sdo: sdo.download(0x1017, 0, bytes(40)), Abort.TOO_LONG),
        (lambda sdo: sdo.open(0x3000, 0, "rb", block_transfer=True), Abort.NO_OBJECT),
        (lambda sdo: sdo.open(0x1000, 0, "wb", size=4, block_transfer=True), Abort.READ_ONLY),
    ],
)
def test_canopen_sees_the_abort_code(act: Callable[[Any], object], code: Abort) -> None:
    bench = Bench()
    with pytest.raises(SdoAbortedError) as caught:
        act(master(bench))
    assert caught.value.code == code
    assert not bench.server.busy
