"""The SDO server where dialogues in files would be long: whole sub-blocks, 64 KiB, calls from within a download."""

from binascii import crc_hqx

from sdo_bench import MS, Bench, Dictionary, Entry

from kontronik_can_gw.cia301.sdo import SdoServer

WRITE_LATE = bytes.fromhex("2305200073617665")
LATE_OK = bytes.fromhex("6005200000000000")


def crc(data: bytes) -> bytes:
    return crc_hqx(data, 0).to_bytes(2, "little")


def segments(data: bytes, numbers: range, end: bool = True) -> list[bytes]:
    """Block segments 1, 2, … that carry the named sevens of ``data``; the very last is marked as such."""
    return [
        bytes((number | (0x80 if end and 7 * place + 7 >= len(data) else 0),)) + data[7 * place :][:7].ljust(7, b"\0")
        for number, place in enumerate(numbers, 1)
    ]


def ask(bench: Bench, *requests: bytes | str) -> list[str]:
    """All answers to some requests, in hexadecimal."""
    answers = []
    for request in requests:
        answers += bench.request(bytes.fromhex(request) if isinstance(request, str) else request)
    return [answer.hex() for answer in answers]


def test_a_sub_block_of_127_segments_and_the_next_one() -> None:
    data = bytes(i % 251 for i in range(130 * 7))
    first, second, size = segments(data, range(127)), segments(data, range(127, 130)), len(data).to_bytes(4, "little")
    end = b"\xc1" + crc(data) + bytes(5)
    bench = Bench()
    assert ask(bench, b"\xc6\x03\x20\0" + size) == ["a40320007f000000"]
    assert ask(bench, *first) == ["a27f7f0000000000"]
    assert ask(bench, *second) == ["a2037f0000000000"]
    assert ask(bench, end) == ["a100000000000000"]
    assert ask(bench, "a40320007f000000") == ["c6032000" + size.hex()]
    assert ask(bench, "a300000000000000") == [segment.hex() for segment in first]
    assert ask(bench, "a27f7f0000000000") == [segment.hex() for segment in second]
    assert ask(bench, "a2037f0000000000") == [end.hex()]
    assert ask(bench, "a100000000000000") == []
    assert bench.objects.written == [(0x2003, 0, data)]
    assert not bench.server.busy


def test_within_a_sub_block_the_bytes_of_a_request_are_a_segment() -> None:
    lines = segments(bytes(7 * 64), range(64), end=False)
    assert lines[63][0] == 0x40
    bench = Bench()
    assert ask(bench, "c403200000000000", *lines) == ["a40320007f000000"]
    assert ask(bench, "c100000000000000") == ["a2417f0000000000"]


def test_a_sub_block_cut_short_by_a_reset_writes_nowhere() -> None:
    """Segment 23h with data 17h 10h … would be an expedited download to 1017h."""
    bench = Bench()
    lines = segments(bytes.fromhex("17100001020304") * 0x30, range(0x30), end=False)
    assert ask(bench, "c403200000000000", *lines[:0x20]) == ["a40320007f000000"]
    bench.server.reset()
    assert ask(bench, *lines[0x20:]) == []
    assert bench.objects.written == []
    assert not bench.server.busy


def test_the_crc_is_the_one_the_standard_wants() -> None:
    assert crc_hqx(b"123456789", 0) == 0x31C3  # CRC-16/XMODEM: polynomial 1021h, initial value 0


def test_a_segmented_download_to_an_object_without_a_limit_ends_at_64_kib() -> None:
    bench = Bench()
    bench.request(bytes.fromhex("2003200000000000"))
    toggle = 0
    for _ in range(65536 // 7):
        assert bench.request(bytes((toggle,)) + bytes(7)) == [bytes((0x20 | toggle,)) + bytes(7)]
        toggle ^= 0x10
    assert bench.request(bytes((toggle,)) + bytes(7)) == [bytes.fromhex("8003200005000405")]


def test_a_block_download_to_an_object_without_a_limit_ends_at_64_kib() -> None:
    bench = Bench()
    bench.request(bytes.fromhex("c003200000000000"))
    answers = []
    for place in range(65536 // 7 + 1):
        answers += bench.request(bytes((place % 127 + 1,)) + bytes(7))
    assert answers[-1] == bytes.fromhex("8003200005000405")
    assert all(answer == bytes.fromhex("a27f7f0000000000") for answer in answers[:-1])
    assert len(answers) == 65536 // 7 // 127 + 1


def test_a_dictionary_may_confirm_from_within_the_download() -> None:
    class Eager(Dictionary):
        def download(self, index: int, sub: int, data: bytes, now: int) -> bool:
            super().download(index, sub, data, now)
            server.confirm(None, now)
            return sub == 0

    answers: list[bytes] = []
    server = SdoServer(Eager({(0x2005, 0): Entry(size=4), (0x2005, 1): Entry(size=4)}), answers.append)
    server.receive(WRITE_LATE, 0)
    assert answers == [LATE_OK]
    server.receive(bytes.fromhex("2305200173617665"), 0)
    assert answers == [LATE_OK, bytes.fromhex("6005200100000000")]
    assert not server.busy


def test_a_dictionary_may_reset_the_server_from_within_the_download() -> None:
    class Restarting(Dictionary):
        def download(self, index: int, sub: int, data: bytes, now: int) -> bool:
            server.reset()
            return True

    answers: list[bytes] = []
    server = SdoServer(Restarting(), answers.append)
    server.receive(WRITE_LATE, 0)
    assert answers == []
    assert not server.busy and server.next_deadline() is None


def test_a_request_later_than_the_time_out_finds_the_transfer_ended() -> None:
    """Also when nobody called advance in time."""
    bench = Bench()
    bench.request(bytes.fromhex("4008100000000000"))
    bench.now = 2_000 * MS
    assert bench.request(bytes.fromhex("4001100000000000")) == [
        bytes.fromhex("8008100000000405"),
        bytes.fromhex("4f01100005000000"),
    ]


def test_advance_before_the_time_out_does_nothing() -> None:
    bench = Bench()
    bench.server.advance(0)
    bench.request(bytes.fromhex("4008100000000000"))
    bench.answers.clear()
    bench.server.advance(2_000 * MS - 1)
    assert bench.answers == [] and bench.server.busy
    bench.server.advance(2_000 * MS)
    assert bench.answers == [bytes.fromhex("8008100000000405")]
    bench.server.advance(5_000 * MS)
    assert len(bench.answers) == 1
