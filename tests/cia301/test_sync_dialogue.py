"""SYNC, consumer side: 1005h, the counter of 1019h, the start value, and 8240h for a wrong length."""

import pytest
from dialogue import QUIET, Bench, default, play

SYNCHRONOUS = {
    **QUIET,
    **default(0x1800, 1, 0x40000180, relative=True),
    **default(0x1800, 2, 1),
    **default(0x1800, 3, 0),
    **default(0x1A00, 0, 1),
    **default(0x1A00, 1, 0x20200208),
}
"""TPDO 1 of type 1 with the live counter."""
WRONG = "081 40 82 11 FF 00 00 00 00"
GONE = "081 00 00 00 FF 00 00 00 00"


def test_every_sync_is_answered_by_a_pdo_of_type_1_in_operational_only() -> None:
    play(
        """
         0 <- 080
        10 <- 000 01 01
        20 <- 080
        20 -> 181 00
        30 <- 080
        30 -> 181 00
        40 <- 000 80 01
        50 <- 080
        60 <- 000 02 01
        70 <- 080
        80 -
    """,
        Bench(changes=SYNCHRONOUS),
    )


def test_the_cob_id_of_1005h_is_listened_to_at_once() -> None:
    bench = Bench(changes=SYNCHRONOUS)
    bench.start()
    bench.talk("""
        0 write 1 1005:00 81 00 00 00 ! 06040043     ; the node's own EMCY
        0 write 1 1005:00 81 01 00 00 ! 06040043     ; its own TPDO
        0 write 1 1005:00 80 00 00 00
        1 write 1 1005:00 90 00 00 00
        2 <- 080
        3 <- 090
        3 -> 181 00
        4 <- 000 82 01
        4 -> 701 00
        5 read 1 1005:00 = 80 00 00 00
    """)
    assert bench.listened_to == {0, 0x80, 0x601, 0x7E5}


@pytest.mark.parametrize(
    "value",
    [
        0x40000080,
        0x20000080,
        0x00000800,
        0x10000080,
        0x000,
        0x07F,
        0x101,
        0x180,
        0x581,
        0x5FF,
        0x601,
        0x67F,
        0x6E0,
        0x701,
        0x7FF,
    ],
)
def test_producers_29_bit_ids_reserved_bits_and_restricted_ids_are_refused(value: int) -> None:
    bench = Bench(changes=QUIET)
    assert bench.write(0x1005, 0, value) == 0x06090030
    assert bench.number(0x1005) == 0x80


def test_bit_31_of_1005h_means_nothing() -> None:
    play(
        """
        0 write 1 1005:00 80 00 00 80
        1 <- 000 01 01
        2 <- 080
        2 -> 181 00
    """,
        Bench(changes=SYNCHRONOUS),
    )


def test_a_sync_of_a_wrong_length_is_told_once_and_causes_no_pdo() -> None:
    play(
        f"""
         0 <- 000 01 01
        10 <- 080 01
        10 -> {WRONG}
        20 <- 080 00 00
        30 <- 080
        30 -> {GONE}
        30 -> 181 00
    """,
        Bench(changes=SYNCHRONOUS),
    )


def test_with_a_counter_the_length_is_one() -> None:
    play(
        f"""
         0 write 1 1019:00 0A
         0 <- 000 01 01
        10 <- 080 01
        10 -> 181 00
        20 <- 080
        20 -> {WRONG}
        30 <- 080 02 03
        40 <- 080 02
        40 -> {GONE}
        40 -> 181 00
    """,
        Bench(changes=SYNCHRONOUS),
    )


def test_a_wrong_length_is_told_in_pre_operational_too_and_forgotten_at_a_reset() -> None:
    play(
        f"""
         0 <- 080 01
         0 -> {WRONG}
        10 <- 000 82 01
        10 -> 701 00
        11 read 1 1001:00 = 00
        20 <- 000 02 01
        21 <- 080 01
        30 -
    """,
        Bench(changes=QUIET),
    )


def test_counter_overflow_values() -> None:
    play("""
        0 write 1 1019:00 01 ! 06090030
        0 write 1 1019:00 F1 ! 06090031
        0 write 1 1019:00 02
        0 write 1 1019:00 F0
        0 write 1 1019:00 00
    """)


def test_types_2_to_240_send_with_every_nth_sync() -> None:
    bench = Bench(changes={**SYNCHRONOUS, **default(0x1800, 2, 240)})
    bench.start()
    for _ in range(3):
        for _ in range(239):
            bench.put(0x80, "")
        assert bench.take() == []
        bench.put(0x80, "")
        assert [frame.can_id for frame in bench.take()] == [0x181]


def test_the_count_of_syncs_begins_anew_with_operational() -> None:
    play(
        """
        0 <- 000 01 01
        1 <- 080
        2 <- 080
        3 <- 000 80 01
        4 <- 000 01 01
        5 <- 080
        6 <- 080
        7 <- 080
        7 -> 181 00
    """,
        Bench(changes={**SYNCHRONOUS, **default(0x1800, 2, 3)}),
    )


def test_the_start_value_makes_its_sync_the_first() -> None:
    play(
        """
        0 write 1 1019:00 0A
        0 <- 000 01 01
        1 <- 080 02
        2 <- 080 03
        3 <- 080 04                ; the first
        4 <- 080 05
        4 -> 181 00
        5 <- 080 06
        6 <- 080 07
        6 -> 181 00
    """,
        Bench(changes={**SYNCHRONOUS, **default(0x1800, 2, 2), **default(0x1800, 6, 4)}),
    )


def test_the_start_value_means_nothing_without_a_counter() -> None:
    play(
        """
        0 <- 000 01 01
        1 <- 080
        1 -> 181 00
    """,
        Bench(changes={**SYNCHRONOUS, **default(0x1800, 6, 4)}),
    )


def test_type_0_sends_with_the_sync_after_an_event_only() -> None:
    play(
        """
         0 <- 000 01 01
         1 <- 080
         1 -> 181 00               ; the start counts as news
         2 <- 080
        10 uart 0 live
        11 uart 0 live
        12 <- 080
        12 -> 181 02
        13 <- 080
        14 uart 0 live
        15 <- 080
        15 -> 181 03
        16 <- 080
    """,
        Bench(changes={**SYNCHRONOUS, **default(0x1800, 2, 0)}),
    )


def test_one_sync_serves_all_nodes() -> None:
    play(
        """
        0 <- 000 01 00
        1 <- 080
        1 -> 181 00
        1 -> 182 00
    """,
        Bench(2, changes=SYNCHRONOUS),
    )


def test_a_sync_pdo_with_live_values_stays_away_while_telemetry_is_lost() -> None:
    changes = {**SYNCHRONOUS, **default(0x1A00, 1, 0x20000210)}
    play(
        """
          0 <- 000 01 00
          1 <- 080
         10 uart 0 live battery_voltage=2442
         20 <- 080
         20 -> 181 8A 09
        260 -> 081 10 75 01 FF 01 00 00 00
        300 <- 080
        310 uart 0 live battery_voltage=2443
        310 -> 081 00 00 00 FF 00 00 00 00
        320 <- 080
        320 -> 181 8B 09
    """,
        Bench(changes=changes),
    )
