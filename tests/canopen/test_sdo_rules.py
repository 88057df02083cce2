"""The SDO server where dialogues in files would be long: a sub-block cut short, calls from within a download."""

from typing import Any, cast

from sdo_bench import Bench, Dictionary, Entry

from kontronik_can_gw.canopen.sdo import SdoServer
from kontronik_can_gw.output import NEVER

WRITE_LATE = bytes.fromhex("2305200073617665")
LATE_OK = bytes.fromhex("6005200000000000")


def test_a_sub_block_cut_short_by_a_reset_writes_nowhere() -> None:
    """Segment 23h with data 17h 10h … would be an expedited download to 1017h."""
    bench = Bench()
    assert bench.request(bytes.fromhex("c403200000000000")) == [bytes.fromhex("a40320007f000000")]
    for number in range(1, 0x31):
        if number == 0x21:
            bench.server.reset()
        assert bench.request(bytes((number,)) + bytes.fromhex("17100001020304")) == []
    assert bench.objects.written == []
    assert not bench.server.busy


def test_a_dictionary_may_confirm_from_within_the_download() -> None:
    class Eager(Dictionary):
        def download(self, index: int, sub: int, data: bytes, now: int) -> bool:
            super().download(index, sub, data, now)
            server.confirm(None)
            return sub == 0

    answers: list[bytes] = []
    server = SdoServer(
        cast(Any, Eager({(0x2005, 0): Entry(size=4), (0x2005, 1): Entry(size=4)})), answers.append
    )
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
    server = SdoServer(cast(Any, Restarting()), answers.append)
    server.receive(WRITE_LATE, 0)
    assert answers == []
    assert not server.busy and server.due == NEVER
