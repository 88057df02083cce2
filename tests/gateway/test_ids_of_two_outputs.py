"""One id for two outputs is refused, with who has it."""

from pathlib import Path

import pytest

from kontronik_can_gw.config.assemble import assemble
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.errors import UserError


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
