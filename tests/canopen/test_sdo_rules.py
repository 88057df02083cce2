"""The SDO server where dialogues in files would be long: a sub-block cut short, calls from within a download."""

from sdo_bench import Bench


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
