"""What a review of the CANopen nodes found, each pinned."""

from pathlib import Path

import pytest
from dialogue import NO_PDOS, SPARE, Bench, default, play
from test_dictionary_walk import bench_of, plain, text, with_key, with_object

from kontronik_can_gw.cia301.check import check_eds
from kontronik_can_gw.cia301.eds import load, without
from kontronik_can_gw.cia301.emergency import Emergencies, GatewayError
from kontronik_can_gw.cia301.storage import Stored, encode
from kontronik_can_gw.cli.common import Loaded, assemble
from kontronik_can_gw.config import parse
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.protocol.codec import Layout
from kontronik_can_gw.protocol.codec import encode as uart
from kontronik_can_gw.protocol.fields import InfoData, LiveData, device_and_variant
from kontronik_can_gw.runtime.machine import machine_identity, serial_number
from kontronik_can_gw.telemetry import EscSettings


def refused(changed: str, node_id: int = 1) -> str:
    with pytest.raises(UserError) as caught:
        check_eds(load(changed.encode(), "my.eds"), EscSettings(), [node_id])
    return "\n".join(caught.value.problems)


@pytest.mark.parametrize(
    ("section", "key", "value", "said"),
    [
        ("1200sub1", "DefaultValue", "$NODEID+0x640", "1200h:01 COB-ID client to server: must be $NODEID+0x600"),
        ("1001", "AccessType", "rw", "1001h:00 Error register: is shown by the node, so it must be read only"),
        ("1001", "AccessType", "wo", "must be read only"),
        ("100A", "AccessType", "rw", "must be read only"),
        ("1018sub1", "AccessType", "rw", "must be read only"),
        ("2010sub6", "AccessType", "rw", "must be read only"),
        ("2101sub1", "AccessType", "rw", "must be read only"),
        ("1005", "DefaultValue", "0x40000080", "1005h:00 COB-ID SYNC message: DefaultValue 0x40000080"),
        ("1014", "DefaultValue", "0x601", "1014h:00 COB-ID EMCY"),
        ("1019", "DefaultValue", "1", "1019h:00"),
        ("1F80", "DefaultValue", "0x1", "1F80h:00"),
    ],
)
def test_defaults_that_a_download_would_be_refused_are_refused_at_start(
    section: str, key: str, value: str, said: str
) -> None:
    assert said in refused(with_key(text(), section, key, value))


def test_a_cob_id_that_is_restricted_for_one_node_only_is_refused_for_that() -> None:
    changed = with_key(text(), "1800sub1", "DefaultValue", "$NODEID+0x4000057F")
    check_eds(load(changed.encode(), "my.eds"), EscSettings(), [1])
    assert "TPDO 1: the defaults of 1800h and 1A00h do not make a PDO of node 3" in refused(changed, 3)


def test_stored_values_that_break_a_rule_give_way_to_the_defaults() -> None:
    stored = Stored(
        communication={
            0x101400: (0x181).to_bytes(
                4, "little"
            ),  # the COB-ID of TPDO 1 is taken when that is configured: it is off then
            0x100500: (0x40000080).to_bytes(4, "little"),
            0x101900: b"\1",
            0x101700: (500).to_bytes(2, "little"),
        }
    )
    bench = Bench(stored=[stored], changes=NO_PDOS)
    assert bench.number(0x1005) == 0x80
    assert bench.number(0x1019) == 0
    assert bench.number(0x1017) == 500
    assert {0x100500, 0x101900} <= set(bench.nodes[0].misfits)


def test_errors_that_come_and_go_in_silence_take_no_memory() -> None:
    sent: list[bytes] = []

    def send(data: bytes) -> bool:
        sent.append(data)
        return True

    found = Emergencies(send, 8)
    for number in range(1000):
        found.set_word(number % 2, number)
        found.pulse(GatewayError.RECEIVE_OVERRUN, number)
    assert len(found._untold) <= 2
    found.open(2000)
    assert len(sent) == 1


def test_the_bec_current_of_a_jivepro_stays_unknown_when_its_info_is_old() -> None:
    bench = Bench()
    live, info = LiveData(bec_current=4711), InfoData(device_and_variant=device_and_variant(3, 120))
    bench.uart(uart(info, Layout.V4))
    for _ in range(130):
        bench.wait(100)
        bench.uart(uart(live, Layout.V4))
    assert bench.gateway.escs[0].info is None
    assert bench.read(0x2000, 7) == 0x08000024


def test_nmt_startup_takes_no_master() -> None:
    play(
        """
        0 write 1 1F80:00 01 00 00 00 ! 06090030
        0 write 1 1F80:00 00 00 00 00
    """,
        Bench(changes={**NO_PDOS, **default(0x1017, 0, 0)}),
    )


def test_a_node_starts_by_itself_where_the_eds_has_no_1f80h() -> None:
    eds = load(without(text().encode(), {0x1F80}), "my.eds")
    assert Bench(eds=eds, self_start=True).nodes[0].state == 5
    assert Bench(eds=eds).nodes[0].state == 127


def test_objects_from_a000h_on_are_stored_too() -> None:
    swapped = text().replace("[ManufacturerObjects]", "[Kept]").replace("[OptionalObjects]", "[ManufacturerObjects]")
    changed = with_object(swapped, 0xA000, plain(0x05, DefaultValue="1"))
    changed = changed.replace("[ManufacturerObjects]", "[OptionalObjects]").replace("[Kept]", "[ManufacturerObjects]")
    bench = bench_of(changed)
    assert bench.write(0xA000, 0, b"\x05") is None
    assert bench.store().application == {0xA00000: b"\x05"}


def test_serial_numbers_differ_by_number_name_and_machine(tmp_path: Path) -> None:
    made = {serial_number(n, name, identity) for n in (1, 2) for name in ("left", "right") for identity in (b"a", b"b")}
    assert len(made) == 8
    assert serial_number(1, "left", b"a") == serial_number(1, "left", b"a")
    assert serial_number(1, "left", b"") == 0
    assert machine_identity(tmp_path) == b""
    (tmp_path / "etc").mkdir()
    (tmp_path / "etc" / "machine-id").write_text("0123\n")
    assert machine_identity(tmp_path) == b"0123\0"


# --- what a second review found


def setup_of(tmp_path: Path, escs: int = 2, **canopen: object) -> Loaded:
    tables = {
        "canopen": {"enabled": True, "store": str(tmp_path), **canopen},
        "esc": [{"port": f"p{n}"} for n in range(1, escs + 1)],
    }
    return assemble(parse(tables, "test"))


def keep(tmp_path: Path, **stored: Stored) -> None:
    for name, what in stored.items():
        (tmp_path / f"{name}.params").write_bytes(encode(what))


def u32(value: int) -> bytes:
    return value.to_bytes(4, "little")


@pytest.mark.parametrize(
    "stored",
    [
        {"esc1": Stored(2)},
        {"esc1": Stored(7), "esc2": Stored(7)},
        {"esc1": Stored(communication={0x180501: u32(0x40000087)}), "esc2": Stored(7)},
        {"esc1": Stored(communication={0x100500: u32(0x90), 0x180501: u32(0x40000080)})},
        {"esc1": Stored(communication={0x100500: u32(0x87)}), "esc2": Stored(7)},
        {"esc1": Stored(communication={0x101400: u32(0x82)})},
        {"esc1": Stored(communication={0x180501: u32(0x40000680), 0x1A0500: b"\1", 0x1A0501: u32(0x20000220)})},
        {"esc1": Stored(communication={(0x1800 + n) << 8 | 5: b"\1\0" for n in range(4)} | {0x101700: b"\1\0"})},
    ],
)
def test_nothing_a_master_stored_keeps_the_gateway_from_starting(tmp_path: Path, stored: dict[str, Stored]) -> None:
    keep(tmp_path, **stored)
    loaded = setup_of(tmp_path)
    assert loaded.canopen is not None
    ids: dict[int, str] = {m.can_id: m.name for m in loaded.layout.messages}
    nodes = loaded.canopen.nodes(loaded.escs, dict(ids)).nodes
    for node in nodes:
        for cob_id, what in node.cob_ids():
            assert ids.setdefault(cob_id, what) == what
    assert loaded.warnings or any(node.misfits for node in nodes)  # said at start, or by the node when it boots


def test_swapped_node_ids_are_kept(tmp_path: Path) -> None:
    keep(tmp_path, esc1=Stored(2), esc2=Stored(1))
    loaded = setup_of(tmp_path)
    assert loaded.canopen is not None
    assert [node.node_id for node in loaded.canopen.nodes(loaded.escs).nodes] == [2, 1]
    assert loaded.warnings == ()


def test_a_configured_setting_that_its_object_cannot_hold_is_refused_by_name() -> None:
    changed = with_key(with_key(text(), "2100sub4", "DataType", "0x0005"), "2100sub4", "HighLimit", "0xFF")
    changed = with_key(changed, "2100sub4", "DefaultValue", "0xFA")
    eds = load(changed.encode(), "my.eds")
    check_eds(eds, EscSettings())
    with pytest.raises(UserError, match="2100h:04 Telemetry time-out: cannot hold 5000, which the configuration says"):
        check_eds(eds, [EscSettings(), EscSettings("b", timeout_ns=5_000_000_000)])


def test_stored_ids_hold_at_every_reset_whatever_the_pdos_had_before() -> None:
    stored = Stored(communication={0x101400: u32(0x191)})
    bench = Bench(stored=[stored], changes={**NO_PDOS, **SPARE})
    assert bench.write(0x1014, 0, 0x80000191) is None
    assert bench.write(0x1805, 1, 0x40000191) is None
    for _ in range(2):
        bench.put(0, "82 01")
        assert bench.number(0x1014) == 0x191


def test_a_reset_of_all_frees_the_ids_of_all_first() -> None:
    stored = Stored(communication={0x180501: u32(0x400001F5)})
    bench = Bench(2, stored=[stored, Stored()], changes={**NO_PDOS, **SPARE})
    assert bench.write(0x1805, 1, 0xC00001F5) is None
    assert bench.write(0x1805, 1, 0x400001F5, node=2) is None
    bench.put(0, "82 00")
    assert bench.number(0x1805, 1) == 0x400001F5
    assert bench.number(0x1805, 1, node=2) == 0xC0000000


def test_an_emergency_does_not_wait_for_an_inhibit_time_that_was_reset() -> None:
    play(
        """
        0 write 1 1015:00 FF FF
        1 uart 0 live operating_errors=1
        1 -> 081 20 32 05 00 01 00 00 00
        2 <- 000 82 01
        2 -> 701 00
        2 -> 081 20 32 05 00 01 00 00 00
    """,
        Bench(changes={**NO_PDOS, **default(0x1017, 0, 0)}),
    )


def test_0000h_does_not_come_for_an_error_that_was_never_sent() -> None:
    play(
        """
        0 write 1 1014:00 81 00 00 80
        1 uart 0 live operating_errors=1
        2 uart 0 live
       10 write 1 1014:00 81 00 00 00
       20 uart 0 live operating_errors=1
       20 -> 081 20 32 05 00 01 00 00 00
    """,
        Bench(changes={**NO_PDOS, **default(0x1017, 0, 0)}),
    )
