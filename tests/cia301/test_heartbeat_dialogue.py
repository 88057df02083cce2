"""Heartbeat: the producer's period and states (1017h), the watch over other nodes (1016h, 8130h, 1029h:1)."""

import pytest
from dialogue import MS, NO_HEARTBEAT, NO_PDOS, QUIET, Bench, default, play

WATCHING = {**QUIET, **default(0x1016, 1, 0x000500C8)}
"""Node 5 is watched, 200 ms."""
LOST = "081 30 81 11 FF 05 00 00 00"
GONE = "081 00 00 00 FF 00 00 00 00"


# --- producer


def test_the_boot_up_message_is_the_first_heartbeat_and_the_period_is_kept() -> None:
    play(
        """
        0 -> 701 00
        100 -> 701 7F
        200 -> 701 7F
        300 -> 701 7F
        399 -
    """,
        Bench(changes={**NO_PDOS, **default(0x1017, 0, 100)}, boot=False),
    )


def test_a_changed_period_holds_from_the_moment_it_is_written() -> None:
    play(
        """
        1000 -> 701 7F
        1300 write 1 1017:00 F4 01
        1800 -> 701 7F
        2300 -> 701 7F
        2400 write 1 1017:00 00 00       ; none any more
        9000 write 1 1017:00 0A 00
        9010 -> 701 7F
        9020 -> 701 7F
        9025 <- 000 81 01                ; back to the default
        9025 -> 701 00
       10025 -> 701 7F
    """,
        Bench(changes=NO_PDOS),
    )


def test_a_heartbeat_tells_the_state_at_its_time_and_a_change_sends_none() -> None:
    play(
        """
         999 <- 000 01 01
        1000 -> 701 05
        1001 <- 000 02 01
        1999 <- 000 80 01
        2000 -> 701 7F
        2999 <- 000 02 01
        3000 -> 701 04
    """,
        Bench(changes=NO_PDOS),
    )


def test_missed_ticks_are_not_made_up_for() -> None:
    bench = Bench(changes=NO_PDOS)
    bench.gateway.advance(5500 * MS)  # the program hung
    assert [frame.can_id for frame in bench.gateway.take_frames()] == [0x701]
    bench.now = 5500 * MS
    bench.talk("""
        6499 -
        6500 -> 701 7F
        7500 -> 701 7F
    """)


def test_a_short_delay_does_not_shift_the_following_heartbeats() -> None:
    bench = Bench(changes=NO_PDOS)
    bench.gateway.advance(1300 * MS)
    assert [f.can_id for f in bench.gateway.take_frames()] == [0x701]
    bench.now = 1300 * MS
    bench.talk("""
        2000 -> 701 7F
        3000 -> 701 7F
    """)


# --- consumer


def test_the_watch_begins_with_the_first_heartbeat() -> None:
    play("10000 -", Bench(changes=WATCHING))


def test_a_heartbeat_that_stays_away_is_told_once_and_its_return_ends_the_error() -> None:
    play(
        f"""
         100 <- 705 00
         299 <- 705 7F
         499 -> {LOST}
         500 read 1 1001:00 = 11
         500 read 1 1003:01 = 30 81 FF 05
        5000 -
        5000 <- 705 05
        5000 -> {GONE}
        5001 read 1 1001:00 = 00
        5200 -> {LOST}
    """,
        Bench(changes=WATCHING),
    )


@pytest.mark.parametrize("data", ["", "05 00", "05 00 00 00 00 00 00 00"])
def test_a_message_of_a_wrong_length_is_no_heartbeat(data: str) -> None:
    play(
        f"""
        100 <- 705 05
        250 <- 705 {data}
        300 -> {LOST}
        400 <- 705 {data}
        500 -
    """,
        Bench(changes=WATCHING),
    )


def test_two_nodes_are_watched_apart() -> None:
    play(
        """
          0 <- 705 05
          0 <- 706 05
        200 -> 081 30 81 11 FF 05 00 00 00
        300 -> 081 30 81 11 FF 06 00 00 00
        400 <- 705 05
        450 <- 706 05
        450 -> 081 00 00 00 FF 00 00 00 00
    """,
        Bench(changes={**WATCHING, **default(0x1016, 2, 0x0006012C)}),
    )


def test_entries_of_1016h() -> None:
    play("""
        0 write 1 1016:01 C8 00 05 00
        1 write 1 1016:02 64 00 05 00 ! 06040043       ; node 5 is watched by the other entry
        1 write 1 1016:02 00 00 05 00                  ; a time of 0: unused
        1 write 1 1016:02 64 00 00 00                  ; node-ID 0: unused
        1 write 1 1016:02 64 00 80 00                  ; node-ID 128: unused
        1 write 1 1016:01 2C 01 05 00                  ; its own entry may change
        1 write 1 1016:01 2C 01 05 01 ! 06090031       ; above the EDS's limit: reserved bits
        1 write 1 1016:03 00 00 00 00 ! 06090011
        1 write 1 1016:00 01 ! 06010002
        2 read 1 1016:01 = 2C 01 05 00
    """)


def test_a_change_of_one_entry_leaves_the_watch_of_the_other_alone() -> None:
    play(
        f"""
          0 <- 705 05
        100 write 1 1016:02 2C 01 06 00
        200 -> {LOST}                                  ; as if nothing had been written
        300 write 1 1016:02 90 01 06 00
        310 -                                          ; and it is still lost
        400 <- 705 05
        400 -> {GONE}
    """,
        Bench(changes=WATCHING),
    )


def test_an_entry_that_is_taken_away_takes_its_error_with_it() -> None:
    play(
        f"""
          0 <- 705 05
        200 -> {LOST}
        300 write 1 1016:01 00 00 00 00
        300 -> {GONE}
        400 <- 705 05
        900 -
    """,
        Bench(changes=WATCHING),
    )


def test_a_reset_begins_the_watch_anew_without_the_old_error() -> None:
    play(
        f"""
          0 <- 705 05
        200 -> {LOST}
        300 <- 000 82 01
        300 -> 701 00
        301 read 1 1001:00 = 00
        900 -
        901 <- 705 05
       1101 -> {LOST}
    """,
        Bench(changes=WATCHING),
    )


@pytest.mark.parametrize(
    ("behaviour", "before", "after"),
    [(0, 1, 127), (0, 2, 4), (0, 128, 127), (1, 1, 5), (1, 128, 127), (2, 1, 4), (2, 128, 4), (2, 2, 4)],
)
def test_1029h_1_says_what_follows_a_lost_heartbeat(behaviour: int, before: int, after: int) -> None:
    bench = Bench(changes={**WATCHING, **default(0x1029, 1, behaviour)})
    bench.put(0, bytes((before, 1)))
    bench.put(0x705, "05")
    bench.wait(201)
    assert bench.nodes[0].state == after
    codes = [frame.data[:2].hex() for frame in bench.take()]
    assert codes == ([] if before == 2 else ["3081"])  # none while STOPPED


def test_a_loss_while_stopped_is_told_when_the_node_leaves_stopped() -> None:
    play(
        f"""
          0 <- 705 05
          1 <- 000 02 01
        500 -
        600 <- 000 80 01
        600 -> {LOST}
    """,
        Bench(changes=WATCHING),
    )


def test_a_stored_watch_survives_a_reset_and_is_of_this_node_only() -> None:
    bench = play(
        """
          0 write 2 1016:01 C8 00 05 00
          1 write 2 1010:02 73 61 76 65
          2 <- 000 81 00
          2 -> 701 00
          2 -> 702 00
         10 <- 705 05
        210 -> 082 30 81 11 FF 05 00 00 00
        900 -
    """,
        Bench(2, changes=QUIET),
    )
    assert 0x705 in bench.gateway.receive_ids


def test_other_peoples_heartbeats_are_not_listened_to() -> None:
    assert Bench(changes=NO_HEARTBEAT).listened_to == {0, 0x80, 0x601, 0x7E5}


def test_a_node_may_watch_another_of_the_same_gateway() -> None:
    """What a gateway sends does not come back to it from the bus."""
    bench = Bench(2, changes={**NO_PDOS, **default(0x1017, 0, 100)})
    play(
        """
        50 write 2 1017:00 00 00
        60 write 2 1016:01 96 00 01 00   ; node 2 watches node 1, 150 ms
       100 -> 701 7F
       200 -> 701 7F
       210 write 1 1017:00 00 00
       350 -> 082 30 81 11 FF 01 00 00 00
       400 <- 000 82 01
       400 -> 701 00
       400 -> 082 00 00 00 FF 00 00 00 00
       500 -> 701 7F
    """,
        bench,
    )
