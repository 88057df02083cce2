"""Network management: boot-up, the five commands, what each state lets through, self-start, several nodes, a node without a node-ID."""

import pytest
from dialogue import NO_HEARTBEAT, NO_PDOS, QUIET, Bench, default, play

from kontronik_can_gw.cia301.nmt import Command, NmtState

LSS_SELECT_SECOND = """
    10 <- 7E5 04 00 00 00 00 00 00 00
    10 <- 7E5 40 00 00 00 00 00 00 00
    10 <- 7E5 41 01 4E 4F 4B 00 00 00
    10 <- 7E5 42 00 00 01 00 00 00 00
    10 <- 7E5 43 4E 00 00 00 00 00 00
"""


def test_boot_up_is_told_once_and_then_heartbeats_tell_pre_operational() -> None:
    bench = Bench(boot=False)
    bench.talk("""
           0 -> 701 00
        1000 -> 701 7F
        2000 -> 701 7F
        2500 -
    """)


def test_without_heartbeats_nothing_follows_the_boot_up() -> None:
    play("0 -> 701 00\n 60000 -", Bench(changes=QUIET, boot=False))


def test_the_five_commands() -> None:
    play(
        """
           1 <- 000 01 01              ; start
        1000 -> 701 05
        1001 <- 000 02 01              ; stop
        2000 -> 701 04
        2001 <- 000 80 01              ; enter pre-operational
        3000 -> 701 7F
        3001 <- 000 82 01              ; reset communication
        3001 -> 701 00
        4001 -> 701 7F
        4002 <- 000 81 01              ; reset node
        4002 -> 701 00
        5002 -> 701 7F
    """,
        Bench(changes=NO_PDOS),
    )


def test_commands_to_other_nodes_are_ignored_and_those_to_all_are_not() -> None:
    play(
        """
           1 <- 000 01 02
           1 <- 000 81 7F
           1 <- 000 01 FF
        1000 -> 701 7F
        1001 <- 000 01 00
        2000 -> 701 05
    """,
        Bench(changes=NO_PDOS),
    )


def test_commands_of_a_wrong_length_and_unknown_ones_are_ignored() -> None:
    play(
        """
           1 <- 000
           1 <- 000 01
           1 <- 000 01 01 00
           1 <- 000 01 01 00 00 00 00 00 00
           1 <- 000 00 01
           1 <- 000 03 01
           1 <- 000 7F 01
           1 <- 000 83 01
           1 <- 000 FF 01
        1000 -> 701 7F
    """,
        Bench(changes=NO_PDOS),
    )


@pytest.mark.parametrize("flags", [{"extended": True}, {"remote": True}, {"fd": True}])
def test_frames_that_are_no_plain_data_frames_are_no_commands(flags: dict[str, bool]) -> None:
    bench = Bench(changes=QUIET)
    bench.put(0, "01 01", **flags)
    bench.put(0x601, "40 00 10 00 00 00 00 00", **flags)
    assert bench.nodes[0].state is NmtState.PRE_OPERATIONAL
    assert bench.take() == []


@pytest.mark.parametrize("first", Command)
@pytest.mark.parametrize("then", Command)
def test_each_command_leads_from_each_state_to_its_own(first: Command, then: Command) -> None:
    state = {Command.START: 5, Command.STOP: 4}
    play(
        f"""
           1 do bench.put(0, bytes(({int(first)}, 1))), bench.take()
           2 do bench.put(0, bytes(({int(then)}, 1))), bench.take()
           3 do assert bench.nodes[0].state == {state.get(then, 127)}
    """,
        Bench(changes=QUIET),
    )


def test_a_command_for_the_present_state_changes_nothing() -> None:
    bench = Bench(changes=NO_HEARTBEAT)
    bench.talk("""
          0 <- 000 01 01
          0 -> 481 FF FF FF FF FF FF 00 00     ; TPDO 4 tells at the start what is: nothing seen yet
        100 <- 000 01 01                       ; no second start
        499 -
        500 -> 481 FF FF FF FF FF FF 00 00     ; only its event timer
    """)


def test_no_pdo_outside_operational() -> None:
    play(
        """
          0 uart 0 live battery_voltage=2442
          1 <- 000 01 00
          1 -> 181 00 00 00 00 8A 09 00 00
          1 -> 281 00 00 00 00 00 00 00 00
          1 -> 381 00 00 00 00 FF FF 00 00     ; BEC current 0 of an unknown device: not supplied
          1 -> 481 00 00 00 00 00 00 02 01
         50 <- 000 80 00
         51 uart 0 live battery_voltage=2443 operating_state=1
         51 <- 080
        100 <- 000 02 00
        101 uart 0 live battery_voltage=2444 operating_state=2
        101 <- 080
        200 -
    """,
        Bench(changes=NO_HEARTBEAT),
    )


def test_no_sdo_while_stopped_and_a_transfer_does_not_outlive_it() -> None:
    play("""
           0 <- 601 40 08 10 00 00 00 00 00
           0 -> 581 41 08 10 00 15 00 00 00     ; segmented upload of 21 bytes
           1 <- 601 60 00 00 00 00 00 00 00
           1 -> 581 00 4B 4F 4E 54 52 4F 4E
           2 <- 000 02 00
           3 <- 601 70 00 00 00 00 00 00 00
           3 <- 601 40 00 10 00 00 00 00 00
        5000 -                                  ; no time-out is told either
        5000 <- 000 80 00
        5001 <- 601 70 00 00 00 00 00 00 00
        5001 -> 581 80 00 00 00 01 00 04 05     ; belongs to no transfer
        5002 read 1 1000:00 = 00 00 00 00
    """)


def test_no_emergency_while_stopped() -> None:
    play("""
         0 <- 000 02 00
         1 uart 0 live operating_errors=1
        10 <- 000 80 00
        10 -> 081 20 32 05 00 01 00 00 00       ; told now, because it is still so
        11 read 1 1001:00 = 05
    """)


def test_heartbeat_and_lss_go_on_while_stopped() -> None:
    play(
        """
           0 <- 000 02 00
           1 <- 7E5 04 01 00 00 00 00 00 00
           1 <- 7E5 5E 00 00 00 00 00 00 00
           1 -> 7E4 5E 01 00 00 00 00 00 00
        1000 -> 701 04
    """,
        Bench(changes=NO_PDOS),
    )


def test_a_node_starts_itself_where_1f80h_says_so() -> None:
    changes = NO_PDOS
    play("0 -> 701 00\n 1000 -> 701 05", Bench(changes=changes, self_start=True, boot=False))
    play(
        "0 -> 701 00\n 1000 -> 701 05",
        Bench(changes={**changes, **default(0x1F80, 0, 0)}, boot=False),
    )


def test_1f80h_written_over_the_bus_holds_from_the_next_reset_on() -> None:
    play(
        """
           1 write 1 1F80:00 00 00 00 00
        1000 -> 701 7F
        1001 write 1 1010:02 73 61 76 65
        1002 <- 000 82 01
        1002 -> 701 00
        2002 -> 701 05
    """,
        Bench(changes=NO_PDOS),
    )


# --- several nodes


def test_nodes_boot_one_after_the_other_and_do_not_disturb_one_another() -> None:
    play(
        """
           0 -> 701 00
           0 -> 702 00
           0 -> 703 00
           1 <- 000 01 02
           2 <- 000 02 03
        1000 -> 701 7F
        1000 -> 702 05
        1000 -> 703 04
        1001 read 1 2101:01 = 01
        1001 read 2 2101:01 = 02
        1002 <- 603 40 00 10 00 00 00 00 00
        1003 <- 000 81 02
        1003 -> 702 00
        2000 -> 701 7F
        2000 -> 703 04
        2003 -> 702 7F
    """,
        Bench(3, changes=NO_PDOS, boot=False),
    )


def test_the_reset_of_one_node_leaves_settings_transfers_and_errors_of_the_others() -> None:
    play(
        """
        0 uart 0 live operating_errors=1
        0 -> 081 20 32 05 00 01 00 00 00
        0 uart 1 live operating_errors=2
        0 -> 082 10 32 05 01 02 00 00 00
        1 write 1 2100:01 05
        1 write 2 2100:01 06
        2 <- 601 40 08 10 00 00 00 00 00
        2 -> 581 41 08 10 00 15 00 00 00
        3 <- 000 81 02
        3 -> 702 00
        3 -> 082 10 32 05 01 02 00 00 00       ; what is wrong is told anew after a reset
        4 read 2 2100:01 = 01
        5 <- 601 60 00 00 00 00 00 00 00       ; node 1 goes on
        5 -> 581 00 4B 4F 4E 54 52 4F 4E
        6 <- 601 80 08 10 00 00 00 00 08
        6 read 1 2100:01 = 05
        6 read 1 1003:00 = 01
    """,
        Bench(2, changes=QUIET),
    )


def test_all_nodes_answer_sdo_at_the_same_time() -> None:
    play(
        """
        0 <- 601 40 08 10 00 00 00 00 00
        0 -> 581 41 08 10 00 15 00 00 00
        0 <- 602 40 08 10 00 00 00 00 00
        0 -> 582 41 08 10 00 15 00 00 00
        1 <- 602 60 00 00 00 00 00 00 00
        1 -> 582 00 4B 4F 4E 54 52 4F 4E
        1 <- 601 60 00 00 00 00 00 00 00
        1 -> 581 00 4B 4F 4E 54 52 4F 4E
    """,
        Bench(2, changes=QUIET),
    )


# --- without a node-ID


def test_a_node_without_a_node_id_is_silent_but_for_lss() -> None:
    bench = Bench(node_ids=[255], boot=False)
    bench.talk("""
            0 <- 000 01 00
            0 <- 000 81 00
            0 <- 000 82 FF
            1 <- 6FF 40 00 10 00 00 00 00 00
            1 <- 67F 40 00 10 00 00 00 00 00
            1 <- 601 40 00 10 00 00 00 00 00
            2 <- 080
            3 uart 0 live operating_errors=1
         1000 -                                  ; telemetry is lost, too
         1000 do bench.can_state("ERROR_PASSIVE")
        20000 <- 7E5 4C 00 00 00 00 00 00 00
        20000 -> 7E4 50 00 00 00 00 00 00 00
    """)
    assert bench.gateway.receive_ids == {0x7E5}


def test_a_node_boots_when_lss_has_given_it_a_node_id() -> None:
    play(
        """
           1 <- 7E5 04 01 00 00 00 00 00 00
           2 <- 7E5 11 07 00 00 00 00 00 00
           2 -> 7E4 11 00 00 00 00 00 00 00
           3 <- 7E5 04 00 00 00 00 00 00 00
           3 -> 707 00
           4 <- 607 40 00 10 00 00 00 00 00
           4 -> 587 43 00 10 00 00 00 00 00
           4 read 7 1014:00 = 87 00 00 00
           4 read 7 1800:01 = 87 01 00 C0
           4 read 7 1200:01 = 07 06 00 00
           4 read 7 1200:02 = 87 05 00 00
        1003 -> 707 7F
        1004 <- 000 01 07
        2003 -> 707 05
    """,
        Bench(node_ids=[255], changes=_tpdos_off(), boot=False),
    )


def test_a_changed_node_id_takes_effect_at_reset_communication() -> None:
    play(
        f"""
           {LSS_SELECT_SECOND}
          10 -> 7E4 44 00 00 00 00 00 00 00
          11 <- 7E5 11 22 00 00 00 00 00 00
          11 -> 7E4 11 00 00 00 00 00 00 00
          12 <- 7E5 04 00 00 00 00 00 00 00
          13 read 2 2101:01 = 02
          13 read 2 2101:02 = 22
          14 <- 000 82 02
          14 -> 722 00
          15 <- 602 40 00 10 00 00 00 00 00
          15 read 34 2101:01 = 22
          15 read 1 2101:01 = 01
          16 <- 000 81 02                        ; nobody's node-ID any more
        1000 -
    """,
        Bench(2, changes=QUIET),
    )


def test_a_node_that_lss_makes_unconfigured_falls_silent_at_its_reset() -> None:
    bench = play(
        """
           1 <- 7E5 04 01 00 00 00 00 00 00
           1 <- 7E5 11 FF 00 00 00 00 00 00
           1 -> 7E4 11 00 00 00 00 00 00 00
           1 <- 7E5 04 00 00 00 00 00 00 00
        1000 -> 701 7F
        1001 <- 000 82 00
        9000 -
    """,
        Bench(changes=NO_PDOS),
    )
    assert bench.gateway.receive_ids == {0x7E5}


def test_what_several_nodes_say_by_lss_is_one_frame() -> None:
    play(
        """
        0 <- 7E5 4C 00 00 00 00 00 00 00
        0 -> 7E4 50 00 00 00 00 00 00 00
        1 <- 7E5 51 00 00 00 00 80 00 00
        1 -> 7E4 4F 00 00 00 00 00 00 00
    """,
        Bench(node_ids=[255, 255, 3], changes=QUIET),
    )


def test_lss_cannot_give_a_node_the_node_id_of_another() -> None:
    play(
        f"""
        {LSS_SELECT_SECOND}
        10 -> 7E4 44 00 00 00 00 00 00 00
        11 <- 7E5 11 01 00 00 00 00 00 00
        11 -> 7E4 11 FF 01 00 00 00 00 00
        12 <- 7E5 11 00 00 00 00 00 00 00
        12 -> 7E4 11 01 00 00 00 00 00 00
        13 <- 7E5 11 80 00 00 00 00 00 00
        13 -> 7E4 11 01 00 00 00 00 00 00
        14 <- 7E5 11 02 00 00 00 00 00 00
        14 -> 7E4 11 00 00 00 00 00 00 00
    """,
        Bench(2, changes=QUIET),
    )


def test_errors_that_rose_before_the_node_had_a_node_id_are_told_when_it_has() -> None:
    play(
        """
        1 uart 0 live operating_errors=1
        2 <- 7E5 04 01 00 00 00 00 00 00
        3 <- 7E5 11 07 00 00 00 00 00 00
        3 -> 7E4 11 00 00 00 00 00 00 00
        4 <- 7E5 04 00 00 00 00 00 00 00
        4 -> 707 00
        4 -> 087 20 32 05 00 01 00 00 00
    """,
        Bench(node_ids=[255], changes=QUIET),
    )


def _tpdos_off() -> dict[tuple[int, int], dict[str, object]]:
    off: dict[tuple[int, int], dict[str, object]] = {
        (0x1800 + n, 1): {"default": 0xC0000180 + 0x100 * n, "relative": True} for n in range(4)
    }
    return off
