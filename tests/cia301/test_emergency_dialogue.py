"""Emergencies: every bit of the ESC's error word, the gateway's own findings, 1001h, 1003h, 1014h, 1015h, 1029h:2, 2100h:6."""

import pytest
from dialogue import MS, NO_PDOS, QUIET, Bench, default, info, live, play

from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.protocol.states import Device

NOTHING = "081 00 00 00 FF 00 00 00 00"

# bit: (code, bits of 1001h). 17 has none; 12 and 13 only where nothing explains them.
CODES = {
    0: (0x3220, 0x05),
    1: (0x3210, 0x05),
    2: (0x2350, 0x03),
    3: (0x2351, 0x03),
    4: (0xFF04, 0x81),
    5: (0x4210, 0x09),
    6: (0x5114, 0x01),
    7: (0x5115, 0x01),
    8: (0x2220, 0x03),
    9: (0x4410, 0x09),
    10: (0xFF0A, 0x81),
    11: (0xFF0B, 0x81),
    12: (0x1000, 0x01),
    13: (0xFF0D, 0x81),
    14: (0x5000, 0x01),
    15: (0x5530, 0x01),
    16: (0x6010, 0x01),
    18: (0xFF12, 0x81),
    19: (0xFF13, 0x81),
    20: (0xFF14, 0x81),
    21: (0xFF15, 0x81),
    22: (0xFF16, 0x81),
    23: (0xFF17, 0x81),
}


def emcy(code: int, register: int, source: int, word: int) -> str:
    data = code.to_bytes(2, "little") + bytes((register, source)) + word.to_bytes(4, "little")
    return "081 " + data.hex(" ").upper()


@pytest.mark.parametrize("bit", CODES)
def test_each_bit_has_its_code_and_is_told_once_when_it_rises(bit: int) -> None:
    code, register = CODES[bit]
    word = 1 << bit | 1 << 17
    play(f"""
         0 uart 0 live operating_errors={1 << 17}
        10 uart 0 live operating_errors={word}
        10 -> {emcy(code, register, bit, word)}
        20 uart 0 live operating_errors={word}
        21 read 1 1001:00 = {register:02X}
        21 read 1 1003:00 = 01
        21 read 1 1003:01 = {code & 0xFF:02X} {code >> 8:02X} {bit:02X} 00
        21 read 1 603F:00 = {code & 0xFF:02X} {code >> 8:02X}
        30 uart 0 live operating_errors={1 << 17}
        30 -> {NOTHING}
        40 uart 0 live operating_errors={1 << 17}
        41 read 1 1001:00 = 00
        41 read 1 1003:00 = 01
        41 read 1 603F:00 = 00 00
    """)


@pytest.mark.parametrize("bit", [17, *range(24, 32)])
def test_the_idle_bit_and_unknown_bits_are_no_emergency(bit: int) -> None:
    play(f"""
         0 uart 0 live operating_errors={1 << bit}
        10 read 1 1001:00 = 00
        20 uart 0 live
    """)


@pytest.mark.parametrize(
    ("summary", "bit", "explained"),
    [(12, 0, True), (12, 16, True), (13, 3, True), (13, 23, True), (12, 3, False), (13, 0, False), (12, 10, False)],
)
def test_a_summary_bit_is_told_only_where_no_other_bit_explains_it(summary: int, bit: int, explained: bool) -> None:
    bench = Bench(changes=QUIET)
    bench.uart(live(operating_errors=1 << summary | 1 << bit))
    told = {int.from_bytes(frame.data[:2], "little") for frame in bench.take()}
    assert told == {CODES[bit][0]} | (set() if explained else {CODES[summary][0]})


def test_both_summary_bits_explain_nothing_of_each_other() -> None:
    word = 1 << 12 | 1 << 13
    play(f"""
        0 uart 0 live operating_errors={word}
        0 -> {emcy(0x1000, 0x81, 12, word)}
        0 -> {emcy(0xFF0D, 0x81, 13, word)}
    """)


def test_0000h_comes_when_the_last_error_is_gone_and_not_before() -> None:
    play(f"""
         0 uart 0 live operating_errors=3
         0 -> {emcy(0x3220, 0x05, 0, 3)}
         0 -> {emcy(0x3210, 0x05, 1, 3)}
        10 uart 0 live operating_errors=2                  ; one of two is gone: silence
        20 uart 0 live operating_errors=4                  ; one goes, another comes
        20 -> {emcy(0x2350, 0x03, 2, 4)}
        30 uart 0 live
        30 -> {NOTHING}
        40 uart 0 live operating_errors=4                  ; a new edge
        40 -> {emcy(0x2350, 0x03, 2, 4)}
    """)


# --- the mask 2100h:6


def test_the_mask_silences_bits_and_takes_warnings_out_of_1001h_but_not_errors() -> None:
    play(f"""
         0 write 1 2100:06 F6 FF FF 00                     ; not 0 (error), not 3 (warning)
         1 uart 0 live operating_errors=1
         2 read 1 1001:00 = 05
         2 read 1 1003:00 = 00
         3 uart 0 live operating_errors=8
         4 read 1 1001:00 = 00
         5 write 1 2100:06 FF FF FF 00                     ; now it is told
         5 -> {emcy(0x2351, 0x03, 3, 8)}
         6 write 1 2100:06 00 00 00 00
         6 -> {NOTHING}
         7 read 1 1001:00 = 00
    """)


def test_a_masked_bit_still_explains_its_summary() -> None:
    play("""
        0 write 1 2100:06 FE FF FD 00
        1 uart 0 live operating_errors=4097
        9 -
    """)


def test_unknown_bits_are_told_where_the_mask_says_so() -> None:
    word = 1 << 24
    play(f"""
        0 write 1 2100:06 FF FF FF FF
        1 uart 0 live operating_errors={word}
        1 -> {emcy(0xFF18, 0x81, 24, word)}
        2 uart 0 live operating_errors={word | 1 << 17}    ; asked for
        2 -> {emcy(0xFF11, 0x81, 17, word | 1 << 17)}
    """)


# --- history


def test_the_history_has_the_newest_first_keeps_eight_and_can_be_cleared() -> None:
    bench = Bench(changes=QUIET)
    assert bench.read(0x1003, 1) == 0x08000024
    codes = []
    for bit in (0, 1, 2, 5, 6, 7, 8, 9, 14, 15):
        bench.uart(live(operating_errors=1 << bit))
        codes.append(CODES[bit][0] | bit << 16)
    assert bench.number(0x1003) == 8
    assert [bench.number(0x1003, sub) for sub in range(1, 9)] == codes[:1:-1]
    assert bench.write(0x1003, 0, 1, size=1) == 0x06090030
    assert bench.write(0x1003, 1, 0) == 0x06010002
    assert bench.number(0x1003) == 8
    assert bench.write(0x1003, 0, 0, size=1) is None
    assert bench.number(0x1003) == 0
    assert bench.read(0x1003, 1) == 0x08000024
    assert bench.number(0x1001) == 0x01  # what is wrong stays so


def test_a_reset_tells_anew_what_is_wrong_and_the_history_holds_just_that() -> None:
    play(f"""
         0 uart 0 live operating_errors=1
         0 -> {emcy(0x3220, 0x05, 0, 1)}
         1 uart 0 live operating_errors=2
         1 -> {emcy(0x3210, 0x05, 1, 2)}
         2 <- 000 82 01
         2 -> 701 00
         2 -> {emcy(0x3210, 0x05, 1, 2)}
         3 read 1 1003:00 = 01
         3 read 1 1003:01 = 10 32 01 00
         4 <- 000 81 01
         4 -> 701 00
         4 -> {emcy(0x3210, 0x05, 1, 2)}
         5 uart 0 live
         5 -> {NOTHING}
    """)


def test_a_reset_of_the_node_tells_nothing_before_the_boot_up() -> None:
    play(f"""
         0 write 1 2100:06 00 00 00 00
         1 uart 0 live operating_errors=1
         2 <- 000 01 01
         3 <- 000 81 01                                    ; brings the mask back
         3 -> 701 00
         3 -> {emcy(0x3220, 0x05, 0, 1)}
    """)


# --- 1014h


def test_the_cob_id_of_1014h_and_its_valid_bit() -> None:
    play("""
        0 read 1 1014:00 = 81 00 00 00
        0 write 1 1014:00 90 00 00 00 ! 06090030           ; it is valid: bits 0..30 stay
        0 write 1 1014:00 81 00 00 00
        1 write 1 1014:00 81 00 00 80
        2 uart 0 live operating_errors=1                   ; not sent
        3 read 1 1003:00 = 01
        4 write 1 1014:00 90 00 00 00
        5 uart 0 live operating_errors=2
        5 -> 090 10 32 05 01 02 00 00 00
        6 write 1 1014:00 91 00 00 80
        7 <- 000 82 01
        7 -> 701 00
        7 -> 081 10 32 05 01 02 00 00 00
    """)


@pytest.mark.parametrize(
    ("value", "code"),
    [
        (0x20000090, 0x06090030),
        (0x40000090, 0x06090030),
        (0x00000890, 0x06090030),
        (0x00000000, 0x06090030),
        (0x0000007F, 0x06090030),
        (0x00000101, 0x06090030),
        (0x00000581, 0x06090030),
        (0x00000601, 0x06090030),
        (0x000006E0, 0x06090030),
        (0x00000701, 0x06090030),
        (0x00000080, 0x06040043),
        (0x00000082, 0x06040043),
        (0x00000090, None),
        (0x800007FF, None),
    ],
)
def test_what_1014h_can_be(value: int, code: int | None) -> None:
    bench = Bench(2, changes=QUIET)
    assert bench.write(0x1014, 0, 0x80000081) is None
    assert bench.write(0x1014, 0, value) == code


# --- 1015h


def test_the_inhibit_time_holds_emergencies_apart_and_loses_none() -> None:
    play(f"""
          0 write 1 1015:00 E8 03                          ; 100 ms
         10 uart 0 live operating_errors=7
         10 -> {emcy(0x3220, 0x07, 0, 7)}
         60 uart 0 live operating_errors=0
        110 -> {emcy(0x3210, 0x07, 1, 7)}
        210 -> {emcy(0x2350, 0x07, 2, 7)}
        240 uart 0 live operating_errors=0
        310 -> {NOTHING}
        400 uart 0 live operating_errors=0
    """)


def test_what_the_inhibit_time_holds_survives_the_start_of_the_node() -> None:
    play(f"""
          0 write 1 1015:00 E8 03
         10 do gateway.receive_overrun(now)
         10 -> 081 10 81 11 FF 00 00 00 00
         20 uart 0 live operating_errors=1
         30 uart 0 live
         40 <- 000 01 01
        110 -> {NOTHING}
        210 -> {emcy(0x3220, 0x05, 0, 1)}
        250 uart 0 live
        310 -> {NOTHING}
    """)


def test_an_inhibit_time_of_0_ends_the_waiting() -> None:
    bench = play(f"""
          0 write 1 1015:00 E8 03
         10 uart 0 live operating_errors=1
         10 -> {emcy(0x3220, 0x05, 0, 1)}
         20 uart 0 live
         30 write 1 1015:00 00 00
         30 -> {NOTHING}
    """)
    assert bench.number(0x1015) == 0


# --- STOPPED


def test_what_came_and_went_while_stopped_is_not_told() -> None:
    play(f"""
         0 <- 000 02 01
         1 uart 0 live operating_errors=1
         2 uart 0 live
         3 uart 0 live operating_errors=2
         4 uart 0 live
         5 uart 0 live operating_errors=2
        10 <- 000 80 01
        10 -> {emcy(0x3210, 0x05, 1, 2)}
        11 <- 000 01 01
        12 uart 0 live
        12 -> {NOTHING}
        13 read 1 1003:00 = 03
    """)


def test_an_error_that_ends_while_stopped_is_taken_back_afterwards() -> None:
    play(f"""
         0 uart 0 live operating_errors=1
         0 -> {emcy(0x3220, 0x05, 0, 1)}
         1 <- 000 02 01
         2 uart 0 live
        10 <- 000 01 01
        10 -> {NOTHING}
    """)


def test_an_error_that_was_never_sent_is_not_taken_back() -> None:
    play("""
          0 write 1 1015:00 E8 03
          1 do gateway.receive_overrun(now)
          1 -> 081 10 81 11 FF 00 00 00 00
        101 -> 081 00 00 00 FF 00 00 00 00
        150 uart 0 live operating_errors=1                 ; waits for the inhibit time
        160 <- 000 02 01
        170 uart 0 live
        180 <- 000 80 01
        390 -
    """)


# --- the gateway's findings


def test_telemetry_lost() -> None:
    play(f"""
          0 uart 0 live
        250 -> 081 10 75 01 FF 01 00 00 00
        251 read 1 1001:00 = 01
        251 read 1 1003:01 = 10 75 FF 01
        300 uart 0 live
        300 -> {NOTHING}
    """)


def test_an_error_bit_outlasts_the_loss_of_telemetry() -> None:
    play(f"""
          0 uart 0 live operating_errors=1
          0 -> {emcy(0x3220, 0x05, 0, 1)}
        250 -> 081 10 75 05 FF 01 00 00 00
        300 uart 0 live operating_errors=1                 ; still so: no 0000h, no second EMCY
        310 uart 0 live
        310 -> {NOTHING}
    """)


def test_an_error_bit_that_is_gone_with_the_first_frame_after_a_loss() -> None:
    play(f"""
          0 uart 0 live operating_errors=1
          0 -> {emcy(0x3220, 0x05, 0, 1)}
        250 -> 081 10 75 05 FF 01 00 00 00
        300 uart 0 live
        300 -> {NOTHING}
    """)


def test_port_gone_and_back() -> None:
    play(f"""
         0 uart 0 live
        10 do gateway.port_lost(0, now)
        10 -> 081 10 75 01 FF 03 00 00 00
        20 do gateway.port_opened(0, now)
        20 -> 081 10 75 01 FF 01 00 00 00                  ; the port is back, telemetry not yet
        30 uart 0 live
        30 -> {NOTHING}
        31 read 1 1003:00 = 02
    """)


def test_a_port_gone_before_the_first_frame() -> None:
    play(f"""
         0 do gateway.port_lost(0, now)
         0 -> 081 10 75 01 FF 03 00 00 00
        10 do gateway.port_opened(0, now)
        10 -> {NOTHING}
    """)


def test_a_rate_of_crc_errors() -> None:
    bench = Bench(changes=QUIET)
    good, bad = live(), live()[:-1] + b"\xff"
    heard = []
    for number in range(350):
        bench.wait(10)
        bench.uart(bad if 100 <= number < 150 and number % 3 == 0 else good)
        heard += [(frame.data[:2].hex(), frame.data[4]) for frame in bench.take()]
    assert heard == [("1075", 2), ("0000", 0)]


def test_another_device_than_configured() -> None:
    bench = Bench(changes=QUIET, device=Device.KOSMIK)
    bench.talk(f"""
         0 uart 0 info device_and_variant={Device.JIVEPRO << 10}
         0 -> 081 10 75 01 FF 04 00 00 00
        10 uart 0 info device_and_variant={Device.JIVEPRO << 10}
        20 uart 0 info device_and_variant={Device.KOSMIK << 10}
        20 -> {NOTHING}
    """)


def test_any_device_where_none_is_configured() -> None:
    play(f"0 uart 0 info device_and_variant={Device.JIVEPRO << 10}\n 100 -")


def test_can_passive_and_bus_off() -> None:
    play(f"""
         0 do bench.can_state("ERROR_ACTIVE")
        10 do bench.can_state("ERROR_WARNING")
        20 do bench.can_state("ERROR_PASSIVE")
        20 -> 081 20 81 11 FF 00 00 00 00
        30 do bench.can_state("ERROR_ACTIVE")
        30 -> {NOTHING}
        40 do bench.can_state("BUS_OFF")
        50 do bench.can_state("ERROR_ACTIVE")
        50 -> 701 00
        50 -> 081 40 81 11 FF 00 00 00 00
        50 -> {NOTHING}
        51 read 1 1003:00 = 01
    """)


def test_bus_off_left_by_way_of_a_restart_of_the_interface() -> None:
    play(f"""
        10 do bench.can_state("BUS_OFF")
        20 do bench.can_state("DOWN")
        30 do bench.can_state("ERROR_ACTIVE")
        30 -> 701 00
        30 -> 081 40 81 11 FF 00 00 00 00
        30 -> {NOTHING}
        40 do bench.can_state("DOWN")
        50 do bench.can_state("ERROR_ACTIVE")
        50 -> 701 00
    """)


@pytest.mark.parametrize(("behaviour", "after"), [(1, "05"), (2, "04")])
def test_with_another_behaviour_a_node_says_its_state_at_once_behind_an_outage_and_does_not_boot(
    behaviour: int, after: str
) -> None:
    told = f"1030 -> 081 40 81 11 FF 00 00 00 00\n        1030 -> {NOTHING}\n" if behaviour == 1 else ""
    play(
        f"""
        10 <- 000 01 01
        1000 -> 701 05
        1010 do bench.can_state("BUS_OFF")
        1030 do bench.can_state("ERROR_ACTIVE")
        {told}        1030 -> 701 {after}
    """,
        Bench(changes={**default(0x1029, 1, behaviour), **NO_PDOS}),
    )


def test_a_self_starting_node_is_operational_again_behind_bus_off() -> None:
    bench = Bench(changes={**QUIET, **default(0x1F80, 0, 0)}).start()
    bench.can_state("BUS_OFF")
    assert bench.nodes[0].state == 127
    bench.can_state("ERROR_ACTIVE")
    assert bench.nodes[0].state == 5


def test_somebody_else_with_an_id_of_the_node_is_told_once_and_taken_back_when_it_has_ceased() -> None:
    bench = Bench(changes=QUIET)
    bench.take()
    for n in range(300):
        bench.wait(20)
        bench.gateway.receive_frame(CanFrame((0x701, 0x081, 0x581)[n % 3], bytes(8)), bench.now)
        bench._collect()
    assert [frame.data[:4] for frame in bench.take()] == [b"\x50\x81\x11\xff"]
    assert bench.gateway.status.id_conflicts == 300
    begun = bench.gateway.take_conflicts()
    assert [(c.can_id, c.over) for c in begun] == [(0x701, False), (0x081, False), (0x581, False)]
    assert begun[0].whose == "the heartbeat of CANopen node 1"
    bench.wait(12_000)
    assert [frame.data for frame in bench.take()] == [bytes((0, 0, 0, 0xFF, 0, 0, 0, 0))]
    assert [(c.can_id, c.count, c.over) for c in bench.gateway.take_conflicts()] == [
        (can_id, 100, True) for can_id in (0x701, 0x081, 0x581)
    ]


def test_what_only_looks_like_an_id_of_the_node_is_no_collision() -> None:
    bench = Bench(changes=QUIET)
    bench.take()
    for frame in (
        CanFrame(0x701, b"", remote=True),
        CanFrame(0x701, b"", extended=True),
        CanFrame(0x601, bytes(8)),
        CanFrame(0x080, b""),
        CanFrame(0x7E4, bytes(8)),
    ):
        bench.gateway.receive_frame(frame, bench.now)
    assert bench.gateway.status.id_conflicts == 0
    assert bench.gateway.take_conflicts() == []


@pytest.mark.parametrize(("behaviour", "after"), [(0, 127), (1, 5), (2, 4)])
def test_bus_off_is_a_communication_error_of_1029h_1(behaviour: int, after: int) -> None:
    bench = Bench(changes={**QUIET, **default(0x1029, 1, behaviour)}).start()
    bench.can_state("BUS_OFF")
    assert bench.nodes[0].state == after


def test_can_passive_before_the_node_has_a_node_id_is_told_when_it_has() -> None:
    play(
        """
        0 do bench.can_state("ERROR_PASSIVE")
        1 <- 7E5 04 01 00 00 00 00 00 00
        2 <- 7E5 11 07 00 00 00 00 00 00
        2 -> 7E4 11 00 00 00 00 00 00 00
        3 <- 7E5 04 00 00 00 00 00 00 00
        3 -> 707 00
        3 -> 087 20 81 11 FF 00 00 00 00
    """,
        Bench(node_ids=[255], changes=QUIET, boot=False),
    )


def test_a_receive_overrun_is_told_and_over_at_most_once_a_second() -> None:
    play(f"""
           0 do gateway.receive_overrun(now)
           0 -> 081 10 81 11 FF 00 00 00 00
           0 -> {NOTHING}
         500 do gateway.receive_overrun(now)
        1000 do gateway.receive_overrun(now)
        1000 -> 081 10 81 11 FF 00 00 00 00
        1000 -> {NOTHING}
    """)


def test_a_damaged_parameter_file_is_told_until_parameters_are_stored() -> None:
    bench = Bench(2, changes=QUIET)
    bench.talk("""
        0 do gateway.parameters_damaged(1, now)
        0 -> 082 00 63 01 FF 00 00 00 00
        1 <- 000 82 02
        1 -> 702 00
        1 -> 082 00 63 01 FF 00 00 00 00
        2 <- 602 23 10 10 01 73 61 76 65
        3 do bench.answer_saves("disk full")
        3 -> 582 80 10 10 01 00 00 06 06
        4 <- 602 23 10 10 01 73 61 76 65
        5 do bench.answer_saves()
        5 -> 082 00 00 00 FF 00 00 00 00
        5 -> 582 60 10 10 01 00 00 00 00
    """)


def test_all_is_told_again_after_an_outage_of_the_bus() -> None:
    play(f"""
         0 uart 0 live operating_errors=1
         0 -> {emcy(0x3220, 0x05, 0, 1)}
        10 do gateway.can_returned(now)
        10 -> {emcy(0x3220, 0x05, 0, 1)}
        20 uart 0 live
        20 -> {NOTHING}
        30 do gateway.can_returned(now)
        30 -> {NOTHING}                                    ; it may have been lost
    """)


def test_what_was_lost_in_an_outage_is_told_when_the_node_leaves_stopped() -> None:
    play(f"""
         0 uart 0 live operating_errors=1
         0 -> {emcy(0x3220, 0x05, 0, 1)}
         1 <- 000 02 01
        10 do gateway.can_returned(now)
        20 <- 000 80 01
        20 -> {emcy(0x3220, 0x05, 0, 1)}
    """)


# --- 1029h:2 and the rest


@pytest.mark.parametrize(("behaviour", "code"), [(0, "1075"), (1, "1075"), (2, "1075")])
def test_the_loss_is_told_before_the_state_changes(behaviour: int, code: str) -> None:
    bench = Bench(changes={**QUIET, **default(0x1029, 2, behaviour)}).start()
    bench.uart(live())
    bench.wait(251)
    assert [frame.data[:2].hex() for frame in bench.take()] == [code]


def test_emergencies_come_with_the_uart_frame_and_before_its_pdos() -> None:
    bench = Bench().start()
    bench.now = 5 * MS
    bench.uart(live(operating_errors=1))
    assert [frame.can_id for frame in bench.take()] == [0x81, 0x181, 0x281, 0x381, 0x481]


def test_an_info_frame_is_no_emergency() -> None:
    bench = Bench(changes=QUIET)
    bench.uart(info(selftest_errors=1))
    assert bench.take() == []
