"""ESCs -> gateway process with two CANopen nodes, the DBC beside them -> vcan -> the canopen library as master.

One gateway serves most tests; each begins with its nodes reset.
"""

import contextlib
import itertools
import struct
from collections.abc import Callable, Iterator
from functools import partial

import pytest
from canopen import SdoAbortedError
from encoding import Identity
from vcan_tools import EDS, SERIAL, Chain, Master, Recorded, canopen_table, chain, wait_for

from kontronik_can_gw.canopen.eds import load as load_eds
from kontronik_can_gw.esc.kontronik.codec import Layout
from kontronik_can_gw.esc.kontronik.fields import InfoData
from kontronik_can_gw.esc.kontronik.states import OperatingError

BOOT_UP, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0, 4, 5, 127
COMMANDS = {OPERATIONAL: "OPERATIONAL", STOPPED: "STOPPED", PRE_OPERATIONAL: "PRE-OPERATIONAL"}
TPDO1, TPDO2, TPDO3, TPDO4 = 0x180, 0x280, 0x380, 0x480
PDOS = (TPDO1, TPDO2, TPDO3, TPDO4)
STATUS_LOST, DEVICE_STATE = 4, 0x08000022
WRITE_ONLY, NO_DATA, IN_USE = 0x06010001, 0x08000024, 0x06040043
RTR_OFF, INVALID = 1 << 30, 1 << 31
TIMEOUT = 0x2100, 4


class Nodes:
    """The running gateway, and what a test asks of it."""

    def __init__(self, run: Chain, master: Master) -> None:
        self.run, self.master, self.watch = run, master, run.watch
        self.begin = 0

    def of(self, can_id: int) -> list[Recorded]:
        """Frames since the test's beginning."""
        return [frame for frame in self.watch.recorded[self.begin :] if frame.can_id == can_id]

    def states(self, node: int) -> list[int]:
        return [frame.data[0] for frame in self.of(0x700 + node)]

    def reset(self) -> None:
        self.begin = len(self.watch.recorded)
        for node in (1, 2):
            self.master.node(node).nmt.state = "RESET"
            wait_for(lambda node=node: BOOT_UP in self.states(node), "boot-up")  # type: ignore[misc]
            self.master.write(node, *TIMEOUT, 60_000, 2)
        self.run.catch_up()
        self.begin = len(self.watch.recorded)

    def go(self, node: int, state: int) -> None:
        """Command a state and wait for the heartbeat that tells it."""
        begin = len(self.states(node))
        self.master.node(node).nmt.state = COMMANDS[state]
        wait_for(
            lambda: self.states(node)[begin:][-1:] == [state], f"node {node} {COMMANDS[state]}"
        )


@pytest.fixture(scope="module")
def module_nodes(module_vcan: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Nodes]:
    folder = tmp_path_factory.mktemp("nodes")
    identities = Identity(1), Identity(2, Layout.LEGACY, cells=12)
    with (
        chain(module_vcan, folder, *identities, toml=canopen_table(folder / "store")) as run,
        Master(module_vcan) as master,
        run.running() as gateway,
    ):
        wait_for(lambda: len(run.watch.boot_ups) == 2, "boot-ups")
        yield Nodes(run, master)
        assert gateway.end() == 0, gateway.log


@pytest.fixture
def nodes(module_nodes: Nodes) -> Nodes:
    module_nodes.reset()
    return module_nodes


def test_heartbeats_and_nmt_commands(nodes: Nodes) -> None:
    master = nodes.master
    master.write(1, 0x1017, 0, 50, 2)
    wait_for(lambda: len(nodes.states(1)) >= 5, "heartbeats")
    assert set(nodes.states(1)) == {PRE_OPERATIONAL}
    nodes.run.feed(0, times=2)
    assert [nodes.of(pdo + 1) for pdo in PDOS] == [[]] * 4, "no PDO before OPERATIONAL"
    nodes.go(1, OPERATIONAL)
    nodes.run.feed(0, times=2)
    wait_for(lambda: all(nodes.of(pdo + 1) for pdo in PDOS), "PDOs")
    nodes.go(1, STOPPED)
    before = len(nodes.watch.recorded)
    nodes.run.feed(0, times=2)
    master.network.send_message(0x601, b"\x40\x00\x10\x00\0\0\0\0")  # while STOPPED: never answered
    nodes.go(1, PRE_OPERATIONAL)
    assert master.number(1, 0x1017) == 50
    nodes.run.catch_up()
    after = nodes.watch.recorded[before:]
    assert [f.data[1:4].hex() for f in after if f.can_id == 0x581] == ["171000"]
    assert not {f.can_id for f in after} & {pdo + 1 for pdo in PDOS}
    for command, kept in (("RESET COMMUNICATION", 50_000), ("RESET", 60_000)):
        master.write(1, *TIMEOUT, 50_000, 2)
        master.write(1, 0x1017, 0, 50, 2)
        begin = len(nodes.states(1))
        master.node(1).nmt.state = command
        wait_for(lambda begin=begin: BOOT_UP in nodes.states(1)[begin:], command)  # type: ignore[misc]
        assert (master.number(1, 0x1017), master.number(1, *TIMEOUT)) == (1000, kept), command
    assert BOOT_UP not in nodes.states(2), "the other node has not noticed"


def answered(act: Callable[[], object]) -> bool:
    with contextlib.suppress(SdoAbortedError):
        act()
        return True
    return False


def test_every_object_of_the_eds_is_what_the_esc_sent(nodes: Nodes) -> None:
    run, master = nodes.run, nodes.master
    run.feed(1, times=12)  # an info frame among them
    fed = run.escs[1]
    sent, extremes = fed.live(len(fed.sent) - 1), fed.info(len(fed.info_sent) - 1)
    wait_for(
        lambda: answered(lambda: master.upload(2, 0x2020, 0x0B)),
        "the frame rate, known after a second",
    )
    sizes = {0x01: 1, 0x02: 1, 0x03: 2, 0x04: 4, 0x05: 1, 0x06: 2, 0x07: 4}
    read = {}
    for entry in load_eds(EDS.read_bytes(), str(EDS)).entries:
        where = entry.index, entry.sub
        if entry.access == "wo":
            assert master.refusal(partial(master.upload, 2, *where)) == WRITE_ONLY, entry
        elif entry.index == 0x1003 and entry.sub:
            assert master.refusal(partial(master.upload, 2, *where)) == NO_DATA, entry
        elif entry.index != 0x1021:
            read[where] = master.upload(2, *where)
            assert len(read[where]) == sizes.get(entry.data_type, len(read[where])), entry
    assert len(read) > 200

    def number(index: int, sub: int, signed: bool = False) -> int:
        return int.from_bytes(read[index, sub], "little", signed=signed)

    for sub, (name, wanted) in enumerate(sent._asdict().items(), 1):
        assert number(0x2000, sub, signed=wanted < 0) == wanted, name
    for sub, (name, wanted) in enumerate(
        list(extremes._asdict().items())[InfoData._fields.index("max_electrical_speed") :], 1
    ):
        assert number(0x2011, sub, signed=wanted < 0) == wanted, name
    derived = {
        1: sent.electrical_speed / 7,
        2: sent.electrical_speed / 7 / 9.8,
        3: sent.battery_voltage * sent.battery_current / 100,
        5: sent.battery_voltage * 10 / extremes.cell_count,
    }
    for sub, value in derived.items():
        assert abs(number(0x2001, sub, signed=value < 0) - value) <= 0.5, sub
    assert number(0x2020, 5) == len(fed.sent)
    assert number(0x2020, 6) == len(fed.info_sent)
    assert (number(0x606C, 0), number(0x6079, 0)) == (number(0x2001, 1), sent.battery_voltage * 10)
    assert number(0x1018, 4) == SERIAL + 1
    assert read[0x1008, 0] == b"KONTRONIK ESC gateway"
    with master.node(2).sdo.open(0x1021, 0, "rb", block_transfer=True) as stream:
        assert stream.read() == EDS.read_bytes()
    assert not nodes.of(0x82)


@pytest.mark.parametrize("at_sync", [False, True])
def test_all_pdos_of_a_moment_show_one_frame(nodes: Nodes, at_sync: bool) -> None:
    """(Each value of a PDO is judged besides: that it was sent by this ESC, and never an older one after a newer one.)"""
    master = nodes.master
    tpdo = master.node(1).tpdo
    tpdo.read()  # type: ignore[no-untyped-call]
    heard: list[tuple[int, ...]] = []
    tpdo[1].add_callback(lambda pdo: heard.append(tuple(value.raw for value in pdo)))
    for number in (1, 2, 3, 4):
        tpdo[number].inhibit_time = tpdo[number].event_timer = 0
        tpdo[number].trans_type = 1 if at_sync else 254
        tpdo[number].save()
    nodes.go(1, OPERATIONAL)
    assert master.number(1, 0x1018, 4) == SERIAL  # after it no PDO comes that tells how it begins
    nodes.run.catch_up()
    ids = [pdo + 1 for pdo in (PDOS if at_sync else PDOS[:3])]
    shown = []
    held_up = nodes.run.held_up
    for n in range(1, 21):
        begin = len(nodes.watch.recorded)
        nodes.run.feed(0)
        if at_sync:
            master.network.sync.transmit()

        def came(begin: int = begin) -> list[Recorded]:
            return [frame for frame in nodes.watch.recorded[begin:] if frame.can_id in ids]

        wait_for(
            lambda came=came: [f.can_id for f in came()] == ids or nodes.run.held_up > held_up,  # type: ignore[misc]
            f"the PDOs of frame {n}",
        )
        if nodes.run.held_up > held_up:
            return  # what waited to be sent was dropped and made anew
        fed = nodes.run.escs[0]
        sent = fed.live(len(fed.sent) - 1)
        one, two, three, *_ = (frame.data for frame in came())
        assert struct.unpack("<IHh", one) == (
            sent.electrical_speed,
            sent.battery_voltage,
            sent.battery_current,
        )
        assert struct.unpack("<hhH", two[:6]) == (
            sent.motor_current,
            sent.peak_current,
            sent.consumed_charge,
        )
        assert struct.unpack("<HHH", three[:6]) == (
            sent.bec_voltage,
            sent.pwm_input,
            sent.bec_current,
        )
        shown.append((sent.electrical_speed, sent.battery_voltage, sent.battery_current))
    wait_for(lambda: heard[-20:] == shown, "the library hears them too")


def test_emergencies_rise_and_fall_with_the_escs_error_bits(nodes: Nodes) -> None:
    master, fed = nodes.master, nodes.run.escs[0]
    nodes.go(1, OPERATIONAL)
    undervoltage, watchdog = (
        1 << OperatingError.UNDERVOLTAGE,
        1 << OperatingError.WATCHDOG_ERROR_TRIPPED,
    )
    # a summary bit that another one explains
    hot = (
        1 << OperatingError.POWER_STAGE_OVERTEMP_WARNING
        | 1 << OperatingError.OPERATING_WARNING_FOUND
    )
    no_alarm = 1 << OperatingError.PROGRAMMING_ALLOWED
    for errors in (undervoltage, undervoltage | watchdog, watchdog, 0, hot, 0, no_alarm, 0):
        fed.become(fed.identity._replace(errors=errors))
        nodes.run.feed(0, times=2)
        if errors == undervoltage | watchdog:
            assert (master.number(1, 0x1001), master.number(1, 0x603F)) == (0x05, 0x6010)
    history = [master.number(1, 0x1003, sub) & 0xFFFF for sub in range(4)]
    assert history == [3, 0xFF04, 0x6010, 0x3220]
    wanted = [
        (0x3220, 0x05, 0, undervoltage),
        (0x6010, 0x05, 16, undervoltage | watchdog),
        (0, 0, 0xFF, 0),
        (0xFF04, 0x81, 4, hot),
        (0, 0, 0xFF, 0),
    ]
    assert [struct.unpack("<HBBI", frame.data) for frame in nodes.of(0x81)] == wanted
    wait_for(lambda: len(master.node(1).emcy.log) >= 5, "the library hears them too")
    assert [(each.code, each.register) for each in master.node(1).emcy.log[-5:]] == [
        each[:2] for each in wanted
    ]
    master.write(1, 0x1003, 0, 0, 1)
    assert (master.number(1, 0x1003), master.number(1, 0x1001)) == (0, 0)
    assert master.refusal(lambda: master.upload(1, 0x1003, 1)) == NO_DATA
    fed.become(fed.identity._replace(errors=no_alarm))


def test_telemetry_loss_and_return(nodes: Nodes) -> None:
    master, run = nodes.master, nodes.run
    master.write(1, 0x1017, 0, 100, 2)
    nodes.go(1, OPERATIONAL)
    for loss in (1, 2):
        run.feed(0, times=12)
        if loss == 2:
            master.write(1, 0x1029, 2, 0, 1)  # fall back to PRE-OPERATIONAL
        fed = run.escs[0]
        sent, extremes = fed.live(len(fed.sent) - 1), fed.info(len(fed.info_sent) - 1)
        losses = master.number(1, 0x2020, 0x0A)
        master.write(1, *TIMEOUT, 250, 2)
        wait_for(lambda n=loss: len(nodes.of(0x81)) == 2 * n - 1, "an emergency")  # type: ignore[misc]
        assert nodes.of(0x81)[-1].data[:5] == bytes((0x10, 0x75, 0x01, 0xFF, 1))
        if loss == 1:

            def after() -> list[Recorded]:
                frames = nodes.watch.recorded
                return frames[frames.index(nodes.of(0x81)[-1]) :]

            wait_for(
                lambda: sum(f.can_id == TPDO4 + 1 for f in after()) >= 3,
                "TPDO 4 by its event timer",
            )
            assert not {f.can_id for f in after()} & {pdo + 1 for pdo in PDOS[:3]}, (
                "an old value that looks new"
            )
            said = [f.data for f in after() if f.can_id == TPDO4 + 1]
            assert all(data[:6] == b"\xff" * 6 and data[6] & 0x0F == STATUS_LOST for data in said)
        else:
            wait_for(lambda: nodes.states(1)[-1] == PRE_OPERATIONAL, "what 1029h:2 says")
        assert master.refusal(lambda: master.upload(1, 0x2000, 1)) == DEVICE_STATE
        assert master.refusal(lambda: master.upload(1, 0x2001, 1)) == DEVICE_STATE
        assert master.number(1, 0x2011, 3) == extremes.max_battery_voltage, "logged extremes stay"
        assert master.number(1, 0x2020, 1) & 0x3F == STATUS_LOST
        assert master.number(1, 0x2020, 0x0A) == losses + 1
        ages = [master.number(1, 0x2020, 3) for _ in range(2)]
        assert 250 <= ages[0] <= ages[1], "the age counts on"
        for setting, value in (
            (1, sent.battery_voltage),
            (2, 0xFFFF),
        ):
            # by setting: the last value, not available
            master.write(1, 0x2100, 5, setting, 1)
            assert master.number(1, 0x2000, 2) == value
        master.write(1, 0x2100, 5, 0, 1)
        master.write(1, *TIMEOUT, 60_000, 2)
        run.feed(0)
        wait_for(lambda n=loss: len(nodes.of(0x81)) == 2 * n, "its end")  # type: ignore[misc]
        assert nodes.of(0x81)[-1].data[:2] == bytes(2)
        assert master.number(1, 0x2000, 2) == fed.live(len(fed.sent) - 1).battery_voltage
    assert not nodes.of(0x82), "the other node has not noticed"


def test_heartbeats_of_another_node_are_watched(nodes: Nodes) -> None:
    master = nodes.master
    for node in (1, 2):
        nodes.go(node, OPERATIONAL)
    master.write(1, 0x1017, 0, 100, 2)
    master.write(1, 0x1016, 1, 100 << 16 | 200, 4)
    for n in (1, 2, 3):  # each begins or goes on with the watch, and is the last one for 200 ms
        master.network.send_message(0x764, b"\x05")
        wait_for(lambda n=n: len(nodes.of(0x81)) == 2 * n - 1, "an emergency")  # type: ignore[misc]
        # less what the clocks, of which the times are, may be apart
        assert nodes.of(0x81)[-1].time - nodes.of(0x764)[-1].time >= 0.19
        wait_for(lambda: nodes.states(1)[-1] == PRE_OPERATIONAL, "what 1029h:1 says")
    missed, back = bytes((0x30, 0x81, 0x11, 0xFF, 100, 0, 0, 0)), bytes(8)
    assert [frame.data[:2] + frame.data[4:5] for frame in nodes.of(0x81)] == [
        each[:2] + each[4:5] for each in (missed, back) * 2 + (missed,)
    ]
    assert nodes.of(0x81)[0].data == missed
    assert not nodes.of(0x82)


def test_a_pdo_is_mapped_anew_through_the_library(nodes: Nodes) -> None:
    master, run = nodes.master, nodes.run
    tpdo = master.node(1).tpdo
    tpdo.read()  # type: ignore[no-untyped-call]
    nodes.go(1, OPERATIONAL)
    spare = tpdo[5]
    spare.clear()
    for index, sub in ((0x2000, 4), (0x2000, 1), (0x2000, 10), (0x2020, 2)):
        spare.add_variable(index, sub)
    spare.cob_id, spare.trans_type, spare.inhibit_time, spare.event_timer = 0x1F1, 254, 0, 0
    spare.enabled = True
    spare.save()  # while OPERATIONAL
    heard: list[list[int]] = []
    spare.add_callback(lambda pdo: heard.append([value.raw for value in pdo]))
    first, held_up = len(run.escs[0].sent), run.held_up
    run.feed(0, times=20)
    fed = run.escs[0]
    sent = [fed.live(n) for n in range(first, len(fed.sent))]
    wanted = [[data.motor_current, data.electrical_speed, data.throttle] for data in sent]
    wait_for(
        lambda: [each[:3] for each in heard][-20:] == wanted or run.held_up > held_up,
        "each frame in the new PDO",
    )
    counters = [each[3] for each in heard[-20:]]
    steps = [(b - a) & 0xFF for a, b in itertools.pairwise(counters)]
    assert steps == [1] * 19 or run.held_up > held_up, "the live counter"
    spare.clear()
    spare.add_variable(0x2000, 2)
    spare.save()
    run.feed(0)
    voltage = fed.live(len(fed.sent) - 1).battery_voltage
    wait_for(lambda: nodes.of(0x1F1)[-1].data == voltage.to_bytes(2, "little"), "the shorter PDO")
    master.write(1, 0x1804, 1, INVALID | RTR_OFF | 0x1F1, 4)
    for can_id in (0x688, 0x281):  # the DBC's, TPDO 2's
        assert (
            master.refusal(lambda can_id=can_id: master.write(1, 0x1804, 1, RTR_OFF | can_id, 4))  # type: ignore[misc]
            == IN_USE
        )
