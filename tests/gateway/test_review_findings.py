"""Faults that a review found, each kept from coming back. Time is passed in."""

import os
import struct
from collections.abc import Callable, Collection, Sequence
from itertools import pairwise
from pathlib import Path

import cantools.database
import pytest

from kontronik_can_gw.cli import main
from kontronik_can_gw.config import CanConfig
from kontronik_can_gw.dbc_output.layout import DbcSettings, Layout, load_database
from kontronik_can_gw.dbc_output.prepare import prepare
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.mailboxes import Mailboxes, Sent
from kontronik_can_gw.offline.pty import PtyEsc
from kontronik_can_gw.protocol import codec
from kontronik_can_gw.protocol.fields import InfoData, LiveData
from kontronik_can_gw.runtime import can_side
from kontronik_can_gw.runtime.can_port import one_by_one
from kontronik_can_gw.runtime.loop import Loop
from kontronik_can_gw.sources import CanState
from kontronik_can_gw.telemetry import MS, SECOND, EscSettings

HEAD = """VERSION ""

NS_ :

BS_:

BU_: Gw Car

"""
TAIL = """
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ BO_ "GenMsgDelayTime" INT 0 65535;
BA_DEF_ BO_ "GenMsgSendType" ENUM "Cyclic","Event","OnChange","CyclicAndEvent","CyclicAndOnChange";
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "GenMsgDelayTime" 0;
BA_DEF_DEF_ "GenMsgSendType" "Event";
"""
PAGES = """BO_ 256 Pages: 8 Gw
 SG_ Page M : 0|4@1+ (1,0) [0|0] "" Car
 SG_ BatteryVoltage m0 : 8|16@1+ (0.01,0) [0|0] "V" Car
 SG_ MotorCurrent m1 : 8|16@1- (0.1,0) [0|0] "A" Car
 SG_ BecVoltage m2 : 8|16@1+ (0.001,0) [0|0] "V" Car
"""
ONE = EscSettings("esc1")


def layout_of(tmp_path: Path, text: str, escs: Sequence[EscSettings] = (ONE,)) -> Layout:
    path = tmp_path / "my.dbc"
    path.write_bytes(text.encode("utf-8"))
    return prepare(load_database(path), "my.dbc", escs, DbcSettings(), fd_allowed=True)[1]


def gateway_of(tmp_path: Path, text: str) -> Gateway:
    return Gateway([ONE], layout_of(tmp_path, text), 0)


def frame_of(live: LiveData) -> bytes:
    return codec.encode(live, codec.Layout.V4)


def until(gateway: Gateway, now: int, end: int) -> list[tuple[int, CanFrame]]:
    """Advance from deadline to deadline; the frames with their times."""
    found = [(now, frame) for frame in gateway.take_frames()]
    while (now := max(gateway.next_deadline(), now + 1)) <= end:
        gateway.advance(now)
        found += [(now, frame) for frame in gateway.take_frames()]
    return found


@pytest.mark.parametrize("kind", [1, 2])
def test_on_loss_every_page_of_a_multiplexed_message_is_said_to_be_not_available(tmp_path: Path, kind: int) -> None:
    gateway = gateway_of(tmp_path, HEAD + PAGES + TAIL + f'BA_ "GenMsgSendType" BO_ 256 {kind};\n')
    gateway.start(0)
    for n in range(12):
        gateway.receive_bytes(
            0, frame_of(LiveData(battery_voltage=5000 + n, motor_current=n, bec_voltage=n)), n * 10 * MS, n * 10 * MS
        )
        until(gateway, n * 10 * MS, n * 10 * MS + 9 * MS)
    after = [frame for _, frame in until(gateway, 120 * MS, 2 * SECOND)]
    gone = {frame.data[0]: frame.data[1:3] for frame in after}
    assert gone == {0: b"\xff\xff", 1: b"\x00\x80", 2: b"\xff\xff"}
    assert len(after) == 3


def test_after_an_outage_of_the_bus_what_has_no_cycle_is_said_again(tmp_path: Path) -> None:
    message = 'BO_ 256 M: 8 Gw\n SG_ ElectricalSpeed : 0|32@1+ (1,0) [0|0] "1/min" Car\n'
    gateway = gateway_of(tmp_path, HEAD + message + TAIL)
    gateway.start(0)
    gateway.receive_bytes(0, frame_of(LiveData(electrical_speed=30_000)), 10 * MS, 10 * MS)
    until(gateway, 10 * MS, 20 * MS)
    until(gateway, 20 * MS, SECOND)  # lost meanwhile, and what was said of it did not reach the bus
    gateway.can_returned(SECOND)
    assert [frame.data[:4] for frame in gateway.take_frames()] == [b"\xff\xff\xff\xff"]


def test_counters_in_messages_without_a_cycle_do_not_go_stale(tmp_path: Path) -> None:
    message = """BO_ 256 Counts: 8 Gw
 SG_ CrcErrors : 0|16@1+ (1,0) [0|0] "" Car
 SG_ DroppedBytes : 16|32@1+ (1,0) [0|0] "" Car

BO_ 257 Energy: 8 Gw
 SG_ EnergyUsed : 0|32@1+ (0.001,0) [0|0] "Wh" Car

BO_ 258 Self: 8 Gw
 SG_ Uptime : 0|32@1+ (1,0) [0|0] "s" Car
"""
    gateway = gateway_of(tmp_path, HEAD + message + TAIL + 'BA_ "GenMsgSendType" BO_ 256 2;\n')
    gateway.start(0)
    seen: dict[int, bytes] = {}
    good = frame_of(LiveData(battery_voltage=5000, battery_current=1000))
    for n in range(3000):
        now = n * 10 * MS
        bad = good[:20] + b"\x55" + good[21:]
        gateway.receive_bytes(0, good if n % 10 else bad, now, now)
        for _, frame in until(gateway, now, now + 9 * MS):
            seen[frame.can_id] = frame.data
    counters = gateway.escs[0].counters
    sent = struct.unpack("<HI", seen[256][:6])
    assert abs(sent[0] - counters.crc_errors) <= 11
    assert abs(sent[1] - counters.dropped_bytes) <= 11 * 40
    assert int.from_bytes(seen[257][:4], "little") / 1000 == pytest.approx(50 * 100 * 30 / 3600, rel=0.02)
    assert int.from_bytes(seen[258][:4], "little") >= 28


def test_a_cycle_that_meets_the_minimum_distance_is_put_off_not_lost(tmp_path: Path) -> None:
    message = 'BO_ 256 M: 8 Gw\n SG_ ElectricalSpeed : 0|32@1+ (1,0) [0|0] "1/min" Car\n'
    tail = 'BA_ "GenMsgSendType" BO_ 256 4;\nBA_ "GenMsgCycleTime" BO_ 256 100;\nBA_ "GenMsgDelayTime" BO_ 256 90;\n'
    gateway = gateway_of(tmp_path, HEAD + message + TAIL + tail)
    gateway.start(0)
    times = []
    for n in range(1000):
        now = n * 10 * MS
        gateway.receive_bytes(0, frame_of(LiveData(electrical_speed=n // 35)), now, now)
        times += [when for when, _ in until(gateway, now, now + 9_999_999)]
    gaps = [(b - a) / MS for a, b in pairwise(times)]
    assert min(gaps) >= 90
    assert max(gaps) <= 100 + 90


def test_a_fault_of_one_frame_is_not_passed_over_when_two_come_in_one_read(tmp_path: Path) -> None:
    message = 'BO_ 256 M: 8 Gw\n SG_ OperatingErrors : 0|32@1+ (1,0) [0|0] "" Car\n'
    gateway = gateway_of(tmp_path, HEAD + message + TAIL + 'BA_ "GenMsgSendType" BO_ 256 2;\n')
    gateway.start(0)
    gateway.take_frames()
    gateway.receive_bytes(0, frame_of(LiveData(operating_errors=1)) + frame_of(LiveData()), 100 * MS, 100 * MS)
    assert [frame.data[0] for frame in gateway.take_frames()] == [1, 0]


def test_each_page_of_a_multiplexed_message_has_its_own_slot() -> None:
    mailboxes, sent, free = Mailboxes(), list[int](), True

    def send(frames: Sequence[CanFrame]) -> tuple[int, Sent]:
        if not free:
            return 0, Sent.BUSY
        sent.extend(frame.page for frame in frames)
        return len(frames), Sent.OK

    for n in range(100):
        free = n % 2 == 1
        mailboxes.put(CanFrame(1, b"", page=n % 2))
        mailboxes.flush(send)
    assert set(sent) == {0, 1}


def test_can_fd_load_counts_the_data_phase_at_its_own_rate(tmp_path: Path) -> None:
    messages = "".join(
        f'BO_ {256 + n} M{n}: 64 Gw\n SG_ ElectricalSpeed : 0|32@1+ (1,0) [0|0] "1/min" Car\n\n' for n in range(8)
    )
    layout = layout_of(tmp_path, HEAD + messages + TAIL)
    assert 0.25 < layout.bus_load(500_000, 2_000_000) < 0.45
    assert layout.bus_load(500_000, 500_000) > 1


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a byte order mark", "\ufeff" + HEAD + 'BO_ 256 M: 8 Gw\n SG_ Throttle : 0|8@1- (1,0) [0|0] "%" Car\n' + TAIL),
        (
            "a value table by its name",
            HEAD.replace("BU_: Gw Car\n", 'BU_: Gw Car\nVAL_TABLE_ Na 255 "NotAvailable" 254 "Error" ;\n')
            + 'BO_ 256 M: 8 Gw\n SG_ Timing : 0|8@1+ (1,0) [0|0] "us" Car\n'
            + TAIL
            + "VAL_ 256 Timing Na ;\n",
        ),
        (
            "an enumeration attribute by its text",
            HEAD
            + 'BO_ 256 M: 8 Gw\n SG_ Timing : 0|8@1+ (1,0) [0|0] "us" Car\n'
            + TAIL
            + 'BA_ "GenMsgSendType" BO_ 256 "Cyclic";\nBA_ "GenMsgCycleTime" BO_ 256 20;\n',
        ),
    ],
)
def test_files_of_other_tools_are_read(tmp_path: Path, name: str, text: str) -> None:
    (message,) = layout_of(tmp_path, text).messages
    if "attribute" in name:
        assert message.cycle_ns == 20 * MS
    if "table" in name:
        assert message.signals[0].not_available == 255
        assert message.signals[0].error == 254


def test_a_dbc_with_characters_of_windows_1252_reads_back_the_same(tmp_path: Path) -> None:
    text = (
        HEAD
        + 'BO_ 256 M: 8 Gw\n SG_ BecTemperature : 0|8@1- (1,0) [0|0] "°C" Car\n\nCM_ SG_ 256 BecTemperature "fünf";\n'
        + TAIL
    )
    (tmp_path / "in.dbc").write_bytes(text.encode("cp1252"))
    out = tmp_path / "out.dbc"
    assert main(["dbc", "--from", str(tmp_path / "in.dbc"), "-o", str(out)]) == 0
    loaded = cantools.database.load_file(out)
    assert isinstance(loaded, cantools.database.Database)
    signal = loaded.messages[0].signals[0]
    assert (signal.unit, signal.comment) == ("°C", "fünf")


def test_mixed_names_with_and_without_an_esc_are_told_by_the_signal_of_the_file(tmp_path: Path) -> None:
    text = (
        HEAD
        + 'BO_ 256 M: 8 Gw\n SG_ LeftTiming : 0|8@1+ (1,0) [0|0] "us" Car\n SG_ Throttle : 8|8@1- (1,0) [0|0] "%" Car\n'
        + TAIL
    )
    with pytest.raises(UserError, match=r"M\.Throttle: does not say of which ESC"):
        layout_of(tmp_path, text, [EscSettings("left"), EscSettings("right")])


def test_an_esc_is_never_opened_as_a_can_interface() -> None:
    """slcan and the like would send to it."""
    with PtyEsc() as esc:
        settings = CanConfig(interface="slcan", channel=f"{esc.path}@115200")
        loop = Loop(Gateway([ONE], Layout("x", "Gw", ()), 0), [esc.path], settings)
        with pytest.raises(RunError, match="nothing may be sent to an ESC"):
            loop.open()
        esc.check()
        assert esc.received == 0


def test_an_interface_that_python_can_does_not_know_is_found_before_anything_is_opened(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "g.toml"
    file.write_text('[can]\ninterface = "sockeetcan"\n[[esc]]\nport = "/dev/null"\n')
    assert main(["check", "-c", str(file)]) == 2
    assert "Did you mean socketcan?" in capsys.readouterr().err


class StoppedBusBase:
    """What every stand-in for a CAN port without a descriptor has."""

    state = CanState.ERROR_ACTIVE
    tells_busy_from_gone = False
    gone = False
    bus_off_count = overruns = 0

    def send(self, frame: CanFrame) -> Sent:
        raise NotImplementedError

    def send_all(self, frames: Sequence[CanFrame], clock: Callable[[], int], latest: int) -> tuple[int, Sent]:
        return one_by_one(self.send, frames, clock, latest)

    def fileno(self) -> None:
        return None

    def set_receive_ids(self, ids: Collection[int]) -> None:
        """Nothing comes from it."""

    def discard(self) -> None:
        pass

    def close(self) -> None:
        pass


def test_a_read_of_many_old_frames_is_no_flood_of_link_changes(tmp_path: Path) -> None:
    message = 'BO_ 256 M: 8 Gw\n SG_ ElectricalSpeed : 0|32@1+ (1,0) [0|0] "1/min" Car\n'
    gateway = gateway_of(tmp_path, HEAD + message + TAIL)
    gateway.start(0)
    gateway.take_frames()
    gateway.receive_bytes(0, b"".join(frame_of(LiveData(electrical_speed=n)) for n in range(100)), SECOND, SECOND)
    assert gateway.take_link_changes() == [0]
    assert gateway.escs[0].losses == 0
    assert gateway.escs[0].late_frames > 20
    assert [frame.data[0] for frame in gateway.take_frames()][-1] == 99


def test_a_page_that_changes_often_does_not_starve_the_cycle_of_the_others(tmp_path: Path) -> None:
    tail = 'BA_ "GenMsgSendType" BO_ 256 4;\nBA_ "GenMsgCycleTime" BO_ 256 100;\n'
    gateway = gateway_of(tmp_path, HEAD + PAGES + TAIL + tail)
    gateway.start(0)
    pages = {0: 0, 1: 0, 2: 0}
    for n in range(1000):
        gateway.receive_bytes(0, frame_of(LiveData(battery_voltage=n)), n * 10 * MS, n * 10 * MS)
        for _, frame in until(gateway, n * 10 * MS, n * 10 * MS + 9 * MS):
            pages[frame.data[0]] += 1
    assert pages[0] >= 990
    assert pages[1] >= 30
    assert pages[2] >= 30


@pytest.mark.parametrize(
    "entry",
    [
        'CM_ "first\nVAL_ 256 Timing z ;\nBA_ "',
        'CM_ SG_ 256 Timing "one; two\nVAL_TABLE_ z 1 fake ;";',
    ],
)
def test_comments_are_not_touched_where_files_of_other_tools_are_read(tmp_path: Path, entry: str) -> None:
    entry = entry if entry.endswith(";") else entry[:-4] + '";'
    tables = 'BU_: Gw Car\nVAL_TABLE_ z 254 "Error; bad" 255 "NotAvailable" ;\n'
    text = HEAD.replace("BU_: Gw Car\n", tables) + 'BO_ 256 M: 8 Gw\n SG_ Timing : 0|8@1+ (1,0) [0|0] "us" Car\n\n'
    path = tmp_path / "c.dbc"
    path.write_text(text + entry + "\n" + TAIL + "VAL_ 256 Timing z ;\n")
    database = load_database(path)
    signal = database.messages[0].signals[0]
    said = signal.comment or (database.dbc.comment if database.dbc and hasattr(database.dbc, "comment") else None)
    assert dict(signal.choices or {}) == {254: "Error; bad", 255: "NotAvailable"}
    if said:
        assert said in entry


def test_an_enumeration_text_that_is_not_listed_is_told(tmp_path: Path) -> None:
    text = HEAD + 'BO_ 256 M: 8 Gw\n SG_ Timing : 0|8@1+ (1,0) [0|0] "us" Car\n' + TAIL
    with pytest.raises(UserError, match='"GenMsgSendType": "Sometimes" is none of'):
        layout_of(tmp_path, text + 'BA_ "GenMsgSendType" BO_ 256 "Sometimes";\n')


def test_a_link_change_without_live_data_is_told_by_event_messages_that_show_it(tmp_path: Path) -> None:
    message = """BO_ 256 M: 8 Gw
 SG_ ElectricalSpeed : 0|32@1+ (1,0) [0|0] "1/min" Car
 SG_ LinkState : 32|8@1+ (1,0) [0|0] "" Car
"""
    gateway = gateway_of(tmp_path, HEAD + message + TAIL)
    gateway.start(0)
    gateway.receive_bytes(0, frame_of(LiveData()), 10 * MS, 10 * MS)
    until(gateway, 10 * MS, SECOND)
    gateway.port_lost(0, SECOND)
    assert [frame.data[4] for frame in gateway.take_frames()] == [5]


def test_info_that_runs_out_is_said_on_every_page(tmp_path: Path) -> None:
    pages = """BO_ 256 Pages: 8 Gw
 SG_ Page M : 0|4@1+ (1,0) [0|0] "" Car
 SG_ MinBatteryVoltage m0 : 8|16@1+ (0.01,0) [0|0] "V" Car
 SG_ MaxBatteryVoltage m1 : 8|16@1+ (0.01,0) [0|0] "V" Car
"""
    gateway = gateway_of(tmp_path, HEAD + pages + TAIL)
    gateway.start(0)
    last: dict[int, bytes] = {}
    for n in range(2000):
        now = n * 10 * MS
        data = frame_of(LiveData())
        if n % 100 == 0 and n < 500:
            data += codec.encode(InfoData(min_battery_voltage=1, max_battery_voltage=2), codec.Layout.V4)
        gateway.receive_bytes(0, data, now, now)
        for _, frame in until(gateway, now, now + 9 * MS):
            last[frame.data[0]] = frame.data[1:3]
    assert last == {0: b"\xff\xff", 1: b"\xff\xff"}


class ScriptedBus(StoppedBusBase):
    """Answers with what ``answer`` says at each moment."""

    def __init__(self, clock: list[int]) -> None:
        self.clock = clock
        self.sent: list[CanFrame] = []
        self.closed = False
        self.taken = 0

    def close(self) -> None:
        self.closed = True

    def send(self, frame: CanFrame) -> Sent:
        self.taken += 1
        if self.taken % 3 == 0:
            return Sent.BUSY
        self.sent.append(frame)
        return Sent.OK


def test_a_saturated_bus_is_not_taken_for_a_dead_adapter(tmp_path: Path) -> None:
    clock = [0]
    message = 'BO_ 256 M: 8 Gw\n SG_ Uptime : 0|32@1+ (1,0) [0|0] "s" Car\n'
    layout = layout_of(tmp_path, HEAD + message + TAIL)
    with PtyEsc() as esc:
        loop = Loop(
            Gateway([ONE], layout, 0),
            [esc.path],
            CanConfig(interface="virtual", channel="busy"),
            clock=lambda: clock[0],
        )
        loop.open()
        bus = ScriptedBus(clock)
        loop.can._close_port()
        loop.can.port = bus  # type: ignore[assignment]
        for n in range(500):
            clock[0] += 10 * MS
            for can_id in range(10):
                loop.can.mailboxes.put(CanFrame(0x100 + can_id, bytes((n & 255,))))
            loop.can.transmit(clock[0])
        assert not bus.closed
        assert len(bus.sent) > 500
        loop.close()


def test_closed_standard_streams_never_lend_their_number_to_a_port(tmp_path: Path) -> None:
    """With descriptor 2 closed a port could get that number, and what is said on standard error would go to the ESC."""
    import subprocess
    import sys

    code = (
        "import os; [os.close(n) for n in (0, 1, 2)]\n"
        "from kontronik_can_gw.cli import main\n"
        "code = main(['schema'])\n"
        f"fd = os.open({str(tmp_path / 'x')!r}, os.O_CREAT | os.O_WRONLY)\n"
        "os.write(fd, b'%d %d' % (fd, code))\n"
    )
    subprocess.run([sys.executable, "-c", code], check=False, timeout=30)
    fd, code_text = (tmp_path / "x").read_text().split()
    assert int(fd) > 2
    assert code_text == "0"
    assert os.path.exists("/dev/null")


class DownBus(StoppedBusBase):
    """Down from 200 ms to 1 s; opened and closed like an interface."""

    def __init__(self, clock: list[int]) -> None:
        self.clock = clock
        self.sent: list[CanFrame] = []

    def send(self, frame: CanFrame) -> Sent:
        if 200 * MS <= self.clock[0] < SECOND:
            return Sent.DOWN
        self.sent.append(frame)
        return Sent.OK


def test_a_loss_during_an_outage_is_told_behind_it_though_nothing_else_is_sent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    message = 'BO_ 256 M: 8 Gw\n SG_ ElectricalSpeed : 0|32@1+ (1,0) [0|0] "1/min" Car\n'
    clock = [0]
    gateway = gateway_of(tmp_path, HEAD + message + TAIL)
    with PtyEsc() as esc:
        loop = Loop(gateway, [esc.path], CanConfig(interface="virtual", channel="down"), clock=lambda: clock[0])
        loop.open()
        bus = DownBus(clock)

        def open_bus(_config: CanConfig) -> DownBus:
            if bus.send(CanFrame(0x7FF, b"")) is Sent.DOWN:
                raise RunError("is down")
            return bus

        monkeypatch.setattr(can_side, "CanPort", open_bus)
        loop.can._close_port()
        loop.can.port = bus  # type: ignore[assignment]
        gateway.start(0)
        while clock[0] < 3 * SECOND:
            clock[0] += 10 * MS
            if clock[0] <= 200 * MS:
                gateway.receive_bytes(0, frame_of(LiveData(electrical_speed=5000)), clock[0], clock[0])
            loop._reopen(clock[0])
            gateway.advance(clock[0])
            loop.can.transmit(clock[0])
        loop.close()
    assert bus.sent[-1].data[:4] == b"\xff\xff\xff\xff"
    assert loop.can.complaint == ""
