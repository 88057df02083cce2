"""When the nodes boot: with the bus, and not before there is one; and what is refused before."""

from pathlib import Path

import pytest

from kontronik_can_gw.config.assemble import assemble
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.gateway_status import CanState


def gateway() -> Gateway:
    tables = {
        "canopen": {"enabled": True, "store": "/nowhere"},
        "dbc": {"enabled": False},
        "esc": [{"port": "a"}],
    }
    loaded = assemble(parse(tables, "test"))
    return Gateway(loaded.escs, loaded.layout, 0, canopen=loaded.canopen)


def test_nodes_boot_again_when_an_interface_was_down() -> None:
    made = gateway()
    made.start(0)
    assert [f.can_id for f in made.take_frames(0)] == [0x701]
    made.can_returned(SECOND // 2)
    assert 0x701 not in [f.can_id for f in made.take_frames(SECOND // 2)], "no outage, no boot-up"
    made.set_can_state(CanState.ERROR_ACTIVE, SECOND // 2)
    made.take_frames(SECOND // 2)
    for now in (SECOND, 2 * SECOND, 3 * SECOND):
        made.set_can_state(CanState.DOWN, now)
        made.can_returned(now)
        assert [(f.can_id, f.data) for f in made.take_frames(now)] == [(0x701, b"\0")]


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (0x182, "Volts: id 182h is used by TPDO 1 of CANopen node 2"),
        (0x80, "SYNC"),
        (0x581, "SDO answers of CANopen node 1"),
    ],
)
def test_a_dbc_message_with_a_cob_id_of_a_node_is_refused_by_name(
    tmp_path: Path, number: int, said: str
) -> None:
    text = f'VERSION ""\nNS_ :\nBS_:\nBU_: Gw Logger\nBO_ {number} Volts: 8 Gw\n'
    text += ' SG_ esc2BatteryVoltage : 0|16@1+ (0.01,0) [0|0] "V" Logger\n'
    (tmp_path / "my.dbc").write_text(text)
    tables = {
        "esc": [{"port": "a"}, {"port": "b"}],
        "canopen": {"enabled": True, "store": str(tmp_path)},
        "dbc": {"file": str(tmp_path / "my.dbc")},
    }
    with pytest.raises(UserError, match=said):
        assemble(parse(tables, "test"))
