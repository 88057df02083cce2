"""The gateway at work on pseudo terminals and python-can's in-process bus; the parts of the runtime with a socket that is none."""

import errno
import os
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import pytest
from cantools.database.can import Database

from kontronik_can_gw.cli.common import assemble
from kontronik_can_gw.config import CanConfig, parse
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.mailboxes import Mailboxes, Sent
from kontronik_can_gw.offline.pty import PtyEsc
from kontronik_can_gw.protocol import Device, InfoData, Layout, LiveData, OperatingError, encode, rows
from kontronik_can_gw.runtime import can_port
from kontronik_can_gw.runtime.can_port import CanPort
from kontronik_can_gw.runtime.loop import Loop
from kontronik_can_gw.simulator import EscOptions, SimulatedEsc
from kontronik_can_gw.sources import CanState
from kontronik_can_gw.telemetry import LinkState

SECOND_NS = 1_000_000_000
PROGRAM = [sys.executable, "-m", "kontronik_can_gw"]
LIVE = LiveData(electrical_speed=12_345, battery_voltage=2442, battery_current=-17, operating_state=21)


class Bench:
    """A gateway's loop in a thread, and a participant of its bus that knows the DBC."""

    def __init__(self, *ports: str, wait: bool = False) -> None:
        channel = f"bench-{os.getpid()}-{id(self)}"
        tables = {
            "can": {"interface": "virtual", "channel": channel},
            "esc": [{"port": port, "pole_pairs": 7} for port in ports],
        }
        config = parse(tables, "bench.toml")
        self.database: Database
        loaded = assemble(config)
        assert loaded.database is not None
        self.database, layout = loaded.database, loaded.layout
        self.bus = can.Bus(interface="virtual", channel=channel)
        self.gateway = Gateway(config.escs, layout, time.monotonic_ns())
        self.loop = Loop(self.gateway, list(ports), config.can, wait)
        self._thread = threading.Thread(target=self.loop.run)
        try:
            self.loop.open()
            self._thread.start()
        except BaseException:
            self.bus.shutdown()
            raise

    def until(self, wanted: Callable[[str, dict[str, Any]], bool], what: str, seconds: float = 60) -> dict[str, Any]:
        """Read the bus until a message is as wanted; its signals, enumerations as numbers."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            message = self.bus.recv(left)
            if message is not None:
                known = self.database.get_message_by_frame_id(message.arbitration_id)
                signals: Any = known.decode_simple(bytes(message.data), decode_choices=False)
                if wanted(known.name, signals):
                    return dict(signals)
        raise AssertionError(f"{what}: not within {seconds} s")

    def speed(self, wanted: int, seconds: float = 60) -> None:
        """Wait for a speed on the bus."""
        self.until(lambda name, signals: signals.get("ElectricalSpeed") == wanted, f"speed {wanted}", seconds)

    def stop(self) -> None:
        self.loop.stop()
        self._thread.join(60)
        assert not self._thread.is_alive()


@contextmanager
def bench(*ports: str, wait: bool = False) -> Iterator[Bench]:
    made = Bench(*ports, wait=wait)
    try:
        yield made
    finally:
        made.stop()
        made.bus.shutdown()


@pytest.fixture
def esc() -> Iterator[PtyEsc]:
    with PtyEsc() as made:
        yield made
        made.check()
        assert made.received == 0, f"the gateway wrote to the ESC: {made.first_received!r}"


def key(name: str) -> str:
    return name.replace("_", "").lower().removesuffix("percent")


def expected(data: LiveData | InfoData) -> dict[str, float]:
    """The frame's values by normalized name, in physical units; bits beside words."""
    found: dict[str, float] = {
        key(name): row.physical(value)
        for (name, row), value in zip(rows(type(data)).items(), data, strict=True)
        if row.unit or name in ("operating_state", "timing", "cell_count")
    }
    if isinstance(data, LiveData):
        found |= {key(bit.text): data.operating_errors >> bit & 1 for bit in OperatingError}
        found |= {"motorspeed": round(data.electrical_speed / 7), "operatingstateraw": data.operating_state}
    else:
        found |= {"deviceraw": data.device, "variant": data.variant, "firmwaremain": data.firmware_word >> 8}
    return found


# --- end to end


@pytest.mark.parametrize(("device", "layout"), [(Device.KOSMIK, Layout.V4), (Device.JIVEPRO, Layout.LEGACY)])
def test_what_a_logger_decodes_is_what_the_simulated_esc_sent(esc: PtyEsc, device: Device, layout: Layout) -> None:
    simulated = SimulatedEsc(EscOptions(device=device, layout=layout), seed=4)
    sent = simulated.frames_until(40 * SECOND_NS)
    infos = [each for each in sent if isinstance(each.data, InfoData)]
    lives = [each for each in sent if isinstance(each.data, LiveData) and each.data.electrical_speed][::150]
    assert any(isinstance(each.data, LiveData) and each.data.battery_current < 0 for each in lives)
    with bench(esc.path) as running:
        esc.write(infos[-1].wire)
        for each in lives:
            esc.write(each.wire)
            want = expected(each.data)
            seen: set[str] = set()

            def equal(name: str, signals: dict[str, Any], want: dict[str, float] = want, seen: set[str] = seen) -> bool:
                if name in ("EscSpeed", "EscCurrent"):
                    known = {key(s): v for s, v in signals.items() if key(s) in want}
                    assert len(known) >= 4
                    if all(value == pytest.approx(want[s], abs=1e-9) for s, value in known.items()):
                        seen.add(name)
                return len(seen) == 2

            running.until(equal, f"{want}")
        # what is sent seldom: the last frame is repeated until all was seen
        values: dict[str, float] = {}
        last, end = lives[-1], time.monotonic() + 60
        want = expected(last.data) | expected(infos[-1].data)
        wrong = set(want)
        while wrong and time.monotonic() < end:
            esc.write(last.wire)
            with suppress(AssertionError):
                running.until(lambda _n, s: bool(values.update({key(k): v for k, v in s.items()})), "", 0.05)
            if device is Device.JIVEPRO:
                want |= dict.fromkeys(("beccurrent", "maxbeccurrent"), 65.535)  # not supplied: NotAvailable
            wrong = {name for name in want if values.get(name) != pytest.approx(want[name], abs=1e-9)}
        assert {name: (values.get(name), want[name]) for name in wrong} == {}
        assert values["linkstate"] == LinkState.OK
        assert values["layout"] == (1 if layout is Layout.V4 else 2)
        assert esc.check() == 0


def test_a_terminal_that_echoes_gets_no_echo_from_the_gateway() -> None:
    master, slave = os.openpty()  # fresh: echo on, lines, translations
    try:
        os.set_blocking(master, False)
        assert termios.tcgetattr(slave)[3] & termios.ECHO
        with bench(os.ttyname(slave)) as running:
            modes = termios.tcgetattr(slave)
            assert not modes[3] & (termios.ECHO | termios.ECHONL | termios.ICANON | termios.ISIG)
            assert not modes[1] & termios.OPOST
            for speed in (1, 0x0A0D03, 0x1A1104):  # carriage return, line feed, ^C, ^Z, ^Q, ^D among the bytes
                os.write(master, encode(LIVE._replace(electrical_speed=speed), Layout.V4))
                running.speed(speed)
            os.write(master, b"+++AT\rATSN?\r\n")  # what an ESC sends at power-up, to see whether someone answers
            os.write(master, encode(LIVE, Layout.V4))
            running.speed(12_345)
            with pytest.raises(BlockingIOError):
                os.read(master, 1)
    finally:
        os.close(slave)
        os.close(master)


def test_a_port_that_hangs_up_is_opened_again(tmp_path: Path) -> None:
    link = tmp_path / "esc"
    first = PtyEsc(link)
    with bench(str(link)) as running:
        first.write(encode(LIVE, Layout.V4))
        running.speed(12_345)
        assert first.check() == 0
        first.close()
        lost = {"LinkState": int(LinkState.PORT_ERROR), "ElectricalSpeed": 0xFFFFFF, "BatteryVoltage": 655.35}
        seen: dict[str, Any] = {}

        def all_lost(_name: str, signals: dict[str, Any]) -> bool:
            seen.update(signals)
            return all(seen.get(name) == pytest.approx(value) for name, value in lost.items())

        running.until(all_lost, "port error and values not available")
        with PtyEsc(link) as second:
            new = encode(LIVE._replace(electrical_speed=777), Layout.LEGACY)
            end = time.monotonic() + 60
            is_seen = False
            while not is_seen and time.monotonic() < end:
                second.write(new)
                with suppress(AssertionError):
                    running.speed(777, 0.02)
                    is_seen = True
            assert is_seen
            assert second.check() == 0


def test_file_descriptors_do_not_grow_with_a_port_that_comes_and_goes(tmp_path: Path) -> None:
    link = tmp_path / "esc"
    esc = PtyEsc(link)
    counts = []
    with bench(str(link)) as running:
        telemetry = running.gateway.escs[0]
        for cycle in range(8):
            esc.close()
            esc = PtyEsc(link)
            frame = encode(LIVE._replace(electrical_speed=cycle + 1), Layout.V4)
            end = time.monotonic() + 60
            while telemetry.live is None or telemetry.live.electrical_speed != cycle + 1:
                assert time.monotonic() < end, "not open again"
                esc.write(frame)
                select.select([], [], [], 0.002)
            assert esc.check() == 0
            while running.bus.recv(0) is not None:
                pass
            counts.append(len(os.listdir("/proc/self/fd")))
        esc.close()
    assert max(counts[2:]) <= counts[2]


def test_the_last_word_on_the_bus_is_that_the_gateway_stops(esc: PtyEsc) -> None:
    with bench(esc.path) as running:
        esc.write(encode(LIVE, Layout.V4))
        running.speed(12_345)
        running.until(lambda _, s: s.get("GatewayState") == 1, "running")
        running.stop()
        states = []
        while (message := running.bus.recv(0)) is not None:
            known = running.database.get_message_by_frame_id(message.arbitration_id)
            states.append((known.name, known.decode_simple(bytes(message.data))))
        name, signals = states[-1]
        assert (name, str(signals["GatewayState"])) == ("GatewayStatus", "Stopping")


# --- as processes


def test_stopping_a_loop_that_has_ended_writes_to_nobody(esc: PtyEsc) -> None:
    with bench(esc.path) as running:
        running.stop()
        read, write = os.pipe2(os.O_NONBLOCK)  # likely the numbers that the loop's own pipe had
        more = [os.pipe2(os.O_NONBLOCK) for _ in range(8)]
        running.loop.stop()
        for reader, writer in [(read, write), *more]:
            with pytest.raises(BlockingIOError):
                os.read(reader, 1)
            os.close(reader)
            os.close(writer)


def gateway_process(tmp_path: Path, ports: list[str]) -> subprocess.Popen[str]:
    """``run`` on the virtual interface, when all its ports are open."""
    file = tmp_path / "gateway.toml"
    escs = "".join(f'[[esc]]\nport = "{port}"\n' for port in ports)
    file.write_text(f'[can]\ninterface = "virtual"\nbitrate = 1_000_000\n{escs}')
    # python-can loads asammdf where it is installed, as for tests, and that NumPy's threads: they are none of ours
    quiet = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    process = subprocess.Popen([*PROGRAM, "run", "-c", str(file)], stderr=subprocess.PIPE, text=True, env=quiet)
    assert process.stderr is not None
    waiting = set(ports)
    while waiting:
        line = process.stderr.readline()
        assert line, "ended"
        waiting -= {port for port in waiting if f"{port} is open" in line}
    return process


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_gateway_well(tmp_path: Path, esc: PtyEsc, number: signal.Signals) -> None:
    process = gateway_process(tmp_path, [esc.path])
    try:
        process.send_signal(number)
        assert process.wait(60) == 0
        assert process.stderr is not None
        assert "Traceback" not in process.stderr.read()
    finally:
        process.kill()
        process.communicate()


@pytest.mark.extended
def test_the_demonstration_in_a_pipe_prints_plain_lines() -> None:
    command = [*PROGRAM, "demo", "--seconds", "3"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines
    assert "\x1b" not in done.stdout
    for line in lines:
        assert re.match(r" +\d+\.\d s  link \w+ +ElectricalSpeed .* BatteryVoltage [\d.]+ V .* state \w+", line), line
    assert re.fullmatch(r"kontronik-can-gw: \d+ CAN frames decoded, 0 bytes sent to the ESC\n", done.stderr)


# --- mailboxes


def frame(can_id: int, value: int, extended: bool = False) -> CanFrame:
    return CanFrame(can_id, bytes((value,)), extended)


def test_of_each_id_only_the_newest_frame_waits_and_the_order_is_that_of_waiting() -> None:
    mailboxes, sent = Mailboxes(), list[CanFrame]()

    def take(frames: Sequence[CanFrame]) -> tuple[int, Sent]:
        sent.extend(frames)
        return len(frames), Sent.OK

    for each in (frame(1, 1), frame(2, 1), frame(1, 2), frame(1, 9, True), frame(1, 3)):
        mailboxes.put(each)
    assert (len(mailboxes), mailboxes.replaced) == (3, 2)
    assert mailboxes.flush(take) == (3, Sent.OK)
    assert sent == [frame(1, 3), frame(2, 1), frame(1, 9, True)]
    assert (len(mailboxes), mailboxes.flush(take)) == (0, (0, Sent.OK))


# --- the CAN port on a socket that is none


def state_of(port: CanPort) -> CanState:
    return port.state


class FakeSocket:
    """A raw CAN socket: ``faults`` are the errors of the next sends, ``inbox`` is what comes."""

    def __init__(self) -> None:
        self.faults: list[int] = []
        self.inbox: list[bytes | int] = []
        self.sent: list[bytes] = []
        self.options: list[object] = []
        self.blocking = True

    def setsockopt(self, *option: object) -> None:
        self.options.append(option)

    def getsockopt(self, _level: int, _name: int, size: int) -> bytes:
        return bytes(size)

    def setblocking(self, blocking: bool) -> None:
        self.blocking = blocking

    def fileno(self) -> int:
        return 99

    def send(self, data: bytes) -> None:
        if self.faults:
            number = self.faults.pop(0)
            raise OSError(number, os.strerror(number))
        self.sent.append(data)

    def recvmsg(self, _size: int, _ancillary_size: int) -> tuple[bytes, list[Any], int, None]:
        if not self.inbox:
            raise BlockingIOError
        data = self.inbox.pop(0)
        if isinstance(data, int):
            raise OSError(data, os.strerror(data))
        return data, [], 0, None


@pytest.fixture
def socket_port(monkeypatch: pytest.MonkeyPatch) -> tuple[CanPort, FakeSocket]:
    fake = FakeSocket()
    monkeypatch.setattr(can_port, "_open", lambda _: SimpleNamespace(socket=fake))
    return CanPort(CanConfig()), fake


def test_the_socket_never_waits_and_takes_no_data_frames(socket_port: tuple[CanPort, FakeSocket]) -> None:
    port, fake = socket_port
    assert not fake.blocking
    assert fake.options
    assert fake.options[0][-1] == b""  # type: ignore[index]
    assert port.fileno() == 99


def test_frames_go_out_as_the_kernel_wants_them(socket_port: tuple[CanPort, FakeSocket]) -> None:
    port, fake = socket_port
    assert port.send(CanFrame(0x6D8, b"abc")) is Sent.OK
    assert port.send(CanFrame(0x6D8, b"abcdefgh", extended=True)) is Sent.OK
    assert port.send(CanFrame(0x1, bytes(64), fd=True)) is Sent.OK
    assert struct.unpack("=IB3x8s", fake.sent[0]) == (0x6D8, 3, b"abc" + bytes(5))
    assert struct.unpack("=IB3x8s", fake.sent[1]) == (0x8000_06D8, 8, b"abcdefgh")
    assert struct.unpack("=IBB2x64s", fake.sent[2]) == (1, 64, 1, bytes(64))
    assert state_of(port) is CanState.ERROR_ACTIVE


@pytest.mark.parametrize("number", [errno.ENOBUFS, errno.EAGAIN, errno.ENOMEM])
def test_a_full_queue_is_busy_and_says_nothing_of_the_state(
    socket_port: tuple[CanPort, FakeSocket], number: int
) -> None:
    port, fake = socket_port
    fake.faults = [number]
    assert port.send(frame(1, 1)) is (Sent.FULL if number == errno.EAGAIN else Sent.BUSY)
    assert state_of(port) is CanState.UNKNOWN
    assert port.send(frame(1, 1)) is Sent.OK


def test_an_interface_that_was_down_reports_it_once_more_and_is_tried_again(
    socket_port: tuple[CanPort, FakeSocket],
) -> None:
    port, fake = socket_port
    fake.faults = [errno.ENETDOWN]
    assert port.send(frame(1, 1)) is Sent.OK
    fake.faults = [errno.ENETDOWN, errno.ENETDOWN]
    assert port.send(frame(1, 2)) is Sent.DOWN
    assert state_of(port) is CanState.DOWN
    assert port.send(frame(1, 3)) is Sent.OK
    assert state_of(port) is CanState.ERROR_ACTIVE


@pytest.mark.parametrize("number", [errno.ENXIO, errno.ENODEV, errno.EBADF])
def test_an_interface_that_was_removed_is_gone(socket_port: tuple[CanPort, FakeSocket], number: int) -> None:
    port, fake = socket_port
    fake.faults = [number]
    assert port.send(frame(1, 1)) is Sent.GONE
    assert state_of(port) is CanState.DOWN


def error_frame(kind: int, detail: int = 0) -> bytes:
    return struct.pack("=IB3x8s", 0x2000_0000 | kind, 8, bytes((0, detail)))


@pytest.mark.parametrize(
    ("kind", "detail", "state"),
    [
        (0x40, 0, CanState.BUS_OFF),
        (0x100, 0, CanState.ERROR_ACTIVE),
        (0x04, 0x04, CanState.ERROR_WARNING),
        (0x04, 0x08, CanState.ERROR_WARNING),
        (0x04, 0x10, CanState.ERROR_PASSIVE),
        (0x04, 0x20, CanState.ERROR_PASSIVE),
        (0x04, 0x30, CanState.ERROR_PASSIVE),
        (0x04, 0x40, CanState.ERROR_ACTIVE),
        (0x04, 0x00, CanState.UNKNOWN),
        (0x20, 0x40, CanState.UNKNOWN),  # no acknowledge: says nothing of the state
    ],
)
def test_error_frames_tell_the_controllers_state(
    socket_port: tuple[CanPort, FakeSocket], kind: int, detail: int, state: CanState
) -> None:
    port, fake = socket_port
    fake.inbox = [error_frame(kind, detail)]
    port.receive()
    assert state_of(port) is state


def test_data_frames_and_fragments_say_nothing_of_the_state_and_a_removed_interface_is_down(
    socket_port: tuple[CanPort, FakeSocket],
) -> None:
    port, fake = socket_port
    fake.inbox = [struct.pack("=IB3x8s", 0x40, 8, b"\x40" * 8), b"short"]
    assert port.receive() == []
    assert state_of(port) is CanState.UNKNOWN
    fake.inbox = [errno.ENETDOWN]
    port.receive()
    assert state_of(port) is CanState.DOWN
    fake.inbox = [errno.EIO]
    port.receive()
    assert state_of(port) is CanState.DOWN


def test_a_flood_of_error_frames_does_not_hold_the_loop(socket_port: tuple[CanPort, FakeSocket]) -> None:
    port, fake = socket_port
    fake.inbox = [error_frame(0x40)] * 1000
    port.receive()
    assert len(fake.inbox) >= 900
    port.close()


def test_another_interfaces_refusal_is_busy(monkeypatch: pytest.MonkeyPatch) -> None:
    class Refusing:
        def send(self, _message: can.Message, timeout: float) -> None:
            assert timeout == 0
            raise can.CanOperationError("full")

    monkeypatch.setattr(can_port, "_open", lambda _: Refusing())
    port = CanPort(CanConfig(interface="pcan"))
    assert port.fileno() is None
    assert port.send(frame(1, 1)) is Sent.BUSY
    port.receive()
    port.close()
