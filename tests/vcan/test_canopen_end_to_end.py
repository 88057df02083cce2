"""Simulated ESCs on ptys -> gateway process with CANopen nodes -> vcan -> the canopen library as master, and candump as witness."""

import itertools
import struct
import time
from bisect import bisect_left
from collections.abc import Callable, Sequence
from functools import partial
from operator import itemgetter
from pathlib import Path

import pytest
from canopen.nmt import NmtError
from canopen.sdo.exceptions import SdoCommunicationError
from sdo_poller import Sdo, segmented_upload
from vcan_tools import (
    EDS,
    LIVELY,
    SERIAL,
    Bench,
    Candump,
    GatewayProcess,
    Master,
    Recorded,
    agrees,
    canopen_configuration,
    database_of,
    nodes_running,
    wait_for,
)

from kontronik_can_gw.cia301.eds import load as load_eds
from kontronik_can_gw.offline.pty import PtyEsc
from kontronik_can_gw.protocol.fields import InfoData, LiveData
from kontronik_can_gw.protocol.states import Device, OperatingError
from kontronik_can_gw.simulator import Dropout, ErrorWindow, EscOptions, Faults

Start = Callable[..., GatewayProcess]

NO_DBC = "[dbc]\nenabled = false"
SLACK_S = 0.15
"""What a VM with one CPU for master, gateway and ESCs, on a machine with other work, may add to a time; as a rule it is 2 ms."""
BOOT_UP, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0, 4, 5, 127
TPDO1, TPDO2, TPDO3, TPDO4 = 0x180, 0x280, 0x380, 0x480
LIVE_PDOS = (TPDO1, TPDO2, TPDO3)
FORMATS = {TPDO1: "<IHh", TPDO2: "<hhHbB", TPDO3: "<HHHbb", TPDO4: "<IBBBB"}
FIELDS = {
    TPDO1: ("electrical_speed", "battery_voltage", "battery_current"),
    TPDO2: ("motor_current", "peak_current", "consumed_charge", "throttle", "output_opening"),
    TPDO3: ("bec_voltage", "pwm_input", "bec_current", "power_stage_temperature", "bec_temperature"),
    TPDO4: ("operating_errors", "operating_state", "timing"),
}
STATUS_OK, STATUS_LOST = 2, 4
WRITE_ONLY, NO_DATA, DEVICE_STATE = 0x06010001, 0x08000024, 0x08000022
RTR_OFF, INVALID = 1 << 30, 1 << 31
MS = 1_000_000


def shown(pdo: int, data: bytes) -> tuple[int, ...]:
    """The ESC's values in a default PDO."""
    return struct.unpack(FORMATS[pdo], data)[: len(FIELDS[pdo])]


def values(pdo: int, live: LiveData) -> tuple[int, ...]:
    return tuple(getattr(live, name) for name in FIELDS[pdo])


def frames_shown(pdo: int, frame: Recorded, sent: Sequence[tuple[float, LiveData]]) -> set[int]:
    """Numbers of the UART frames that a PDO may come from: same values, sent at about that time."""
    data = shown(pdo, frame.data)
    first, last = (bisect_left(sent, frame.time + seconds, key=itemgetter(0)) for seconds in (-0.3, 0.3))
    return {number for number in range(first, last) if values(pdo, sent[number][1]) == data}


def states(dump: Candump, node_id: int) -> list[int]:
    return [frame.data[0] for frame in dump.of(0x700 + node_id)]


def emergencies(dump: Candump, node_id: int = 1) -> list[Recorded]:
    return dump.of(0x80 + node_id)


def code(frame: Recorded) -> int:
    return int.from_bytes(frame.data[:2], "little")


def longest_gap(frames: Sequence[Recorded]) -> float:
    return max(b.time - a.time for a, b in itertools.pairwise(frames))


def go(master: Master, dump: Candump, node_id: int, state: str) -> None:
    """Command a state and wait for the heartbeat that tells it."""
    number = {"OPERATIONAL": OPERATIONAL, "STOPPED": STOPPED, "PRE-OPERATIONAL": PRE_OPERATIONAL}[state]
    master.node(node_id).nmt.state = state
    begin = len(states(dump, node_id))
    wait_for(lambda: states(dump, node_id)[begin:][-1:] == [number], 3, f"node {node_id} {state}")


def test_a_request_right_behind_the_boot_up_is_answered_and_the_eds_comes_by_segments(
    vcan: str, start_gateway: Start, tmp_path: Path
) -> None:
    with PtyEsc() as port:
        master = Sdo(vcan, 0x701, 0x581)
        start_gateway(canopen_configuration(vcan, [port.path], tmp_path, dbc=NO_DBC))
        assert master.receive(20) == (0x701, b"\0")
        asked = time.monotonic()
        assert master.upload(1, 0x1000, 0) == b"\x43\x00\x10\x00\0\0\0\0"
        assert time.monotonic() - asked < 0.04 + SLACK_S
        master.close()
        # 5500 questions: here nobody else listens
        assert segmented_upload(vcan, 1, 0x1021, 0) == EDS.read_bytes()


def test_boot_up_heartbeats_and_nmt_commands(vcan: str, tmp_path: Path) -> None:
    with nodes_running(vcan, tmp_path, EscOptions()) as (run, dump, gateway, master):
        assert states(dump, 1)[0] == BOOT_UP
        run.start()
        node = master.node(1)
        assert node.nmt.wait_for_heartbeat() == "PRE-OPERATIONAL"
        master.write(1, 0x1017, 0, 50, 2)
        begin = len(states(dump, 1))
        wait_for(lambda: len(states(dump, 1)) > begin + 20, 3, "heartbeats")
        beats = dump.of(0x701)[begin + 1 :]
        assert abs((beats[-1].time - beats[0].time) / (len(beats) - 1) - 0.05) < 0.002, "they keep to the clock"

        def pdos() -> int:
            return sum(len(dump.of(pdo + 1)) for pdo in FORMATS)

        assert pdos() == 0, "no PDO before OPERATIONAL"
        go(master, dump, 1, "OPERATIONAL")
        wait_for(lambda: pdos() > 50, 3, "PDOs")
        go(master, dump, 1, "STOPPED")
        before = pdos()
        node.sdo.RESPONSE_TIMEOUT = 0.3
        with pytest.raises(SdoCommunicationError):
            master.upload(1, 0x1000)
        node.sdo.RESPONSE_TIMEOUT = 2
        assert pdos() == before, "no PDO while STOPPED"
        go(master, dump, 1, "PRE-OPERATIONAL")
        assert master.number(1, 0x1017) == 50
        assert pdos() == before
        master.write(1, 0x2100, 1, 9, 1)

        node.nmt.state = "RESET COMMUNICATION"
        wait_for(lambda: states(dump, 1).count(BOOT_UP) == 2, 2, "the second boot-up")
        assert (master.number(1, 0x1017), master.number(1, 0x2100, 1)) == (1000, 9)
        node.nmt.state = "RESET"
        wait_for(lambda: states(dump, 1).count(BOOT_UP) == 3, 2, "the third boot-up")
        assert (master.number(1, 0x1017), master.number(1, 0x2100, 1)) == (1000, 7)
        with pytest.raises(NmtError):
            node.nmt.wait_for_heartbeat(timeout=0.5)  # the period is a second again
        gateway.wait_for_line("node 1 operational", 3)
        assert gateway.end() == 0, gateway.log


def test_every_object_of_the_eds_is_what_the_esc_sent(vcan: str, tmp_path: Path) -> None:
    # the values stay when the ESC falls silent, so that all objects can be compared with one frame
    with nodes_running(
        vcan, tmp_path, EscOptions(profile=LIVELY, info_every=20), esc="telemetry_timeout_ms = 60000", dbc=NO_DBC
    ) as (run, dump, _, master):
        run.start()
        wait_for(lambda: len(run.live(0)) > 250, 10, "telemetry")
        run.stop()
        time.sleep(0.2)
        live, info = run.live(0)[-1][1], run.info(0)[-1][1]

        sizes = {0x01: 1, 0x02: 1, 0x03: 2, 0x04: 4, 0x05: 1, 0x06: 2, 0x07: 4}
        read = {}
        entries = load_eds(EDS.read_bytes(), str(EDS)).entries
        for entry in entries:
            where = entry.index, entry.sub
            if entry.index == 0x1021:
                continue  # see below
            if entry.access == "wo":
                assert master.refusal(partial(master.upload, 1, *where)) == WRITE_ONLY, entry
            elif entry.index == 0x1003 and entry.sub:
                assert master.refusal(partial(master.upload, 1, *where)) == NO_DATA, entry
            else:
                read[where] = master.upload(1, *where)
                assert len(read[where]) == sizes.get(entry.data_type, len(read[where])), entry
        assert len(read) > 200

        def number(index: int, sub: int, signed: bool = False) -> int:
            return int.from_bytes(read[index, sub], "little", signed=signed)

        for sub, (name, wanted) in enumerate(live._asdict().items(), 1):
            assert number(0x2000, sub, signed=wanted < 0) == wanted, name
        extremes = list(info._asdict().items())[InfoData._fields.index("max_electrical_speed") :]
        for sub, (name, wanted) in enumerate(extremes, 1):
            assert number(0x2011, sub, signed=wanted < 0) == wanted, name
        assert abs(number(0x2001, 1) - live.electrical_speed / 7) <= 0.5
        assert abs(number(0x2001, 2) - live.electrical_speed / 7 / 9.8) <= 0.5
        assert abs(number(0x2001, 3) - live.battery_voltage * live.battery_current / 100) <= 0.5
        assert abs(number(0x2001, 5) - live.battery_voltage * 10 / info.cell_count) <= 0.5
        assert [number(0x2010, sub) for sub in (1, 2, 5)] == [Device.KOSMIK, 120, 6]
        assert (read[0x2010, 6], read[0x2010, 7]) == (b"KOSMIK", b"4.17")
        assert number(0x2020, 1) & 0x0F == STATUS_OK
        assert number(0x2020, 5) == len(run.live(0))
        assert number(0x2020, 6) == len(run.info(0))
        assert (number(0x606C, 0), number(0x6079, 0)) == (number(0x2001, 1), live.battery_voltage * 10)
        assert number(0x1018, 4) == SERIAL
        assert read[0x1008, 0] == b"KONTRONIK ESC gateway"

        with master.node(1).sdo.open(0x1021, 0, "rb", block_transfer=True) as stream:
            assert stream.read() == EDS.read_bytes()
        assert not emergencies(dump)


def test_pdos_show_the_frames_of_the_esc(vcan: str, tmp_path: Path) -> None:
    with nodes_running(vcan, tmp_path, EscOptions(profile=LIVELY)) as (run, dump, _, master):
        node = master.node(1)
        master.write(1, 0x1017, 0, 100, 2)
        node.tpdo.read()  # type: ignore[no-untyped-call]
        assert [number for number in range(1, 7) if node.tpdo[number].enabled] == [1, 2, 3, 4]
        heard: dict[int, list[tuple[int, ...]]] = {}
        for found in (node.tpdo[number] for number in range(1, 5)):
            found.add_callback(lambda pdo: heard.setdefault(pdo.cob_id - 1, []).append(tuple(v.raw for v in pdo)))
        run.start()
        wait_for(lambda: len(run.live(0)) > 120, 5, "the end of the power-up")  # from here on no two frames are alike
        go(master, dump, 1, "OPERATIONAL")
        begin = time.time()
        time.sleep(3)
        until = time.time()
        go(master, dump, 1, "PRE-OPERATIONAL")
        for pdo, inhibit_s in ((TPDO1, 0.02), (TPDO2, 0.05), (TPDO3, 0.1)):
            frames = dump.of(pdo + 1)
            assert [v[: len(FIELDS[pdo])] for v in heard[pdo]] == [shown(pdo, f.data) for f in frames]
            count = len([frame for frame in frames if begin < frame.time < until])
            assert 0.75 * (until - begin) <= count * inhibit_s <= (until - begin) + inhibit_s
            known = [frames_shown(pdo, frame, run.live(0)) for frame in frames]
            assert all(known), "a PDO with values that were never in one frame"
        # TPDO 1 has the speed, which no two frames share: one frame each, always a newer one
        sent = run.live(0)
        one = [frames_shown(TPDO1, frame, sent) for frame in dump.of(TPDO1 + 1)]
        assert all(len(numbers) == 1 for numbers in one)
        order = [number for numbers in one for number in numbers]
        assert order == sorted(set(order))
        late = [f.time - sent[n][0] for f, n in zip(dump.of(TPDO1 + 1), order, strict=True)]
        assert max(late) < 0.02 + SLACK_S, "older than the inhibit time allows"

        # Without inhibit times each UART frame causes all three at once; at SYNC all four say the same frame.
        for number, kind in ((1, 254), (2, 254), (3, 254), (4, 1)):
            found = node.tpdo[number]
            found.inhibit_time, found.event_timer, found.trans_type = 0, 0, kind
            found.save()
        check_that_pdos_share_frames(run, dump, lambda: go(master, dump, 1, "OPERATIONAL"), LIVE_PDOS, lambda: None)
        go(master, dump, 1, "PRE-OPERATIONAL")
        for number in (1, 2, 3):
            node.tpdo[number].trans_type = 1
            node.tpdo[number].save()
        check_that_pdos_share_frames(
            run,
            dump,
            lambda: go(master, dump, 1, "OPERATIONAL"),
            tuple(FORMATS),
            lambda: master.network.sync.transmit(),
        )


def check_that_pdos_share_frames(
    run: Bench, dump: Candump, begin: Callable[[], None], pdos: tuple[int, ...], each: Callable[[], object]
) -> None:
    """Every group of PDOs on the bus, one of each, comes from one UART frame. ``each`` is called every 10 ms."""
    start = len(dump.frames)
    begin()
    end = time.monotonic() + 1.5
    while time.monotonic() < end:
        each()
        time.sleep(0.01)
    ids = [pdo + 1 for pdo in pdos]
    recorded = [frame for frame in dump.frames[start:] if frame.can_id in ids]
    first = next(i for i, frame in enumerate(recorded) if i > 3 and frame.can_id == ids[0])
    groups = [recorded[i : i + len(ids)] for i in range(first, len(recorded) - len(ids), len(ids))]
    assert len(groups) > 80
    sent = run.live(0)
    for group in groups:
        assert [frame.can_id for frame in group] == ids
        common = set.intersection(*(frames_shown(f.can_id - 1, f, sent) for f in group))
        assert common, "PDOs of one moment that show different frames"


def test_emergencies_rise_and_fall_with_the_escs_error_bits(vcan: str, tmp_path: Path) -> None:
    def window(bit: OperatingError, start_ms: int, duration_ms: int) -> ErrorWindow:
        return ErrorWindow(bit, start_ms * MS, duration_ms * MS)

    errors = (
        window(OperatingError.UNDERVOLTAGE, 500, 700),
        window(OperatingError.WATCHDOG_ERROR_TRIPPED, 800, 700),
        window(OperatingError.POWER_STAGE_OVERTEMP_WARNING, 2000, 400),
        window(OperatingError.OPERATING_WARNING_FOUND, 2000, 400),  # a summary that another bit explains
        window(OperatingError.PROGRAMMING_ALLOWED, 2600, 200),  # no alarm
    )
    with nodes_running(vcan, tmp_path, EscOptions(profile=LIVELY, faults=Faults(errors=errors))) as (
        run,
        dump,
        _,
        master,
    ):
        node = master.node(1)
        master.write(1, 0x1017, 0, 100, 2)
        run.start()
        go(master, dump, 1, "OPERATIONAL")
        wait_for(lambda: len(emergencies(dump)) == 2, 3, "two emergencies")
        assert master.number(1, 0x1001) == 0x05
        assert master.number(1, 0x603F) == 0x6010
        wait_for(lambda: len(run.live(0)) > 300, 5, "the end of the error windows")
        found = emergencies(dump)
        assert [code(frame) for frame in found] == [0x3220, 0x6010, 0, 0xFF04, 0]
        assert [frame.data[2] for frame in found] == [0x05, 0x05, 0, 0x81, 0]
        assert [frame.data[3] for frame in found] == [0, 16, 0xFF, 4, 0xFF]
        words = [int.from_bytes(frame.data[4:], "little") & ~(1 << 17) for frame in found]
        assert words == [0x000001, 0x010001, 0, 0x002010, 0]
        assert [(e.code, e.register) for e in node.emcy.log] == [(code(f), f.data[2]) for f in found]
        assert node.emcy.active == []

        interesting = 0xFFFFFF & ~(1 << 17)
        sent = run.live(0)
        edges = [
            when
            for (_, before), (when, live) in itertools.pairwise(sent)
            if (before.operating_errors ^ live.operating_errors) & interesting
        ]
        del edges[2]  # undervoltage goes, the watchdog's bit stays: nothing to tell
        late = [frame.time - when for frame, when in zip(found, edges, strict=True)]
        print("EMCY behind its UART frame, ms:", [round(1000 * seconds, 1) for seconds in late])
        assert max(late) < 0.02 + SLACK_S
        # the PDO with the error word says the same at once
        words_shown = {
            shown(TPDO4, f.data)[0] & interesting for f in dump.of(TPDO4 + 1) if f.data[6] & 0x0F == STATUS_OK
        }
        assert words_shown == {0, 1, 0x10001, 0x10000, 0x2010}

        history = [master.number(1, 0x1003, sub) for sub in range(1, 4)]
        assert master.number(1, 0x1003) == 3
        assert [entry & 0xFFFF for entry in history] == [0xFF04, 0x6010, 0x3220]
        master.write(1, 0x1003, 0, 0, 1)
        assert master.number(1, 0x1003) == 0
        assert master.refusal(lambda: master.upload(1, 0x1003, 1)) == NO_DATA
        assert master.number(1, 0x1001) == 0


def test_telemetry_loss_and_return(vcan: str, tmp_path: Path) -> None:
    with nodes_running(vcan, tmp_path, EscOptions(profile=LIVELY, info_every=10)) as (run, dump, gateway, master):
        assert master.refusal(lambda: master.upload(1, 0x2000, 1)) == NO_DATA, "before the first frame"
        master.write(1, 0x1017, 0, 100, 2)
        go(master, dump, 1, "OPERATIONAL")
        assert [dump.of(pdo + 1) for pdo in LIVE_PDOS] == [[], [], []]
        assert dump.of(TPDO4 + 1)[0].data[6] & 0x0F < STATUS_OK
        returned = []
        started = []
        for loss in (1, 2):
            started.append(time.time())
            run.start()
            begin = len(run.live(0))
            wait_for(lambda b=begin: len(run.live(0)) > b + 60, 3, "telemetry")  # type: ignore[misc]
            returned.append(run.live(0)[begin][0])
            run.stop()
            lost = run.live(0)[-1][0] + 0.25
            gateway.wait_for_line("telemetry lost")
            wait_for(lambda n=loss: len(emergencies(dump)) == 2 * n - 1, 2, "an emergency")  # type: ignore[misc]
            time.sleep(1.2)

            for pdo in LIVE_PDOS:
                assert dump.of(pdo + 1)[-1].time < lost + 0.01, "an old value that looks new"
            said = [f for f in dump.of(TPDO4 + 1) if f.time > lost - 0.005 and f.data[6] & 0x0F == STATUS_LOST]
            assert said[0].time - lost < 0.02 + SLACK_S, "said at once"
            assert len(said) >= 3, "and again by the event timer"
            assert all(abs(b.time - a.time - 0.5) < SLACK_S for a, b in itertools.pairwise(said))
            assert all(frame.data[:6] == b"\xff" * 6 for frame in said), "what is not available looks so"
            emergency = emergencies(dump)[-1]
            assert emergency.data == bytes((0x10, 0x75, 0x01, 0xFF, 1, 0, 0, 0))
            assert abs(emergency.time - lost) < 0.02 + SLACK_S
            assert abs(emergency.time - said[0].time) < 0.02, "all that is to be said is said together"

            assert master.refusal(lambda: master.upload(1, 0x2000, 1)) == DEVICE_STATE
            assert master.refusal(lambda: master.upload(1, 0x2001, 1)) == DEVICE_STATE
            assert master.number(1, 0x2011, 3) == run.info(0)[-1][1].max_battery_voltage, "logged extremes stay"
            assert master.number(1, 0x2020, 1) == STATUS_LOST, "and bit 7 says that they are not fresh"
            assert master.number(1, 0x2020, 0x0A) == loss
            ages = []
            for _ in range(2):
                ages.append(master.number(1, 0x2020, 3) / 1000 + lost - 0.25 - time.time())
                time.sleep(0.1)
            assert all(abs(age) < SLACK_S for age in ages), "the age counts on"
            assert states(dump, 1)[-1] == OPERATIONAL
            master.write(1, 0x2100, 5, 1, 1)
            assert master.number(1, 0x2000, 2) == run.live(0)[-1][1].battery_voltage, "by setting: the last value"
            master.write(1, 0x2100, 5, 2, 1)
            assert master.number(1, 0x2000, 2) == 0xFFFF, "by setting: not available"
            master.write(1, 0x2100, 5, 0, 1)
            gateway.lines.clear()

        started.append(time.time())
        run.start()
        begin = len(run.live(0))
        wait_for(lambda: len(run.live(0)) > begin + 20, 3, "telemetry")
        returned.append(run.live(0)[begin][0])
        wait_for(lambda: len(emergencies(dump)) == 4, 2, "the last 0000h")
        assert [code(frame) for frame in emergencies(dump)] == [0x7510, 0, 0x7510, 0]
        late = {}
        for pdo in FORMATS:
            ok = [f for f in dump.of(pdo + 1) if pdo != TPDO4 or f.data[6] & 0x0F == STATUS_OK]
            firsts = [next(f for f in ok if f.time > start) for start in started[1:]]
            late[hex(pdo)] = [f.time - back for f, back in zip(firsts, returned[1:], strict=True)]
        late["EMCY"] = [emergencies(dump)[n].time - back for n, back in zip((1, 3), returned[1:], strict=True)]
        print("behind the first good frame, ms:", {k: [round(1000 * s, 1) for s in v] for k, v in late.items()})
        assert max(max(each) for each in late.values()) < 0.02 + SLACK_S

        # 1029h:2 = 0: fall back to PRE-OPERATIONAL
        master.write(1, 0x1029, 2, 0, 1)
        run.stop()
        wait_for(lambda: states(dump, 1)[-1] == PRE_OPERATIONAL, 2, "PRE-OPERATIONAL")


def test_heartbeats_of_another_node_are_watched(vcan: str, tmp_path: Path) -> None:
    with nodes_running(vcan, tmp_path, EscOptions(), EscOptions()) as (run, dump, _, master):
        run.start()
        for node_id in (1, 2):
            master.write(node_id, 0x1017, 0, 100, 2)
            go(master, dump, node_id, "OPERATIONAL")
        master.write(1, 0x1016, 1, 100 << 16 | 200, 4)
        time.sleep(0.5)
        assert not emergencies(dump), "the watch begins with the first heartbeat"
        beat = master.network.send_periodic(0x764, b"\x05", 0.05)
        time.sleep(0.8)
        assert not emergencies(dump)
        beat.stop()  # type: ignore[no-untyped-call]
        wait_for(lambda: len(emergencies(dump)) == 1, 2, "an emergency")
        emergency, last = emergencies(dump)[0], dump.of(0x764)[-1]
        assert emergency.data == bytes((0x30, 0x81, 0x11, 0xFF, 100, 0, 0, 0))
        assert 0.2 <= emergency.time - last.time < 0.2 + SLACK_S
        wait_for(lambda: states(dump, 1)[-1] == PRE_OPERATIONAL, 2, "what 1029h:1 says")
        assert states(dump, 2)[-1] == OPERATIONAL
        master.network.send_message(0x764, b"\x05")
        wait_for(lambda: len(emergencies(dump)) == 2, 2, "0000h")
        assert code(emergencies(dump)[1]) == 0
        assert states(dump, 1)[-1] == PRE_OPERATIONAL
        assert not emergencies(dump, 2)


def test_a_pdo_is_mapped_anew_through_the_library(vcan: str, tmp_path: Path) -> None:
    with nodes_running(vcan, tmp_path, EscOptions(profile=LIVELY)) as (run, dump, _, master):
        node = master.node(1)
        master.write(1, 0x1017, 0, 100, 2)
        node.tpdo.read()  # type: ignore[no-untyped-call]
        run.start()
        go(master, dump, 1, "OPERATIONAL")
        wait_for(lambda: len(run.live(0)) > 120, 5, "the end of the power-up")
        spare = node.tpdo[5]
        spare.clear()
        for index, sub in ((0x2000, 4), (0x2000, 1), (0x2000, 10), (0x2020, 2)):
            spare.add_variable(index, sub)
        spare.cob_id, spare.trans_type, spare.inhibit_time, spare.event_timer = 0x1F1, 254, 0, 0
        spare.enabled = True
        spare.save()  # while OPERATIONAL
        heard: list[list[int]] = []
        spare.add_callback(lambda pdo: heard.append([v.raw for v in pdo]))
        wait_for(lambda: len(heard) > 50, 5, "the new PDO")
        node.tpdo[1].clear()
        node.tpdo[1].add_variable(0x2000, 2)
        node.tpdo[1].save()
        changed = time.time()
        wait_for(lambda: len([f for f in dump.of(TPDO1 + 1) if f.time > changed]) > 10, 5, "the shorter TPDO 1")
        run.stop()
        sent = {(d.motor_current, d.electrical_speed, d.throttle) for _, d in run.live(0)}
        found = [struct.unpack("<hIbB", frame.data) for frame in dump.of(0x1F1)]
        first = found.index(tuple(heard[0]))
        assert [tuple(each) for each in heard] == found[first : first + len(heard)]
        assert {each[:3] for each in found} <= sent
        assert {(b[3] - a[3]) & 0xFF for a, b in itertools.pairwise(found)} <= {1, 2, 3}, "the live counter"
        voltages = {d.battery_voltage for _, d in run.live(0)}
        short = [f for f in dump.of(TPDO1 + 1) if f.time > changed]
        assert {len(f.data) for f in short} == {2}
        assert {int.from_bytes(f.data, "little") for f in short} <= voltages
        # what makes no sense is refused with the code of the standard
        assert master.refusal(lambda: master.write(1, 0x1800, 1, RTR_OFF | 0x1F2, 4)) == 0x06090030
        assert master.refusal(lambda: master.write(1, 0x1804, 1, 0x1F1, 4)) == 0x06090030, "RTR"
        assert master.refusal(lambda: master.write(1, 0x1A04, 0, 0, 1)) == 0x06010000, "it exists"
        master.write(1, 0x1804, 1, INVALID | RTR_OFF | 0x1F1, 4)
        assert master.refusal(lambda: master.write(1, 0x1A04, 1, 0x20000120, 4)) == 0x06010003, "count not 0"
        assert master.refusal(lambda: master.write(1, 0x1804, 1, RTR_OFF | 0x688, 4)) == 0x06040043, "the DBC's"
        assert master.refusal(lambda: master.write(1, 0x1804, 1, RTR_OFF | 0x281, 4)) == 0x06040043, "TPDO 2's"
        assert master.refusal(lambda: master.write(1, 0x1804, 1, RTR_OFF | 0x601, 4)) == 0x06090030, "restricted"


def test_four_escs_do_not_disturb_one_another_and_the_dbc_runs_beside(vcan: str, tmp_path: Path) -> None:
    lively = EscOptions(profile=LIVELY)
    flaky = EscOptions(profile=LIVELY, faults=Faults(dropout=Dropout(1200 * MS, 2400 * MS)))
    settings = {"options": "self_start = true", "esc": "telemetry_timeout_ms = 600"}  # this process may be held up, too
    with nodes_running(vcan, tmp_path, lively, lively, flaky, lively, node_id=10, **settings) as (
        run,
        dump,
        gateway,
        master,
    ):
        others = (10, 11, 13)
        run.start()
        wait_for(lambda: all(len(run.live(i)) > 20 for i in range(4)), 5, "telemetry")
        time.sleep(0.3)
        begin = len(dump.frames)
        for round_number in range(8):
            time.sleep(0.5)
            assert "suspended" not in gateway.log
            for node_id in others:
                read = master.number(node_id, 0x2000, 2)
                known = {live.battery_voltage for _, live in run.live(node_id - 10)}
                assert read in known, (node_id, round_number)
        end = len(dump.frames)
        run.stop()
        time.sleep(0.1)
        recorded = dump.frames[begin:end]

        def of(can_id: int) -> list[Recorded]:
            return [frame for frame in recorded if frame.can_id == can_id]

        told = [code(frame) for frame in of(0x8C)]
        assert len(told) >= 3, "node 12 lost its ESC again and again"
        assert all({a, b} == {0x7510, 0} for a, b in itertools.pairwise(told))
        assert {frame.data[0] for frame in of(0x70C)} == {OPERATIONAL}
        for node_id in others:
            assert not of(0x80 + node_id)
            sent_gap = max(b[0] - a[0] for a, b in itertools.pairwise(run.live(node_id - 10)))
            assert longest_gap(of(TPDO1 + node_id)) < sent_gap + 0.02 + SLACK_S
            assert len(of(TPDO1 + node_id)) > 0.75 * 50 * (recorded[-1].time - recorded[0].time)
            assert {f.data[6] & 0x0F for f in of(TPDO4 + node_id)} == {STATUS_OK}
            assert {frame.data[0] for frame in of(0x700 + node_id)} == {OPERATIONAL}
        for node_id in (*others, 12):
            sent = run.live(node_id - 10)
            for pdo in LIVE_PDOS:
                for frame in of(pdo + node_id):
                    assert frames_shown(pdo, frame, sent), "a PDO with another ESC's values"
        silence = [b.time - a.time for a, b in itertools.pairwise(of(0x18C))]
        assert len([gap for gap in silence if gap > 0.5]) >= told.count(0x7510) - 1

        # the DBC's frames on the same bus
        database = database_of(tmp_path / "gateway.toml")
        for index in range(4):
            message = database.get_message_by_name(f"Esc{index + 1}Speed")
            frames = of(message.frame_id)
            assert len(frames) > 150
            sent = run.live(index)
            for frame in frames[::5]:
                decoded = message.decode_simple(frame.data)
                if str(decoded[f"Esc{index + 1}BatteryVoltage"]) == "NotAvailable":
                    assert index == 2
                    continue
                near = [live for when, live in sent if abs(frame.time - when) < 0.3]
                assert any(agrees(dict(decoded), live, f"Esc{index + 1}") for live in near)
        own = {message.frame_id for message in database.messages}
        nodes = {f + n for f in (0x80, 0x180, 0x280, 0x380, 0x480, 0x580, 0x600, 0x700) for n in range(10, 14)}
        assert {frame.can_id for frame in recorded} <= own | nodes


CLASHING_DBC = """VERSION ""
BU_: Gw Car
BO_ 385 Speed: 4 Gw
 SG_ ElectricalSpeed : 0|32@1+ (1,0) [0|0] "1/min" Car
"""


def test_a_dbc_that_uses_a_nodes_cob_id_is_refused_at_start(vcan: str, start_gateway: Start, tmp_path: Path) -> None:
    (tmp_path / "car.dbc").write_text(CLASHING_DBC)
    with PtyEsc() as port, Candump(vcan) as dump:
        toml = canopen_configuration(vcan, [port.path], tmp_path, dbc='[dbc]\nfile = "car.dbc"')
        gateway = start_gateway(toml)
        assert gateway.process.wait(20) == 2
        time.sleep(0.2)
        assert len(gateway.lines) == 1, gateway.log
        for word in ("car.dbc", "Speed", "181h", "TPDO 1"):
            assert word in gateway.lines[0]
        assert not dump.frames
        start_gateway(toml.replace("node_id = 1", "node_id = 2")).wait_for_line("esc1: /dev/pts")
