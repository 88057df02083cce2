"""One ESC's port in the loop: adapters, counters and log lines.

Time is passed in, and the ports are scripted.
"""

import errno
import logging
import os
import select
import termios
import time
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from wire_world import Wire, World, loop_in, run

from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.desk.pty import PtyEsc
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.kontronik import codec
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData, device_and_variant
from kontronik_can_gw.esc.kontronik.protocol import KONTRONIK
from kontronik_can_gw.esc.kontronik.states import Device
from kontronik_can_gw.esc.telemetry import EscSettings, LinkState
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.ports import esc_port as esc_input
from kontronik_can_gw.runtime.ports import serial_port, usb_adapters
from kontronik_can_gw.runtime.ports.esc_port import EscPort
from kontronik_can_gw.runtime.ports.serial_port import NoPort, PortLost, is_mini_uart
from kontronik_can_gw.runtime.ports.usb_adapters import UsbIdentity
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("ports-reopen")

LEFT = UsbIdentity(0x403, 0x6001, "A1", "1.0")
RIGHT = UsbIdentity(0x403, 0x6001, "B2", "1.0")
LIVE = codec.encode(LiveData(battery_voltage=2442), codec.WireLayout.V4)


class Port(Wire):
    """A serial port with scripted reads. ``there`` maps each path to its adapter."""

    there: dict[str, UsbIdentity | None]

    def __init__(self, path: str, _protocol: object) -> None:
        if path not in self.there:
            raise RunError(f"{path}: no such serial port.")
        super().__init__(World(), int(path[-1]) if path[-1].isdigit() else 9)
        self.path = path
        self.reads: list[bytes | Exception] = []
        self.counts: dict[str, int] = {"parity": 5}

    def identity(self) -> UsbIdentity | None:
        return self.there[self.path]

    def read(self, most: int = 0) -> bytes:
        found = self.reads.pop(0)
        if isinstance(found, Exception):
            raise found
        return found

    def line_errors(self) -> dict[str, int]:
        return dict(self.counts)


class Bench:
    """The ESCs "left" and "right" at these paths, with open ports."""

    def __init__(self, *paths: str) -> None:
        escs = [EscSettings(name) for name in ("left", "right")[: len(paths)]]
        self.gateway = Gateway(CoreSettings(escs, MessageLayout("x", "Gw", ())), 0)
        self.conditions = FaultLog()
        self.poller = World().poller
        self.lost: set[EscPort] = set()
        self.escs = [
            EscPort(
                n, path, self.gateway, self.poller, self.conditions, self.lost, time.monotonic_ns
            )
            for n, path in enumerate(paths)
        ]
        for esc in self.escs:
            esc.open(0, wait=False)

    def port(self, number: int = 0) -> Port:
        port = self.escs[number].port
        assert isinstance(port, Port)
        return port

    def lose(self, number: int, now: int) -> None:
        self.port(number).reads = [PortLost("unplugged")]
        self.escs[number].serve(now)

    def reopen(self, now: int) -> None:
        for esc in self.escs:
            others = tuple(other.identity for other in self.escs if other is not esc)
            esc.reopen(now, others)


@pytest.fixture
def there(monkeypatch: pytest.MonkeyPatch) -> dict[str, UsbIdentity | None]:
    ports: dict[str, UsbIdentity | None] = {}
    Port.there = ports
    monkeypatch.setattr(esc_input, "SerialPort", Port)

    def usb_ports() -> list[tuple[str, UsbIdentity]]:
        return [(path, identity) for path, identity in ports.items() if identity is not None]

    monkeypatch.setattr(usb_adapters, "adapters", usb_ports)
    return ports


@pytest.fixture
def bench(there: dict[str, UsbIdentity | None]) -> Bench:
    """Return a bench with one ESC on /dev/ttyUSB0."""
    there[USB0] = LEFT
    return Bench(USB0)


USB0, USB1, USB2, USB3 = (f"/dev/ttyUSB{n}" for n in range(4))
BY_ID = "/dev/serial/by-id/usb-FTDI"
BY_PATH = "/dev/serial/by-path/usb-0:1"
BOTH = {USB0: LEFT, USB1: RIGHT}
TURNED = {USB0: RIGHT, USB1: LEFT}
REPLUGGED: dict[str, tuple[dict[str, UsbIdentity], dict[str, UsbIdentity], list[str | None]]] = {
    "an adapter under another number is found": ({USB0: LEFT}, {USB3: LEFT}, [USB3]),
    "two in the other order keep their ESCs": (BOTH, TURNED, [USB1, USB0]),
    "left does not show the values of right": (BOTH, {USB0: RIGHT}, [None, USB0]),
    "one serial number": ({USB0: LEFT, USB1: LEFT}, {USB1: LEFT}, [None, USB1]),
    "another one on the path is a replacement": ({USB0: LEFT}, {USB0: RIGHT}, [USB0]),
    "a stable name by id is followed as it is": ({BY_ID: LEFT}, {USB0: LEFT}, [None]),
    "a stable name by path is followed as it is": ({BY_PATH: LEFT}, {USB0: LEFT}, [None]),
    "neither of two identical adapters is chosen": ({USB0: LEFT}, {USB1: LEFT, USB2: LEFT}, [None]),
}


@pytest.mark.promise("adapter-identity")
@pytest.mark.parametrize(("before", "after", "found"), REPLUGGED.values(), ids=REPLUGGED.keys())
def test_each_esc_gets_its_own_adapter_after_replugging(
    there: dict[str, UsbIdentity | None],
    before: dict[str, UsbIdentity],
    after: dict[str, UsbIdentity],
    found: list[str | None],
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "kontronik_can_gw")
    there |= before
    bench = Bench(*before)
    there.clear()
    for number in range(len(before)):
        bench.lose(number, SECOND)
    bench.reopen(2 * SECOND)
    assert [esc.port for esc in bench.escs] == [None] * len(before)
    there |= after
    bench.reopen(3 * SECOND)
    assert [esc.port and esc.port.path for esc in bench.escs] == found
    for path, esc in zip(found, bench.escs, strict=True):
        assert esc.reopened == (path is not None)
        if path is not None:
            assert f"{esc.name}: {path} is open, after 2.0 s" in caplog.messages
            assert esc.identity == after[path]


@pytest.mark.promise("adapter-identity")
def test_esc_is_found_by_its_adapter(there: dict[str, UsbIdentity | None], bench: Bench) -> None:
    there.clear()
    bench.lose(0, SECOND)
    there["/dev/ttyUSB1"] = LEFT
    assert bench.escs[0].is_at("/dev/ttyUSB1@115200")
    there["/dev/ttyUSB1"] = RIGHT
    assert not bench.escs[0].is_at("/dev/ttyUSB1")


def test_attempts_to_open_do_not_change_since_when_a_port_is_lost(
    there: dict[str, UsbIdentity | None],
    bench: Bench,
) -> None:
    esc = bench.escs[0]
    there.clear()
    bench.lose(0, SECOND)
    for now in (2 * SECOND, 4 * SECOND):
        bench.reopen(now)
        assert esc.facts().lost_since_ns == SECOND
    there[USB0] = LEFT
    bench.reopen(6 * SECOND)
    assert esc.facts().lost_since_ns is None
    bench.lose(0, 7 * SECOND)
    assert esc.facts().lost_since_ns == 7 * SECOND


@pytest.mark.promise("esc-diagnosis")
def test_line_errors_are_counted_by_kind_across_replugging(
    bench: Bench,
) -> None:
    esc = bench.escs[0]
    bench.port().counts = {"parity": 8, "framing": 2, "break": 2, "overrun": 0}
    esc.report(SECOND)
    assert esc.line_errors == {"parity": 3, "framing": 2, "break": 2, "overrun": 0}
    assert bench.gateway.escs[0].line_errors == 5, "a break is a framing error already"
    bench.lose(0, 2 * SECOND)
    bench.reopen(3 * SECOND)
    bench.port().counts = {"parity": 1}
    esc.report(4 * SECOND)
    assert esc.line_errors["parity"] == 3, "a new driver's count starts again"
    bench.port().counts = {"parity": 9}
    esc.report(5 * SECOND)
    assert bench.gateway.escs[0].line_errors == 13


@pytest.mark.promise("esc-diagnosis")
def test_diagnosis_is_logged_once_and_ends_with_telemetry(
    bench: Bench,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "kontronik_can_gw")
    esc = bench.escs[0]
    for n in range(1, 400):
        now = n * 50 * MS
        bench.port().counts = {"parity": 5 + n}
        bench.port().reads = [bytes((0x55, 0x10 + n % 7)) * 20]
        esc.serve(now)
        bench.gateway.advance(now)
        esc.report(now)
    said = [message for message in caplog.messages if "no telemetry" in message]
    assert len(said) == 1
    assert "bytes but never KOD: wrong parity (8E1 is needed)" in said[0]
    assert "parity errors)" in said[0]
    bench.port().reads = [LIVE]
    esc.serve(21 * SECOND)
    esc.log.follow_link(21 * SECOND)
    assert caplog.messages[-1] == "left: telemetry ok (V4)"
    assert esc.log.complaint == ""
    assert esc.facts().diagnosis is None
    for now in range(21 * SECOND, 23 * SECOND, 100 * MS):
        bench.gateway.advance(now)
        esc.report(now)
        if now <= 22200 * MS:
            assert esc.facts().diagnosis is None, "frames arrive, or arrived just before"
    assert (esc.facts().diagnosis or "").startswith("no bytes")
    for n in range(1, 400):
        now = 24 * SECOND + n * 50 * MS
        bench.port().reads = [bytes((0x55, 0x10 + n % 7)) * 20]
        esc.serve(now)
        bench.gateway.advance(now)
        esc.report(now)
    said = [message for message in caplog.messages if "never KOD" in message]
    assert len(said) == 2, "it is said again for another loss"


def test_unplugged_port_is_logged_once_until_it_is_back(
    there: dict[str, UsbIdentity | None],
    bench: Bench,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A change of its settings before the loss is not reported after it."""
    caplog.set_level(logging.INFO, "kontronik_can_gw")
    esc = bench.escs[0]

    def is_unplugged(path: str, _protocol: object) -> Port:
        raise NoPort(f"{path}: no such serial port.")

    esc._noted.is_restored = True
    bench.lose(0, SECOND)
    with monkeypatch.context() as patch:
        patch.setattr(esc_input, "SerialPort", is_unplugged)
        for n in range(20):
            bench.reopen((2 + n) * SECOND)
    bench.reopen(30 * SECOND)
    esc.report(30 * SECOND)
    assert caplog.messages == [
        "left: /dev/ttyUSB0: lost (unplugged). Check plug and power of the adapter. Trying again.",
        "left: /dev/ttyUSB0 is open, after 29.0 s",
    ]


def test_mini_uart_causes_a_warning_when_it_is_opened(
    there: dict[str, UsbIdentity | None],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """It opens, but it has no parity and loses frames."""
    monkeypatch.setattr(esc_input, "is_mini_uart", lambda path: path == "/dev/ttyS0")
    there |= {"/dev/ttyS0": None, USB0: LEFT}
    Bench("/dev/ttyS0", USB0)
    (warning,) = [each for each in caplog.messages if "mini-UART" in each]
    assert warning.startswith("left: /dev/ttyS0 is a Raspberry Pi's mini-UART")
    assert warning.endswith("Use ttyAMA0.")


def test_information_that_names_another_device_again_and_again_is_summarised(
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "kontronik_can_gw")
    world = World()
    (wire,) = world.wires
    loop = loop_in(world, monkeypatch)
    loop.open()
    loop.begin()
    devices = (Device.KOSMIK, Device.JIVEPRO)
    begin = world.now
    for n in range(120):  # a change each 2.5 s, for 5 minutes
        at = begin + n * 2500 * MS
        info = InfoData(device_and_variant=device_and_variant(devices[n % 2], 120))
        for data in (codec.encode(info, codec.WireLayout.V4), LIVE):
            wire.put(data, [at] * len(data))
        for later in range(1, 25):
            wire.put(LIVE, [at + later * 100 * MS] * len(LIVE))
    run(loop, world, begin + 300 * SECOND)
    lines = [text for text in caplog.messages if "telemetry ok" in text]
    assert 3 < len(lines) < 10
    assert "This happens often. The next line appears after a minute without it." in lines[-1]
    caplog.clear()
    run(loop, world, world.now + 62 * SECOND)
    loop.close()
    (line,) = [text for text in caplog.messages if "more times" in text]
    assert line.startswith("esc1: layout or device: happened ")


def test_loss_is_reported_with_its_errors(
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "kontronik_can_gw")
    world = World()
    (wire,) = world.wires
    loop = loop_in(world, monkeypatch)
    loop.open()
    loop.begin()
    damaged = LIVE[:-1] + bytes((LIVE[-1] ^ 1,))

    def put(data: bytes, at: int) -> None:
        wire.put(data, [at] * len(data))

    begin = world.now
    for n in range(100):
        put(LIVE, begin + n * 20 * MS)
        if n % 25 == 0:
            put(damaged, begin + n * 20 * MS + 10 * MS)
    run(loop, world, begin + 3 * SECOND)
    assert loop.gateway.escs[0].counters.crc_errors == 4
    for n in range(3):
        put(damaged, world.now + n * 20 * MS)
    put(LIVE, world.now + SECOND)
    run(loop, world, world.now + 1100 * MS)
    loop.close()
    (back,) = [each for each in caplog.messages if "dropped meanwhile" in each]
    assert "; 3 CRC errors, " in back


@pytest.mark.promise("adapter-identity")
def test_usb_adapter_is_identified_by_its_numbers_or_its_location(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plugged = {
        "/dev/ttyUSB0": (0x403, 0x6001, "A1", "1-1"),
        "/dev/ttyUSB1": (0x403, 0x6011, "A1", "1-2:1.3"),
        "/dev/ttyUSB2": (0x403, 0x6001, None, "1-1.2"),
        "/dev/ttyUSB3": (None, None, None, None),  # being unplugged
    }

    def found(path: str) -> SimpleNamespace:
        names = ("vid", "pid", "serial_number", "location")
        return SimpleNamespace(**dict(zip(names, plugged[path], strict=True)))

    monkeypatch.setattr(usb_adapters, "SysFS", found)
    monkeypatch.setattr(Path, "glob", lambda _, kind: map(Path, plugged) if "USB" in kind else ())
    assert dict(usb_adapters.adapters()) == {
        "/dev/ttyUSB0": UsbIdentity(0x403, 0x6001, "A1", ""),
        "/dev/ttyUSB1": UsbIdentity(0x403, 0x6011, "A1", "1.3"),
        "/dev/ttyUSB2": UsbIdentity(0x403, 0x6001, "", "1-1.2"),
    }


@pytest.mark.promise("line-settings")
def test_settings_changed_by_another_program_are_restored(core_language: str) -> None:
    with PtyEsc() as esc:
        port = serial_port.SerialPort(esc.path, KONTRONIK)

        def hold() -> bool:
            if core_language == "Python":
                return port.settings_hold()
            gateway = Gateway(CoreSettings([EscSettings()], MessageLayout("", "", ())), 0)
            turns = gateway.core.turns()  # type: ignore[attr-defined]
            turns.inputs[0].settings[:] = port.settings
            assert turns.watch([(port.fileno(), select.POLLIN, 0)])
            turns.leave()
            turns.close()
            return not turns.inputs[0].is_restored

        try:
            assert hold()
            changed = termios.tcgetattr(port.fileno())
            changed[3] |= termios.ECHO
            changed[4] = changed[5] = termios.B9600
            termios.tcsetattr(port.fileno(), termios.TCSANOW, changed)
            assert not hold()
            assert hold()
            after = termios.tcgetattr(port.fileno())
            assert not after[3] & termios.ECHO
            assert after[4] == termios.B115200
        finally:
            port.close()


@pytest.mark.promise("line-settings")
@pytest.mark.parametrize("speaks", [True, False])
def test_settings_are_checked_every_100_ms_while_the_esc_sends(
    speaks: bool,
    core_language: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """While another program has echo on, an ESC receives its own bytes.

    Both cores check equally often.
    """
    world = World()
    wire = world.wires[0]
    limit = 125 * MS if speaks else 170 * MS
    loop = loop_in(world, monkeypatch)
    loop.open()
    loop.begin()
    begin = world.now
    if speaks:
        wire.stream(begin, begin + 3 * SECOND, 20 * MS)
    run(loop, world, begin + 1300 * MS)
    changed = world.now
    wire.now_set = bytes(64)
    run(loop, world, begin + 3 * SECOND)
    loop.close()
    assert wire.now_set == wire.settings
    looks = [begin, *wire.looks, world.now]
    assert all(late - early <= limit for early, late in pairwise(looks))
    assert len(looks) <= 35, "and no more often"
    assert next(at for at in wire.looks if at > changed) - changed <= limit
    assert sum("changed the settings of /fake/0" in message for message in caplog.messages) == 1


@pytest.mark.parametrize("hangs_up", [False, True])
def test_unreadable_port_is_lost_in_that_turn_and_others_are_read(
    hangs_up: bool,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Both ports are readable in that iteration."""
    caplog.set_level(logging.INFO, "kontronik_can_gw")
    world = World(2)
    failing, sound = world.wires
    loop = loop_in(world, monkeypatch, (EscSettings("esc1"), EscSettings("esc2")))
    loop.open()
    loop.begin()
    begin = world.now
    for wire in world.wires:
        wire.stream(begin, begin + 3 * SECOND, 20 * MS)
    run(loop, world, begin + 1100 * MS)
    failing.hangs_up = hangs_up
    failing.fails_at = failed = min(at for at in sound.frames if at > world.now)
    run(loop, world, failed + 50 * MS)
    lost = loop.escs[0].facts().lost_since_ns
    assert lost is not None
    assert 0 <= lost - failed <= 2 * MS
    reason = "unplugged" if hangs_up else "Input/output error"
    remedy = "Check plug and power of the adapter. Trying again."
    assert f"esc1: /fake/0: lost ({reason}). {remedy}" in caplog.messages
    assert loop.gateway.escs[0].link is LinkState.PORT_ERROR
    run(loop, world, begin + 4 * SECOND)
    loop.close()
    assert loop.gateway.escs[1].counters.live == len(sound.frames)
    assert loop.escs[0].reopened == 1
    shown_at = [at for at, frame in world.bus.sent if frame.can_id == 0x100]
    assert any(at > failed + SECOND for at in shown_at)


def test_pauses_between_attempts_grow_until_a_port_receives_bytes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """If a port is lost before its first byte, the pause doubles, up to a second."""
    world = World()
    (wire,) = world.wires
    loop = loop_in(world, monkeypatch)
    loop.open()
    loop.begin()
    opened = list[int]()
    open_port = loop.escs[0].open

    def note_and_open(*arguments: Any) -> None:
        opened.append(world.now)
        open_port(*arguments)

    monkeypatch.setattr(loop.escs[0], "open", note_and_open)

    def measure_pause_ms(has_bytes: bool) -> int:
        if has_bytes:
            wire.send(world.now)
        run(loop, world, world.now + 50 * MS)
        opened.clear()
        wire.fails_at = lost = world.now
        run(loop, world, world.now + 1200 * MS)
        (at,) = opened
        return 10 * round((at - lost) / (10 * MS))

    assert [measure_pause_ms(True) for _ in range(3)] == [100] * 3
    assert [measure_pause_ms(False) for _ in range(5)] == [200, 400, 800, 1000, 1000]
    assert [measure_pause_ms(True) for _ in range(2)] == [100] * 2
    loop.close()


@pytest.mark.promise("echo-off", "silent-to-esc")
def test_echo_is_switched_off_before_anything_else(monkeypatch: pytest.MonkeyPatch) -> None:
    """A new terminal echoes. Bytes that arrive before echo is off are sent back to the ESC."""
    real = serial_port._open
    echoes = []
    with PtyEsc() as esc:

        def switch(on: bool) -> None:
            mode = termios.tcgetattr(esc.fileno())
            mode[3] = mode[3] | termios.ECHO if on else mode[3] & ~termios.ECHO
            termios.tcsetattr(esc.fileno(), termios.TCSANOW, mode)

        def opened(path: str, *more: Any) -> Any:
            echoes.append(termios.tcgetattr(esc.fileno())[3] & termios.ECHO)
            assert count_descriptors() > before, "the port is held open: it may echo again else"
            return real(path, *more)

        def count_descriptors() -> int:
            descriptors = Path("/proc/self/fd").glob("*")
            links = [os.readlink(link) for link in descriptors if link.exists()]
            return links.count(esc.path)

        monkeypatch.setattr(serial_port, "_open", opened)
        switch(True)
        before = count_descriptors()
        serial_port.SerialPort(esc.path, KONTRONIK).close()
    assert echoes == [0]


def test_adapter_unplugged_while_it_is_set_up_is_a_plain_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    opened = serial_port._open

    def gone(*arguments: Any) -> Any:
        port = opened(*arguments)
        monkeypatch.setattr(termios, "tcgetattr", fail)
        return port

    def fail(_fd: int) -> None:
        raise termios.error(errno.EIO, "I/O")

    monkeypatch.setattr(serial_port, "_open", gone)
    with PtyEsc() as esc, pytest.raises(RunError, match="cannot be opened"):
        serial_port.SerialPort(esc.path, KONTRONIK)


def test_raspberry_pis_mini_uart_is_recognised_by_its_device_tree(tmp_path: Path) -> None:
    device = tmp_path / "sys/devices/platform/soc/3f215040.serial"
    (device / "of_node").mkdir(parents=True)
    (device / "of_node/compatible").write_bytes(b"brcm,bcm2835-aux-uart\0")
    (tmp_path / "sys/class/tty/ttyS0").mkdir(parents=True)
    (tmp_path / "sys/class/tty/ttyS0/device").symlink_to(device)
    assert is_mini_uart("/dev/ttyS0", tmp_path)
    assert not is_mini_uart("/dev/ttyAMA0", tmp_path)
    (device / "of_node/compatible").write_bytes(b"arm,pl011\0arm,primecell\0")
    assert not is_mini_uart("/dev/ttyS0", tmp_path)
