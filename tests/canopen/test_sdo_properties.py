"""The SDO server with random traffic, our client that loses segments, and ``canopen``'s client."""

import random
from binascii import crc_hqx
from collections.abc import Callable, Sequence
from typing import Any

import canopen
import pytest
from canopen.objectdictionary import ObjectDictionary
from hypothesis import example, given, settings
from hypothesis import strategies as st
from script import MS
from sdo_bench import PLACES as KNOWN
from sdo_bench import Bench
from sdo_client import Refused, answer_to, download, upload, uploaded
from wire import Wire

from kontronik_can_gw.canopen.dictionary import Abort
from kontronik_can_gw.times import NEVER

pytestmark = pytest.mark.promise("sdo")

# ---- any traffic

PLACES = [*KNOWN, (0x1000, 7), (0x3000, 0)]
COMMANDS = bytes.fromhex("00 0F 10 1F 40 21 20 23 2F 22 60 70 80 A0 A1 A2 A3 A4 C0 C1 C2 C6 D5 E0")


@st.composite
def requests(draw: st.DrawFn) -> bytes:
    """Draw any bytes, a command to a known object, or a segment of a block."""
    index, sub = draw(st.sampled_from(PLACES))
    command = draw(st.one_of(st.sampled_from(COMMANDS), st.integers(0, 255)))
    tail = draw(st.one_of(st.sampled_from([b"\x04\0\0\0", b"\x7f\x05\0\0"]), st.binary(max_size=5)))
    return bytes((command,)) + index.to_bytes(2, "little") + bytes((sub,)) + tail


def is_answer_to(request: bytes, answer: bytes) -> bool:
    """Return whether an answer fits a request by CiA 301, 7.2.4.3.

    It is an abort or has the server command for the client command. An answer to an initiate
    request has its multiplexer.
    """
    client = request[0] >> 5
    server = answer[0] >> 5
    if len(answer) != 8:
        return False
    is_initiate = client in (1, 2)
    if client == 5:
        is_initiate = request[0] & 3 == 0
    if client == 6:
        is_initiate = not request[0] & 1
    if is_initiate and answer[1:4] != request[1:4]:
        return False
    if answer[0] == 0x80:
        return True
    # 2 also answers a block upload that is smaller than the client's threshold.
    servers = {0: (1,), 1: (3,), 2: (2,), 3: (0,), 5: (6, 2), 6: (5,)}
    return server in servers.get(client, ())


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(requests(), st.sampled_from([0, MS, 60 * MS, 2000 * MS])), max_size=40))
def test_each_request_gets_one_valid_answer_and_later_clients_are_served(
    story: list[tuple[bytes, int]],
) -> None:
    bench = Bench()
    in_block = False
    for request, gap in story:
        bench.pass_time(bench.now + gap)
        in_block &= bench.server.busy
        waited = bench.server.waiting is not None
        answers = bench.request(request)
        if in_block:
            assert len(answers) <= 127  # the segments of a sub-block, or no answer within one
        elif len(request) != 8 or request[0] >> 5 == 4:
            assert answers == []  # an abort has no answer
        elif bench.server.waiting is None and not waited:
            (answer,) = answers
            assert is_answer_to(request, answer), (request.hex(), answer.hex())
            in_block = answer[0] >> 5 in (5, 6)
        if in_block and not bench.server.busy:
            bench.pass_time(bench.now + 60 * MS)  # segments before the client sees an abort
    bench.pass_time(bench.now + 2000 * MS)
    bench.server.confirm(None)
    assert not bench.server.busy
    assert bench.server.due == NEVER
    client = Client(bench)
    client.block_download(b"anything", tell_size=True, with_crc=True)
    assert upload(client.answer, 0x2003, 0) == b"anything"


# ---- a client


class Client:
    """A client of block transfers with 2003h.

    ``lose`` is called before each segment in either direction, and returns whether it is lost.
    """

    multiplexer = b"\x03\x20\0"

    def __init__(
        self,
        bench: Bench,
        lose: Callable[[], bool] = lambda: False,
    ) -> None:
        self.bench = bench
        self.lose = lose

    def answer(self, request: bytes) -> bytes:
        self.bench.now += MS
        (answer,) = self.bench.request(request)
        return answer

    def ask(self, request: bytes) -> bytes:
        return answer_to(self.answer, request)

    def block_download(self, data: bytes, tell_size: bool, with_crc: bool) -> int:
        """Download data in blocks. Return the number of sub-blocks."""
        size = len(data).to_bytes(4, "little") if tell_size else bytes(4)
        command = 0xC0 | with_crc << 2 | tell_size << 1
        answer = self.ask(bytes((command,)) + self.multiplexer + size)
        assert answer[:4] == b"\xa4" + self.multiplexer
        block_size = answer[4]
        done = 0
        rounds = 0
        parts = [data[at : at + 7] for at in range(0, len(data), 7)] or [b""]
        while done < len(parts):
            rounds += 1
            block = parts[done : done + block_size]
            received = 0
            whole = True
            for number, part in enumerate(block[:-1], 1):
                if self.lose():
                    whole = False
                    continue
                received += whole
                for answer in self.bench.request(bytes((number,)) + part):
                    raise Refused(answer)
            # The last segment of a sub-block has to arrive. Without it there is no acknowledgement.
            is_last = done + len(block) == len(parts)
            command = len(block) | is_last << 7
            answer = self.ask(bytes((command,)) + block[-1].ljust(7, b"\xee"))
            assert answer[0] == 0xA2
            assert answer[1] == received + whole
            assert not any(answer[3:])
            done += answer[1]
            block_size = answer[2]
        unused = 7 - len(parts[-1])
        crc = crc_hqx(data, 0).to_bytes(2, "little") if with_crc else b"\0\0"
        assert self.ask(bytes((0xC1 | unused << 2,)) + crc) == b"\xa1" + bytes(7)
        return rounds

    def block_upload(
        self,
        block_sizes: Sequence[int],
        with_crc: bool,
        threshold: int = 0,
    ) -> bytes:
        turn = 0
        initiate = bytes((0xA0 | with_crc << 2,)) + self.multiplexer
        answer = self.ask(initiate + bytes((block_sizes[0], threshold)))
        assert answer[1:4] == self.multiplexer
        if answer[0] & 0xE0 == 0x40:
            return uploaded(self.answer, answer)
        assert answer[0] == 0xC6
        size = int.from_bytes(answer[4:], "little")
        data = b""
        over = False
        request = b"\xa3"
        while not over:
            block_size = block_sizes[turn % len(block_sizes)]
            turn += 1
            frames = list(self.bench.request(request.ljust(8, b"\0")))
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
        crc = crc_hqx(data, 0) if with_crc else 0
        assert int.from_bytes(answer[1:3], "little") == crc
        assert self.bench.request(b"\xa1" + bytes(7)) == []
        return data


SIZES = st.one_of(
    st.integers(0, 40),
    st.sampled_from([126, 127, 7 * 126, 7 * 127 - 1, 7 * 127, 7 * 127 + 1, 7 * 128, 7 * 254]),
    st.integers(0, 2000),
)
DATA = st.builds(
    lambda size, seed: random.Random(seed).randbytes(size),
    SIZES,
    st.integers(0, 2**32),
)


def losing(seed: int, percent: int) -> Callable[[], bool]:
    chance = random.Random(seed)
    return lambda: chance.randrange(100) < percent


@settings(max_examples=75, deadline=None)
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
def test_blocks_transfer_any_data_both_ways_even_if_segments_are_lost(
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
    assert bench.objects.downloads == [(0x2003, 0, data)]
    assert not bench.server.busy
    assert client.block_upload(block_sizes, with_crc, threshold) == data
    assert not bench.server.busy


@pytest.mark.parametrize("in_blocks", [True, False])
def test_download_of_more_than_64_kib_is_refused(in_blocks: bool) -> None:
    def write(client: Client, data: bytes) -> None:
        if in_blocks:
            client.block_download(data, tell_size=False, with_crc=False)
        else:
            download(client.answer, 0x2003, 0, data, tell_size=False)

    bench = Bench()
    write(Client(bench), bytes(65536))
    assert bench.objects.downloads == [(0x2003, 0, bytes(65536))]
    with pytest.raises(Refused) as caught:
        write(Client(bench), bytes(65537))
    assert caught.value.code == Abort.TOO_LONG


# ---- the client of canopen


def master(bench: Bench) -> Any:
    """Return the SDO client of a node. The other end is the server."""

    def exchange(
        cob_id: int,
        data: bytes,
        remote: bool,
    ) -> list[tuple[int, bytes]]:
        assert cob_id == 0x601
        assert not remote
        bench.now += MS
        answers = list(bench.request(data))
        while bench.server.due < bench.now + 1000 * MS:
            bench.answers = []
            bench.pass_time(bench.server.due)
            answers += bench.answers
        return [(0x581, answer) for answer in answers]

    node = canopen.RemoteNode(1, ObjectDictionary())  # type: ignore[no-untyped-call]
    Wire(exchange).add_node(node)
    return node.sdo


@pytest.mark.parametrize("segment_ns", [0, MS // 2])
@pytest.mark.parametrize(
    "size",
    [1, 4, 5, 7, 8, 7 * 127, 7 * 127 + 1, 5000],
)
def test_canopen_package_can_use_every_kind_of_transfer(size: int, segment_ns: int) -> None:
    data = random.Random(size).randbytes(size)
    bench = Bench(segment_ns)
    sdo = master(bench)
    sdo.download(0x2003, 0, data)
    assert sdo.upload(0x2003, 0) == data
    sdo.download(0x2003, 0, data[::-1], force_segment=True)
    assert sdo.upload(0x2003, 0) == data[::-1]
    block = {"block_transfer": True, "buffering": 1024}
    for with_crc in (True, False):
        with sdo.open(0x2003, 0, "wb", size=size, request_crc_support=with_crc, **block) as stream:
            stream.write(data)
        assert bench.objects.downloads[-1] == (0x2003, 0, data)
        # If the server supports a CRC, this client expects one, so it has to request it.
        with sdo.open(0x2003, 0, "rb", block_transfer=True, request_crc_support=True) as stream:
            assert stream.read() == data
    assert not bench.server.busy


def test_block_upload_that_is_restarted_often_keeps_its_pace() -> None:
    """An impatient master does not get a larger part of the bus."""
    bench = Bench(MS)
    bench.objects.find(0x2003, 0).value = bytes(6000)
    segments = 0
    end = 200 * MS
    while bench.now < end:
        bench.request(bytes.fromhex("a4032000 7f000000"))
        segments += len(bench.request(bytes.fromhex("a300000000000000")))
        bench.answers = []
        bench.pass_time(bench.now + MS // 2)
        segments += len(bench.answers)
    assert end // MS // 2 < segments <= end // MS + 4
