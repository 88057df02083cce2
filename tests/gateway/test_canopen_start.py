"""When the nodes boot: with the bus, and not before there is one."""

from kontronik_can_gw.cli.common import assemble
from kontronik_can_gw.config import parse
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.telemetry import SECOND


def gateway() -> Gateway:
    tables = {"canopen": {"enabled": True, "store": "/nowhere"}, "dbc": {"enabled": False}, "esc": [{"port": "a"}]}
    loaded = assemble(parse(tables, "test"))
    return Gateway(loaded.escs, loaded.layout, 0, canopen=loaded.canopen)


def test_the_boot_up_waits_for_an_interface_that_is_missing_at_start() -> None:
    made = gateway()
    made.start(0, can_open=False)
    made.advance(5 * SECOND)
    assert made.take_frames() == []
    made.can_returned(6 * SECOND)
    assert [(f.can_id, f.data) for f in made.take_frames()] == [(0x701, b"\0")]
    assert 0x601 in made.receive_ids


def test_an_outage_later_on_does_not_boot_the_nodes_again() -> None:
    made = gateway()
    made.start(0)
    assert [f.can_id for f in made.take_frames()] == [0x701]
    made.can_returned(SECOND // 2)
    assert 0x701 not in [f.can_id for f in made.take_frames()]
