"""An EDS of a user: what it drops behaves as the shipped default, and what cannot be is refused by name."""

from functools import cache

import pytest
from dialogue import Bench, changed, info, live, shipped_eds
from eds_text import SHIPPED, with_key

from kontronik_can_gw.canopen.check import check_eds
from kontronik_can_gw.canopen.dcf import without
from kontronik_can_gw.canopen.eds import load
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings

DATA = shipped("eds/kontronik_esc.eds").read_bytes()
PDOS = frozenset(range(0x1800, 0x1C00))
OPTIONAL = sorted(
    {entry.index for entry in shipped_eds().entries} - PDOS - {0x1000, 0x1001, 0x1018}
)
EVERY_SYNC = {(0x1800, 2): {"default": 1}}
LSS_INQUIRY = ("5A", "5B", "5C", "5D", "5E")


def pdos_with(index: int) -> frozenset[int]:
    """The objects of PDOs that map something of an object: they go with it."""
    return frozenset(
        entry.index + offset
        for entry in shipped_eds().entries
        if entry.index >> 9 == 0x1A00 >> 9
        and entry.sub
        and isinstance(entry.default, int)
        and entry.default >> 16 == index
        for offset in (0, -0x200)
    )


def behaviour(dropped: frozenset[int], self_start: bool = False) -> list[str]:
    """What a node says, with its times, to a session in which every service has something to do. No SDO: that shows what is there."""
    eds = changed(load(without(DATA, dropped), "my.eds"), EVERY_SYNC)
    check_eds(eds, shipped_eds(), [EscSettings()])
    bench = Bench(eds=eds, boot=False, self_start=self_start)
    bench.can_state("ERROR_ACTIVE")
    bench.put(0, "01 00")
    for number in range(60):
        bench.wait(10)
        errors = (0, 1 << 17, 1 | 1 << 17, 0)[number // 15]
        bench.uart(live(battery_voltage=2000 + number, operating_errors=errors))
        if number == 5:
            bench.uart(info(cell_count=6))
        if number % 7 == 0:
            bench.put(0x080, b"" if number != 21 else b"\x01")
        if number % 9 == 0:
            bench.put(0x702, "05")
    bench.wait(1500)  # heartbeats; telemetry is lost
    bench.uart(live()[:-1] + b"\xff")
    bench.uart(live())
    for name in ("BUS_OFF", "ERROR_ACTIVE"):
        bench.can_state(name)
        bench.wait(300)
    bench.put(0x7E5, "04 01 00 00 00 00 00 00")
    for service in LSS_INQUIRY:
        bench.put(0x7E5, service + 7 * " 00")
    bench.put(0, "82 00")
    bench.wait(2000)
    for index in dropped:
        assert bench.read(index) == bench.write(index, 0, 0, size=1) == 0x06020000
    for entry in eds.entries:
        bench.read(entry.index, entry.sub)
    return [f"{time} {frame.can_id:03X} {frame.data.hex()}" for time, frame in bench.heard]


@cache
def whole(dropped: frozenset[int] = frozenset()) -> list[str]:
    return behaviour(dropped)


@pytest.mark.parametrize("index", OPTIONAL, ids=lambda index: f"{index:04X}h")
def test_a_dropped_object_leaves_the_behaviour_of_the_shipped_default(index: int) -> None:
    pdos = pdos_with(index)
    assert behaviour(pdos | {index}) == whole(pdos)


def test_all_dropped_at_once_leave_it_too() -> None:
    pdos = frozenset(index for index in shipped_eds().object_names if index in PDOS)
    assert behaviour(frozenset(OPTIONAL) | pdos) == whole(pdos)
    assert behaviour(frozenset(OPTIONAL) | pdos, self_start=True) == behaviour(
        pdos, self_start=True
    )


@pytest.mark.parametrize("number", range(6))
def test_only_the_objects_of_a_pdo_take_it_away(number: int) -> None:
    left = [line for line in whole() if line.split()[1] != f"{number + 1}81"]
    assert behaviour(frozenset({0x1800 + number, 0x1A00 + number})) == left


# --- what is refused at start


def problems(data: bytes, node_ids: tuple[int, ...] = (1,)) -> list[str]:
    with pytest.raises(UserError) as caught:
        check_eds(load(data, "my.eds"), shipped_eds(), [EscSettings()], node_ids)
    return list(caught.value.problems)


def test_cob_ids_of_one_node_only_and_of_what_is_not_in_the_eds_are_judged() -> None:
    text = with_key(SHIPPED, "1800sub1", "DefaultValue", "$NODEID+0x40000080")
    (said,) = problems(without(text.encode(), {0x1014}))
    assert "COB-ID 081h is that of 1014h:00 of node 1 and of 1800h:01 of node 1." in said
    text = with_key(SHIPPED, "1800sub1", "DefaultValue", "$NODEID+0x4000057F")
    check_eds(load(text.encode(), "my.eds"), shipped_eds(), [EscSettings()], [1])
    said = problems(text.encode(), (3,))[0]
    assert "TPDO 1: the defaults of 1800h and 1A00h do not make a PDO of node 3" in said
    check_eds(shipped_eds(), shipped_eds(), [EscSettings()], range(1, 128))


def test_a_configured_setting_that_its_object_cannot_hold_is_refused_by_name() -> None:
    text = SHIPPED
    for key, value in (("DataType", "0x0005"), ("HighLimit", "0xFF"), ("DefaultValue", "0xFA")):
        text = with_key(text, "2100sub4", key, value)
    eds = load(text.encode(), "my.eds")
    check_eds(eds, shipped_eds(), [EscSettings()])
    said = "2100h:04 Telemetry time-out: cannot hold 5000, which the configuration says"
    with pytest.raises(UserError, match=said):
        check_eds(eds, shipped_eds(), [EscSettings(), EscSettings("b", timeout_ns=5_000_000_000)])


def test_the_session_hears_every_service() -> None:
    heard = {line.split()[1] for line in whole()}
    assert heard == {"701", "081", "181", "281", "381", "481", "7E4"}
    codes = {line.split()[2][:4] for line in whole() if line.split()[1] == "081"}
    assert codes == {"0000", "2032", "4081", "4082", "1075"}
