"""Transmit PDOs: types, inhibit time, event timer, parameters and their rules, remapping, what happens on telemetry loss."""

from typing import Any

import pytest
from dialogue import MS, NO_HEARTBEAT, OFF, QUIET, SPARE, Bench, Changes, changed, default, live, play, shipped_eds

from kontronik_can_gw.cia301.eds import Eds
from kontronik_can_gw.cia301.pdo import message_plan, restricted
from kontronik_can_gw.dbc_output.layout import Layout

VALUE, TAKEN, NOT_MAPPABLE, TOO_LONG = 0x06090030, 0x06040043, 0x06040041, 0x06040042


def one(cob_id: int = 0x40000180, type_: int = 254, inhibit: int = 0, timer: int = 0, *mapped: int) -> Changes:
    """A quiet node with TPDO 1 only, mapped to battery voltage where nothing is named."""
    mapped = mapped or (0x20000210,)
    changes: dict[tuple[int, int], Any] = {**QUIET}
    for index, sub, value in (
        (0x1800, 1, cob_id),
        (0x1800, 2, type_),
        (0x1800, 3, inhibit),
        (0x1800, 5, timer),
        (0x1A00, 0, len(mapped)),
        *((0x1A00, n, entry) for n, entry in enumerate(mapped, 1)),
    ):
        changes.update(default(index, sub, value))
    changes.update(default(0x1800, 1, cob_id, relative=not cob_id >> 31))
    return changes


# --- transmission


def test_the_four_default_pdos_of_a_flight() -> None:
    bench = Bench(changes=NO_HEARTBEAT)
    bench.start()
    bench.talk("""
        10 uart 0 live electrical_speed=66051 battery_voltage=2442 battery_current=-2 motor_current=3 peak_current=4 \
consumed_charge=5 bec_current=6 bec_voltage=7 pwm_input=8 throttle=-9 output_opening=10 power_stage_temperature=-11 \
bec_temperature=12 operating_errors=131072 operating_state=26 timing=13
        10 -> 181 03 02 01 00 8A 09 FE FF              ; speed, voltage, battery current
        10 -> 281 03 00 04 00 05 00 F7 0A              ; motor current, peak current, charge, throttle, opening
        10 -> 381 07 00 08 00 06 00 F5 0C              ; BEC voltage, PWM input, BEC current, temperatures
        10 -> 481 00 00 02 00 1A 0D 02 01              ; errors, state, timing, link status, live counter
        30 -
    """)


def test_inhibit_times_hold_back_and_the_newest_value_goes_out() -> None:
    play(
        """
        10 uart 0 live battery_voltage=1
        10 -> 181 01 00
        15 uart 0 live battery_voltage=2
        20 uart 0 live battery_voltage=3
        30 -> 181 03 00                                ; 20 ms after the first
        49 -                                           ; nothing new
        70 uart 0 live battery_voltage=4
        70 -> 181 04 00
    """,
        Bench(changes=one(inhibit=200)).start(),
    )


def test_the_event_timer_repeats_and_counts_from_the_last_transmission() -> None:
    play(
        """
         10 uart 0 live battery_voltage=1
         10 -> 181 01 00
         60 -> 181 01 00
         90 uart 0 live battery_voltage=2
         90 -> 181 02 00
        140 -> 181 02 00
        150 write 1 1800:05 00 00
        240 -
    """,
        Bench(changes=one(timer=50)).start(),
    )


def test_an_inhibit_time_longer_than_the_event_timer_wins() -> None:
    play(
        """
          0 uart 0 live
          0 -> 181 00 00
        100 -> 181 00 00
        200 -> 181 00 00
        240 -
    """,
        Bench(changes=one(inhibit=1000, timer=30)).start(),
    )


def test_the_event_timer_does_not_run_for_synchronous_types() -> None:
    play("0 uart 0 live\n 200 -", Bench(changes=one(type_=1, timer=30)).start())


def test_type_255_is_sent_like_254() -> None:
    play("1 uart 0 live\n 1 -> 181 00 00\n 100 -", Bench(changes=one(type_=255)).start())


def test_the_start_of_the_node_sends_event_driven_pdos_once() -> None:
    play(
        """
        0 uart 0 live battery_voltage=1
        1 <- 000 01 01
        1 -> 181 01 00
        2 <- 000 80 01
        3 <- 000 01 01
        3 -> 181 01 00                                 ; the inhibit time does not reach over a stop
        90 -
    """,
        Bench(changes=one(inhibit=1000)),
    )


def test_reserved_and_remote_types_are_refused() -> None:
    bench = _quiet_bench()
    for kind in range(256):
        allowed = kind <= 240 or kind >= 254
        assert bench.write(0x1800, 2, kind, size=1) == (None if allowed else VALUE), kind


_KEPT: list[Bench] = []


def _quiet_bench() -> Bench:
    """One bench for tests that only ask."""
    if not _KEPT:
        _KEPT.append(Bench(changes={**QUIET, **SPARE}))
    return _KEPT[0]


def test_a_type_made_synchronous_takes_back_what_the_inhibit_time_held() -> None:
    play(
        """
         0 uart 0 live battery_voltage=1
         0 -> 181 01 00
         5 uart 0 live battery_voltage=2
         6 write 1 1800:02 01
       140 -
       150 <- 080
       150 -> 181 02 00
       160 write 1 1800:02 FE
       170 uart 0 live battery_voltage=3
       250 -> 181 03 00
    """,
        Bench(changes=one(inhibit=1000)).start(),
    )


def test_all_pdos_that_a_uart_frame_causes_carry_that_frame() -> None:
    mapped = {
        **NO_HEARTBEAT,
        **{(0x1800 + n, 3): {"default": 0} for n in range(4)},
        **{(0x1A00 + n, 0): {"default": 1} for n in range(4)},
        **{(0x1A00 + n, 1): {"default": 0x20000120} for n in range(4)},
    }
    bench = Bench(changes=mapped).start()
    speeds = range(1, 200)
    bench.gateway.receive_bytes(0, b"".join(live(electrical_speed=s) for s in speeds[:20]), 10 * MS)  # in one read
    for speed in speeds[20:]:
        bench.now += 10 * MS
        bench.uart(live(electrical_speed=speed))
    frames = bench.gateway.take_frames() + bench.take()
    told = [(f.can_id, int.from_bytes(f.data, "little")) for f in frames if len(f.data) == 4]
    assert told == [(0x181 + 0x100 * n, speed) for speed in speeds for n in range(4)]


def test_read_by_sdo_and_sent_by_pdo_are_the_same() -> None:
    bench = Bench(changes=NO_HEARTBEAT).start()
    bench.uart(live(electrical_speed=1000, battery_voltage=2000, battery_current=-30))
    frame = bench.take()[0]
    parts = [bench.read(0x2000, sub) for sub in (1, 2, 3)]
    assert frame.data == b"".join(p for p in parts if isinstance(p, bytes))


# --- the status PDO


def test_the_status_pdo_is_sent_on_change_only_and_by_its_event_timer() -> None:
    play(
        """
          10 uart 0 live operating_state=12 timing=1
          10 -> 481 00 00 00 00 0C 01 02 01
          20 uart 0 live operating_state=12 timing=2     ; no change of a status
          30 uart 0 live operating_state=26 timing=3
          30 -> 481 00 00 00 00 1A 03 02 03
          40 uart 0 live operating_state=26 operating_errors=8
          40 -> 081 51 23 03 03 08 00 00 00
          40 -> 481 08 00 00 00 1A 00 02 04
          50 uart 0 live operating_state=26 operating_errors=8
         240 uart 0 live operating_state=26 operating_errors=8
         440 uart 0 live operating_state=26 operating_errors=8
         540 -> 481 08 00 00 00 1A 00 02 07              ; the event timer, with the newest live counter
         640 uart 0 live operating_state=26 operating_errors=0
         640 -> 081 00 00 00 FF 00 00 00 00
         640 -> 481 00 00 00 00 1A 00 02 08
    """,
        Bench(changes={**NO_HEARTBEAT, **_off(0, 1, 2)}).start(),
    )


def _off(*numbers: int) -> Changes:
    return {(0x1800 + n, 1): {"default": OFF, "relative": False} for n in numbers}


def test_a_change_within_the_inhibit_time_of_a_status_pdo_is_told_at_its_end() -> None:
    play(
        """
          0 uart 0 live operating_state=1
          0 -> 181 01
         10 uart 0 live operating_state=2
         20 uart 0 live operating_state=3
        100 -> 181 03
        200 uart 0 live operating_state=3
    """,
        Bench(changes=one(0x40000180, 254, 1000, 0, 0x20000F08)).start(),
    )


# --- telemetry loss


def test_on_loss_pdos_1_to_3_stop_and_4_says_lost_and_the_first_good_frame_brings_them_back() -> None:
    play(
        """
           0 uart 0 live battery_voltage=2442 operating_state=26
           0 -> 181 00 00 00 00 8A 09 00 00
           0 -> 281 00 00 00 00 00 00 00 00
           0 -> 381 00 00 00 00 FF FF 00 00
           0 -> 481 00 00 00 00 1A 00 02 01
         250 -> 081 10 75 01 FF 01 00 00 00
         250 -> 481 FF FF FF FF FF FF 04 01
         750 -> 481 FF FF FF FF FF FF 04 01
        1250 -> 481 FF FF FF FF FF FF 04 01
        1300 uart 0 live battery_voltage=2443 operating_state=26
        1300 -> 081 00 00 00 FF 00 00 00 00
        1300 -> 181 00 00 00 00 8B 09 00 00
        1300 -> 281 00 00 00 00 00 00 00 00
        1300 -> 381 00 00 00 00 FF FF 00 00
        1300 -> 481 00 00 00 00 1A 00 02 02
    """,
        Bench(changes=NO_HEARTBEAT).start(),
    )


def test_a_frame_that_was_held_back_is_not_sent_after_the_loss() -> None:
    play(
        """
          0 uart 0 live battery_voltage=1
          0 -> 181 01 00
         10 uart 0 live battery_voltage=2
        260 -> 081 10 75 01 FF 01 00 00 00
        900 -
    """,
        Bench(changes=one(inhibit=5000)).start(),
    )


def test_a_lost_port_stops_live_pdos_at_once() -> None:
    play(
        """
          0 uart 0 live battery_voltage=1
          0 -> 181 01 00
         10 do gateway.port_lost(0, now)
         10 -> 081 10 75 01 FF 03 00 00 00
        100 -
        110 do gateway.port_opened(0, now)
        110 -> 081 10 75 01 FF 01 00 00 00
        120 uart 0 live battery_voltage=2
        120 -> 081 00 00 00 FF 00 00 00 00
        120 -> 181 02 00
    """,
        Bench(changes=one()).start(),
    )


@pytest.mark.parametrize(("behaviour", "after"), [(0, 127), (1, 5), (2, 4)])
def test_1029h_2_says_what_a_loss_does_to_the_state(behaviour: int, after: int) -> None:
    bench = Bench(changes={**QUIET, **default(0x1029, 2, behaviour)}).start()
    bench.uart(live())
    bench.wait(300)
    assert bench.nodes[0].state == after


def test_a_port_that_is_not_there_from_the_start_is_no_loss_of_telemetry() -> None:
    bench = Bench(changes={**QUIET, **default(0x1029, 2, 2)})
    bench.gateway.port_lost(0, 0)
    assert bench.nodes[0].state == 127


# --- parameters


def test_a_restricted_cob_id_is_refused_and_every_other_accepted() -> None:
    bench = _quiet_bench()
    ours = {0x80, 0x81}
    for cob_id in range(0x800):
        wanted = VALUE if restricted(cob_id) else TAKEN if cob_id in ours else None
        assert bench.write(0x1804, 1, 0x40000000 | cob_id) == wanted, hex(cob_id)
        bench.write(0x1804, 1, OFF)


def test_the_restricted_cob_ids_are_those_of_the_standard() -> None:
    reserved = {
        *range(0x080),
        *range(0x101, 0x181),
        *range(0x581, 0x600),
        *range(0x601, 0x680),
        *range(0x6E0, 0x700),
        *range(0x701, 0x800),
    }
    assert {cob_id for cob_id in range(0x800) if restricted(cob_id)} == reserved


@pytest.mark.parametrize("value", [0x60000190, 0x40000990, 0x50000190, 0x20000190, 0x10000190])
def test_cob_ids_with_29_bits_or_reserved_bits_are_refused(value: int) -> None:
    assert _quiet_bench().write(0x1804, 1, value) == VALUE


def test_a_cob_id_cannot_change_while_the_pdo_exists() -> None:
    play(
        """
        0 write 1 1800:01 90 01 00 40 ! 06090030
        0 write 1 1800:01 81 01 00 40                  ; the same
        1 write 1 1800:01 90 01 00 C0                  ; off, with another id
        2 uart 0 live battery_voltage=1
        3 write 1 1800:01 90 01 00 40                  ; on: begins like at a start
        3 -> 190 01 00
        4 uart 0 live battery_voltage=2
        4 -> 190 02 00
    """,
        Bench(changes=one()).start(),
    )


def test_ids_of_other_pdos_of_all_nodes_and_of_the_dbc_are_taken() -> None:
    layout = Layout("", "", (message_plan("EscPower", 0x222, ()),))
    bench = Bench(2, changes={**NO_HEARTBEAT, **SPARE}, layout=layout)
    for cob_id in (0x181, 0x381, 0x182, 0x482, 0x81, 0x82, 0x80, 0x222):
        assert bench.write(0x1804, 1, 0x40000000 | cob_id) == TAKEN, hex(cob_id)
    assert bench.write(0x1804, 1, 0x40000223) is None
    assert bench.write(0x1804, 1, 0x40000223, node=2) == TAKEN
    assert bench.write(0x1800, 1, 0xC0000181) is None
    assert bench.write(0x1804, 1, 0x40000181, node=2) is None  # it is free now


def test_a_pdo_whose_default_id_was_given_to_another_node_stays_off_after_a_reset() -> None:
    bench = Bench(2, changes={**QUIET, **SPARE, **default(0x1800, 1, 0x40000180, relative=True)})
    assert bench.write(0x1800, 1, 0xC0000182, node=2) is None
    assert bench.write(0x1804, 1, 0x40000182, node=1) is None
    bench.put(0, "82 02")
    assert bench.number(0x1800, 1, node=2) == 0xC0000182
    bench.put(0, "82 01")
    bench.put(0, "82 02")
    assert bench.number(0x1800, 1, node=2) == 0x40000182


def test_a_pdo_moved_to_the_id_of_a_disabled_one_of_the_same_node_is_undone_by_a_reset() -> None:
    bench = Bench(changes=NO_HEARTBEAT)
    assert bench.write(0x1800, 1, 0xC0000181) is None
    assert bench.write(0x1801, 1, 0xC0000181) is None
    assert bench.write(0x1801, 1, 0x40000181) is None
    bench.put(0, "82 01")
    assert [bench.number(0x1800 + n, 1) for n in (0, 1)] == [0x40000181, 0x40000281]


def test_inhibit_time_and_sync_start_value_cannot_change_while_the_pdo_exists_but_timer_and_type_can() -> None:
    play(
        """
        0 write 1 1800:03 0A 00 ! 06090030
        0 write 1 1800:06 05 ! 06090030
        0 write 1 1800:05 0A 00
        0 write 1 1800:02 01
        1 write 1 1800:01 81 01 00 C0
        1 write 1 1800:03 0A 00
        1 write 1 1800:06 05
        1 write 1 1800:06 F1 ! 06090031
        1 write 1 1800:04 00 ! 06090011
    """,
        Bench(changes=one()),
    )


def test_a_start_value_above_240_is_refused_also_where_the_eds_has_no_limit() -> None:
    bench = Bench(changes={**QUIET, (0x1800, 6): {"high": None}})
    assert bench.write(0x1800, 6, 241, size=1) == VALUE


# --- mapping


def test_the_procedure_of_remapping() -> None:
    play(
        """
        0 uart 0 live battery_voltage=2442 operating_state=26
        0 -> 181 8A 09
        1 write 1 1800:01 81 01 00 C0                  ; 1 the PDO off
        2 uart 0 live battery_voltage=2442 operating_state=26
        3 write 1 1A00:00 00                           ; 2 no entries
        3 write 1 1A00:01 08 0F 00 20                  ; 3 the entries
        3 write 1 1A00:02 10 02 00 20
        3 write 1 1A00:00 02                           ; 4 how many
        4 write 1 1800:01 81 01 00 40                  ; 5 the PDO on
        4 -> 181 1A 8A 09
        5 uart 0 live battery_voltage=2443 operating_state=26
        9 -                                            ; it carries a status now: sent on change
       10 uart 0 live battery_voltage=2443 operating_state=25
       10 -> 181 19 8B 09
    """,
        Bench(changes=one()).start(),
    )


def test_abort_codes_of_mapping() -> None:
    play(
        """
        0 write 1 1A00:00 00 ! 06010000                ; the PDO exists
        0 write 1 1A00:01 10 02 00 20 ! 06010000
        1 write 1 1800:01 81 01 00 C0
        1 write 1 1A00:01 10 02 00 20 ! 06010000       ; sub-index 0 is not 0
        1 write 1 1A00:00 00
        2 write 1 1A00:01 10 02 00 30 ! 06020000       ; no such object
        2 write 1 1A00:01 10 11 00 20 ! 06090011       ; no such sub-index
        2 write 1 1A00:01 08 00 00 20 ! 06040041       ; not mappable: the count
        2 write 1 1A00:01 20 01 02 21 ! 06040041       ; write only
        2 write 1 1A00:01 10 00 17 10 ! 06040041       ; not mappable by the EDS
        2 write 1 1A00:01 08 02 00 20 ! 06040041       ; not its length
        2 write 1 1A00:01 20 02 00 20 ! 06040041
        2 write 1 1A00:01 08 00 05 00 ! 06020000       ; dummy mapping is for RPDOs
        3 write 1 1A00:01 20 01 00 20
        3 write 1 1A00:02 20 0E 00 20
        3 write 1 1A00:03 08 0F 00 20
        3 write 1 1A00:04 00 00 00 00
        3 write 1 1A00:00 03 ! 06040042                ; 72 bits
        3 write 1 1A00:00 04 ! 06020000                ; an entry that maps nothing
        3 write 1 1A00:00 09 ! 06090031                ; more than there are
        3 write 1 1A00:09 00 00 00 00 ! 06090011
        4 write 1 1A00:00 02
        4 read 1 1A00:00 = 02
    """,
        Bench(changes=one()),
    )


def test_more_entries_than_there_are_is_06040042h_where_the_eds_has_no_limit() -> None:
    bench = Bench(changes={**QUIET, (0x1A00, 0): {"high": None, "default": 0}})
    for count in (9, 254, 255):
        assert bench.write(0x1A00, 0, count, size=1) == TOO_LONG


def test_each_mappable_object_can_be_sent_and_carries_what_sdo_reads() -> None:
    bench = Bench(changes={**QUIET, **default(0x2100, 5, 2)})
    bench.uart(live(electrical_speed=66051, battery_voltage=2442, bec_current=5, operating_state=26, throttle=-5))
    bench.start()
    tried = 0
    for entry in shipped_eds().entries:
        if not entry.mappable:
            continue
        data = bench.read(entry.index, entry.sub)
        assert isinstance(data, bytes)
        assert bench.write(0x1800, 1, 0xC0000181) is None
        assert bench.write(0x1A00, 0, b"\0") is None
        assert bench.write(0x1A00, 1, entry.index << 16 | entry.sub << 8 | 8 * len(data)) is None
        assert bench.write(0x1A00, 0, b"\1") is None
        assert bench.write(0x1800, 1, 0x40000181) is None
        (frame,) = bench.take()
        assert (frame.can_id, frame.data) == (0x181, data), f"{entry.index:04X}:{entry.sub:02X}"
        tried += 1
    assert tried > 40


def _with_storage(data_type: int, value: float = 0) -> Eds:
    """2002h:1 as a mappable object that can be written."""
    return changed(
        shipped_eds(), {(0x2002, 1): {"data_type": data_type, "mappable": True, "access": "rw", "default": value}}
    )


@pytest.mark.parametrize(
    ("data_type", "values"),
    [
        (0x05, ["00", "FF", "7F"]),
        (0x02, ["80", "7F", "FF"]),
        (0x06, ["FF FF", "34 12"]),
        (0x03, ["00 80", "FF FF"]),
        (0x07, ["FF FF FF FF", "78 56 34 12"]),
        (0x04, ["00 00 00 80", "FF FF FF FF"]),
        (0x08, ["00 00 C0 BF", "00 00 80 7F", "00 00 C0 3F"]),  # REAL32: -1.5, infinity, 1.5
        (0x11, ["00 00 00 00 00 00 F8 BF"]),
        (0x1B, ["FF FF FF FF FF FF FF FF", "08 07 06 05 04 03 02 01"]),
        (0x15, ["00 00 00 00 00 00 00 80"]),
    ],
)
def test_a_plain_object_in_a_pdo_is_sent_when_it_is_written(data_type: int, values: list[str]) -> None:
    size = len(bytes.fromhex(values[0]))
    bench = Bench(
        eds=_with_storage(data_type),
        changes=one(0x40000180, 254, 0, 0, 0x20020100 | 8 * size, 0x20020100 | 8 * size)
        if size < 8
        else one(0x40000180, 254, 0, 0, 0x20020140),
    )
    bench.start()
    for value in values:
        data = bytes.fromhex(value)
        assert bench.write(0x2002, 1, data) is None
        assert [frame.data for frame in bench.take()] == [data + data if size < 8 else data]


def test_a_boolean_takes_one_bit() -> None:
    bench = Bench(eds=_with_storage(0x01), changes=one(0x40000180, 254, 0, 0, 0x20020101, 0x20020101, 0x20000F08))
    bench.uart(live(operating_state=0xFF))
    bench.start()
    for value, told in ((1, "ff03"), (0, "fc03")):
        assert bench.write(0x2002, 1, value, size=1) is None
        assert [frame.data.hex() for frame in bench.take()] == [told]


def test_a_stored_pdo_without_entries_is_never_sent() -> None:
    changes = {**one(timer=10), **default(0x1A00, 0, 0)}
    play("0 uart 0 live\n 50 <- 080\n 100 -", Bench(changes=changes).start())


def test_gateway_values_follow_the_second() -> None:
    bench = Bench(changes=one(0x40000180, 254, 0, 0, 0x20210808)).start()
    bench.talk("1000 -> 181 01\n 2000 -> 181 01\n 2500 -")


def test_a_node_id_whose_cob_ids_the_dbc_has_is_refused() -> None:
    taken = {0x705: 5, 0x606: 6, 0x587: 7, 0x88: 8, 0x18A: 10}
    layout = Layout("", "", tuple(message_plan(f"M{i}", i, ()) for i in taken))
    bench = Bench(changes=NO_HEARTBEAT, layout=layout)
    for node_id in taken.values():
        assert bench.write(0x2101, 2, node_id, size=1) == TAKEN
    assert bench.write(0x2101, 2, 9, size=1) is None


def test_a_node_id_whose_cob_ids_another_node_chose_is_refused() -> None:
    bench = Bench(2, changes={**NO_HEARTBEAT, **SPARE})
    assert bench.write(0x1805, 1, 0x40000087, node=2) is None
    assert bench.write(0x2101, 2, 7, size=1) == TAKEN
