"""Store and restore (1010h, 1011h), settings (2100h), node-ID (2101h), statistics (2102h)."""

from dataclasses import replace
from fractions import Fraction

import pytest
from dialogue import MS, NO_HEARTBEAT, QUIET, Bench, default, live, play, shipped_eds

from kontronik_can_gw.cia301.pdo import message_plan
from kontronik_can_gw.cia301.storage import Stored, decode, encode
from kontronik_can_gw.config import shipped
from kontronik_can_gw.dbc_output.layout import Layout
from kontronik_can_gw.telemetry import EscSettings

SAVE, LOAD = b"save", b"load"
COMMUNICATION = {0x101700: bytes.fromhex("f401")}
APPLICATION = {0x210001: b"\x05"}


def written() -> Bench:
    """A node with a changed parameter of each kind."""
    bench = Bench(changes=QUIET)
    assert bench.write(0x1017, 0, 500, size=2) is None
    assert bench.write(0x2100, 1, 5, size=1) is None
    return bench


@pytest.mark.parametrize(
    ("part", "stored"),
    [
        (1, Stored(None, COMMUNICATION, APPLICATION)),
        (2, Stored(None, COMMUNICATION, {})),
        (3, Stored(None, {}, APPLICATION)),
    ],
)
def test_what_is_stored_are_the_differences_of_the_part_that_is_named(part: int, stored: Stored) -> None:
    bench = written()
    assert bench.store(part) == stored
    assert decode(encode(stored)) == stored


def test_the_confirmation_comes_when_the_data_is_on_disk_and_other_nodes_do_not_wait() -> None:
    play(
        """
          0 write 1 2100:01 05
         10 <- 601 23 10 10 01 73 61 76 65
         20 <- 602 40 00 10 00 00 00 00 00
         20 -> 582 43 00 10 00 00 00 00 00
         90 do bench.answer_saves()
         90 -> 581 60 10 10 01 00 00 00 00
    """,
        Bench(2, changes=QUIET),
    )


def test_a_failure_is_06060000h_and_leaves_what_was_stored_before() -> None:
    play("""
          0 write 1 2100:01 05
          1 write 1 1010:01 73 61 76 65
          2 write 1 2100:01 06
          3 <- 601 23 10 10 03 73 61 76 65
          4 do bench.answer_saves("no space left")
          4 -> 581 80 10 10 03 00 00 06 06
          5 <- 000 81 01
          5 -> 701 00
          6 read 1 2100:01 = 05
    """)


@pytest.mark.parametrize("index", [0x1010, 0x1011])
@pytest.mark.parametrize("sub", [1, 2, 3])
def test_a_wrong_signature_is_08000020h_and_stores_nothing(index: int, sub: int) -> None:
    bench = Bench(changes=QUIET)
    other = LOAD if index == 0x1010 else SAVE
    for data in (other, b"SAVE", b"evas", bytes(4), b"\1\0\0\0"):
        bench.put(0x601, b"\x23" + index.to_bytes(2, "little") + bytes((sub,)) + data)
        (answer,) = bench.take()
        assert answer.data == b"\x80" + index.to_bytes(2, "little") + bytes((sub,)) + bytes.fromhex("20000008")
    assert bench.gateway.take_saves() == []
    assert bench.number(index, sub) == 1
    assert bench.number(index, 0) == 3
    assert bench.write(index, 0, 1, size=1) == 0x06010002
    assert bench.write(index, 4, SAVE) == 0x06090011
    assert bench.write(index, sub, b"sav") == 0x06070013


@pytest.mark.parametrize(("part", "left"), [(1, (1000, 1)), (2, (1000, 5)), (3, (500, 1))])
def test_defaults_come_back_at_the_reset_only(part: int, left: tuple[int, int]) -> None:
    bench = Bench(changes={**QUIET, **default(0x1017, 0, 1000)})
    bench.write(0x1017, 0, 500, size=2)
    bench.write(0x2100, 1, 5, size=1)
    assert bench.write(0x1010, 1, SAVE) is None
    assert bench.write(0x1011, part, LOAD) is None
    assert (bench.number(0x1017), bench.number(0x2100, 1)) == (500, 5)
    bench.put(0, "81 01")
    assert (bench.number(0x1017), bench.number(0x2100, 1)) == left


def test_a_reset_of_the_communication_leaves_the_settings_as_they_are() -> None:
    bench = written()
    bench.put(0, "82 01")
    assert (bench.number(0x1017), bench.number(0x2100, 1)) == (0, 5)
    bench.put(0, "81 01")
    assert bench.number(0x2100, 1) == 1


def test_values_written_but_not_stored_are_gone_after_a_reset() -> None:
    bench = written()
    bench.put(0, "81 00")
    assert (bench.number(0x1017), bench.number(0x2100, 1)) == (0, 1)


def test_what_was_stored_is_there_after_a_restart() -> None:
    bench = written()
    stored = bench.store()
    again = Bench(changes=QUIET, stored=[stored])
    assert (again.number(0x1017), again.number(0x2100, 1)) == (500, 5)
    assert again.nodes[0].misfits == []


def test_settings_that_were_stored_can_be_restored_after_a_restart() -> None:
    again = Bench(changes=QUIET, stored=[Stored(None, {}, APPLICATION)])
    assert again.number(0x2100, 1) == 5
    assert again.store(1) == Stored(None, {}, APPLICATION)
    assert again.write(0x1011, 1, LOAD) is None
    again.put(0, "81 01")
    assert again.number(0x2100, 1) == 1
    assert again.gateway.escs[0].settings.pole_pairs == 1


def test_the_configuration_is_what_2100h_is_restored_to() -> None:
    escs = {"pole_pairs": 7, "gear": Fraction(5, 2), "timeout_ns": 400 * MS, "cell_count": 12}
    bench = Bench(changes=QUIET, escs=escs)
    assert [bench.number(0x2100, sub) for sub in (1, 2, 3, 4, 7)] == [7, 5, 2, 400, 12]
    bench.write(0x2100, 1, 9, size=1)
    assert bench.store(1) == Stored(None, {}, {0x210001: b"\x09"})
    assert bench.write(0x1011, 1, LOAD) is None
    bench.put(0, "81 01")
    assert bench.number(0x2100, 1) == 7


def test_a_result_that_comes_late_does_not_confirm_the_next_request() -> None:
    play("""
          0 <- 601 23 10 10 01 73 61 76 65
          1 <- 601 80 10 10 01 00 00 04 05             ; the client gives up
          2 <- 601 23 10 10 02 73 61 76 65
          3 do gateway.take_saves()
          4 do gateway.saved(0, "disk full", now)      ; that of the first
          5 do gateway.saved(0, None, now)
          5 -> 581 60 10 10 02 00 00 00 00
    """)


def test_a_result_that_comes_after_a_reset_is_not_told() -> None:
    play("""
          0 <- 601 23 10 10 01 73 61 76 65
          1 <- 000 81 01
          1 -> 701 00
          2 do bench.answer_saves()
          3 read 1 1000:00 = 00 00 00 00
    """)


def test_a_second_store_builds_on_the_first_that_is_still_under_way() -> None:
    bench = written()
    bench.put(0x601, b"\x23\x10\x10\x02" + SAVE)
    bench.put(0x601, b"\x23\x10\x10\x03" + SAVE)
    saves = bench.answer_saves()
    assert saves == [(0, Stored(None, COMMUNICATION, {})), (0, Stored(None, COMMUNICATION, APPLICATION))]


def test_storing_by_lss_keeps_the_parameters_and_storing_by_1010h_the_node_id() -> None:
    bench = written()
    bench.store()
    bench.talk("""
        1 <- 7E5 04 01 00 00 00 00 00 00
        1 <- 7E5 11 07 00 00 00 00 00 00
        1 -> 7E4 11 00 00 00 00 00 00 00
        2 <- 7E5 17 00 00 00 00 00 00 00
    """)
    assert bench.answer_saves() == [(0, Stored(7, COMMUNICATION, APPLICATION))]
    bench.talk("2 -> 7E4 17 00 00 00 00 00 00 00")
    bench.write(0x2100, 1, 1, size=1)
    assert bench.store(3) == Stored(7, COMMUNICATION, {})


def test_lss_tells_a_failed_store() -> None:
    play("""
        1 <- 7E5 04 01 00 00 00 00 00 00
        2 <- 7E5 17 00 00 00 00 00 00 00
        3 do bench.answer_saves("disk full")
        3 -> 7E4 17 02 00 00 00 00 00 00
    """)


def test_a_restore_leaves_a_stored_node_id() -> None:
    bench = Bench(changes=QUIET, stored=[Stored(9, COMMUNICATION, APPLICATION)])
    bench.put(0x609, b"\x23\x11\x10\x01" + LOAD)
    assert bench.answer_saves() == [(0, Stored(9, {}, {}))]


def test_values_with_the_node_id_in_their_default_follow_a_changed_node_id() -> None:
    bench = Bench(changes=NO_HEARTBEAT)
    bench.write(0x1801, 1, 0xC0000281)
    stored = bench.store()
    assert stored.communication == {0x180101: bytes.fromhex("810200c0")}
    again = Bench(changes=NO_HEARTBEAT, stored=[replace(stored, node_id=5)])
    assert [again.number(i, s, 5) for i, s in ((0x1014, 0), (0x1800, 1), (0x1200, 1))] == [0x85, 0x40000185, 0x605]
    assert again.number(0x1801, 1, 5) == 0xC0000281


def test_an_application_default_with_the_node_id_has_it_from_the_first_moment() -> None:
    bench = Bench(changes={**QUIET, (0x2002, 1): {"access": "rw", "default": 0x100, "relative": True}})
    assert bench.number(0x2002, 1) == 0x101
    bench.write(0x2101, 2, 9, size=1)
    bench.put(0, "81 01")
    assert bench.number(0x2002, 1, 9) == 0x109


# --- stored values that do not fit any more


def test_stored_values_that_no_longer_fit_the_eds_are_passed_over_and_named() -> None:
    stored = Stored(
        None,
        {0x101700: b"\x01", 0x123400: b"\x01", 0x102901: b"\x09", 0x100000: bytes(4), 0x101500: b"\x0a\x00"},
        {0x210001: b"\xc8", 0x300000: b"\x01", 0x210005: b"\x01"},
    )
    bench = Bench(changes=QUIET, stored=[stored])
    assert [bench.number(*at) for at in ((0x1017, 0), (0x1029, 1), (0x2100, 1))] == [0, 0, 1]
    assert [bench.number(*at) for at in ((0x1015, 0), (0x2100, 5))] == [10, 1]
    assert set(bench.nodes[0].misfits) == {0x101700, 0x123400, 0x102901, 0x100000, 0x210001, 0x300000}


@pytest.mark.parametrize(
    "values",
    [
        {0x1A0001: bytes.fromhex("10020030")},  # an object that is gone
        {0x1A0001: bytes.fromhex("08020020")},  # of another length now
        {0x1A0004: bytes.fromhex("20010020"), 0x1A0000: b"\x04"},  # too long
        {0x180001: bytes.fromhex("81050040")},  # a restricted id
        {0x180001: bytes.fromhex("81020040")},  # that of TPDO 2
        {0x180002: b"\xfd"},
    ],
)
def test_a_stored_pdo_that_makes_no_sense_any_more_gives_way_to_its_defaults(values: dict[int, bytes]) -> None:
    bench = Bench(changes=NO_HEARTBEAT, stored=[Stored(None, values, {})])
    if 0x180001 in values and values[0x180001][1] == 2:
        # the first of the two to be configured keeps the id, the other one is off: an id is sent by one only
        ids = [bench.number(0x1800 + n, 1) for n in range(2)]
        assert sorted(ids) == sorted({0x40000281, *ids})
        assert sum(not cob_id >> 31 and cob_id & 0x7FF == 0x281 for cob_id in ids) == 1
        return
    assert bench.number(0x1800, 1) == 0x40000181
    assert bench.number(0x1800, 2) == 254
    assert bench.number(0x1A00) == 3
    assert set(values) <= set(bench.nodes[0].misfits)
    bench.start()
    bench.uart(live(battery_voltage=2442))
    assert bench.take()[0].data.hex() == "000000008a090000"


# --- settings


def test_settings_take_effect_at_once_in_objects_and_in_the_dbcs_messages() -> None:
    bench = Bench(
        changes={**QUIET, **default(0x1800, 1, 0x40000180, relative=True), **default(0x1A00, 1, 0x20010120)},
        layout=_dbc(),
    )
    bench.start()
    bench.uart(live(electrical_speed=70_000))
    assert _speeds(bench) == {0x181: 70_000, 0x100: 70_000}
    assert bench.write(0x2100, 1, 7, size=1) is None
    bench.now += 20 * MS
    bench.uart(live(electrical_speed=70_000))
    assert _speeds(bench) == {0x181: 10_000, 0x100: 10_000}
    assert bench.number(0x2001, 1) == bench.number(0x606C) == 10_000
    assert bench.write(0x2100, 2, 5) is None
    assert bench.write(0x2100, 3, 2) is None
    assert bench.number(0x2001, 2) == 4_000
    bench.put(0, "81 01")
    assert bench.number(0x2001, 1) == 70_000


def _dbc() -> Layout:
    """A layout with one message that holds the motor speed."""
    from kontronik_can_gw.cia301.bindings import bindings
    from kontronik_can_gw.cia301.dictionary import Dictionary
    from kontronik_can_gw.cia301.pdo import Mapped

    variable = Dictionary(shipped_eds()).find(0x2001, 1)
    plan = message_plan("Speed", 0x100, [Mapped(variable, bindings(EscSettings())[0x2001, 1])])
    return Layout("", "", (plan,))


def _speeds(bench: Bench) -> dict[int, int]:
    return {f.can_id: int.from_bytes(f.data[:4], "little") for f in bench.take()}


def test_the_telemetry_time_out_is_a_setting() -> None:
    play("""
          0 uart 0 live
        100 write 1 2100:04 96 00                     ; 150 ms, for the data that is there already too
        150 -> 081 10 75 01 FF 01 00 00 00
        200 uart 0 live
        200 -> 081 00 00 00 FF 00 00 00 00
        350 -> 081 10 75 01 FF 01 00 00 00
        360 write 1 2100:04 13 00 ! 06090032
        360 write 1 2100:04 61 EA ! 06090031
        400 -
    """)


def test_the_cell_count_can_be_overridden() -> None:
    play("""
        0 uart 0 live battery_voltage=2400
        0 read 1 2001:05 ! 08000024
        0 uart 0 info device_and_variant=1024 cell_count=6
        0 read 1 2001:05 = A0 0F
        1 write 1 2100:07 0C
        1 read 1 2001:05 = D0 07
        2 write 1 2100:07 00
        2 read 1 2001:05 = A0 0F
    """)


def test_the_settings_of_one_node_are_not_those_of_another() -> None:
    bench = Bench(2, changes=QUIET)
    bench.write(0x2100, 1, 7, size=1)
    for esc in range(2):
        bench.uart(live(electrical_speed=7000), esc)
    assert [bench.number(0x2001, 1, node) for node in (1, 2)] == [1000, 7000]


# --- 2101h, 2102h


def test_the_node_id_of_2101h_takes_effect_at_a_reset_and_is_stored_with_the_application() -> None:
    bench = Bench(2, changes=QUIET)
    bench.talk("""
        0 write 1 2101:02 00 ! 06090032
        0 write 1 2101:02 80 ! 06090031
        0 write 1 2101:02 02 ! 06040043              ; the other node has it
        0 write 1 2101:02 09
        0 read 1 2101:01 = 01
        0 read 1 2101:02 = 09
        0 write 2 2101:02 09 ! 06040043              ; or will have it
    """)
    assert bench.store(2).node_id is None
    assert bench.store(3).node_id == 9
    bench.take()
    bench.talk("""
        1 <- 000 82 01
        1 -> 709 00
        2 read 9 2101:01 = 09
    """)


def test_the_bit_rate_is_told_and_cannot_be_written() -> None:
    bench = Bench(changes=QUIET, bitrate=250_000)
    assert [bench.number(0x2101, sub) for sub in (3, 4)] == [250_000, 250_000]
    assert bench.write(0x2101, 4, 125_000) == 0x06010002


def test_statistics_begin_anew_with_the_signature_only() -> None:
    bench = Bench(changes=QUIET)
    bench.uart(live() + b"rubbish")
    bench.uart(live())
    assert (bench.number(0x2020, 5), bench.number(0x2020, 9)) == (2, 7)
    assert bench.write(0x2102, 1, 1) == 0x08000020
    assert bench.write(0x2102, 1, SAVE) == 0x08000020
    assert bench.number(0x2020, 5) == 2
    assert bench.write(0x2102, 1, b"rset") is None
    assert (bench.number(0x2020, 5), bench.number(0x2020, 9)) == (0, 0)
    assert bench.number(0x2020, 2) == 2  # the live counter goes on
    assert bench.read(0x2102, 1) == 0x06010001


def test_read_only_refuses_every_way_of_writing() -> None:
    play(
        """
        0 write 1 1017:00 E8 03 ! 08000022
        0 write 1 2100:01 05 ! 08000022
        0 write 1 2101:02 05 ! 08000022
        0 write 1 1010:01 73 61 76 65 ! 08000022
        0 write 1 1011:01 6C 6F 61 64 ! 08000022
        0 write 1 1003:00 00 ! 08000022
        0 write 1 2102:01 72 73 65 74 ! 08000022
        1 <- 7E5 04 01 00 00 00 00 00 00
        1 <- 7E5 11 07 00 00 00 00 00 00
        1 -> 7E4 11 FF 01 00 00 00 00 00
        1 <- 7E5 17 00 00 00 00 00 00 00
        1 -> 7E4 17 01 00 00 00 00 00 00
        2 read 1 2101:02 = 01
    """,
        Bench(changes=QUIET, read_only=True),
    )


def test_the_stored_eds_is_the_file_byte_for_byte() -> None:
    bench = Bench(changes=QUIET)
    assert bench.read(0x1021) == shipped("eds/kontronik_esc.eds").read_bytes()
    assert bench.number(0x1022) == 0
