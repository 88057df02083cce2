"""When the nodes boot: with the bus, and not before there is one; and what is refused before."""

from pathlib import Path

import pytest

from kontronik_can_gw.config.assemble import assemble
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.frames import CanFrame
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


def test_a_pdo_with_error_code_and_register_is_sent_when_they_change(
    tmp_path: Path,
) -> None:
    eds = shipped("eds/kontronik_esc.eds").read_bytes()
    head, register, tail = eds.partition(b"[1001]")
    eds = head + register + tail.replace(b"PDOMapping=0", b"PDOMapping=1", 1)
    (tmp_path / "my.eds").write_bytes(eds)
    canopen = {
        "enabled": True,
        "store": str(tmp_path),
        "eds": str(tmp_path / "my.eds"),
        "self_start": True,
    }
    loaded = assemble(
        parse({"canopen": canopen, "dbc": {"enabled": False}, "esc": [{"port": "a"}]}, "test")
    )
    made = Gateway(loaded.escs, loaded.layout, 0, canopen=loaded.canopen)
    made.start(0)
    for request in (
        "23 04 1A 01 10 00 3F 60",
        "23 04 1A 02 08 00 01 10",
        "2F 04 1A 00 02 00 00 00",
        "23 04 18 01 A1 01 00 40",
    ):
        made.take_frames(0)
        made.receive_frame(CanFrame(0x601, bytes.fromhex(request)), 0, 0)
        assert [f.data[0] for f in made.take_frames(0) if f.can_id == 0x581] == [0x60]
    live = bytes.fromhex(
        "4B4F444C 00000000 8A09" + "0000" * 5 + "581F E903 00 00 1D 20 00000200 0C 00 39234C14"
    )
    made.receive_bytes(0, live, SECOND, SECOND)
    made.take_frames(SECOND)
    made.advance(2 * SECOND)
    sent = [frame.data for frame in made.take_frames(2 * SECOND) if frame.can_id == 0x1A1]
    assert sent == [bytes.fromhex("107501")]
