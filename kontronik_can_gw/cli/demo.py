"""``demo``: runs the whole gateway without hardware, vcan or privileges.

A simulated ESC on a pseudo terminal, the real serial path, packer and CANopen node, python-can's in-process bus, and a screen with what a
logger with the DBC and a small CANopen master see. All values on the screen come from the bus.
"""

import argparse
import contextlib
import logging
import os
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from kontronik_can_gw.canopen import cob_ids, nmt
from kontronik_can_gw.canopen.nmt import NmtState
from kontronik_can_gw.cli.arguments import number_from
from kontronik_can_gw.cli.common import stopping_on_signals
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.kontronik.states import OperatingError
from kontronik_can_gw.lean import without_asammdf

if TYPE_CHECKING:
    import can
    from cantools.database.can import Database
    from rich.console import Group

_REFRESH_S = 0.125
_PLAIN_LINE_S = 1.0
_SHOWN = (
    (
        ("ElectricalSpeed", "0"),
        ("MotorSpeed", "0"),
        ("BatteryVoltage", "2"),
        ("BatteryCurrent", "1"),
        ("MotorCurrent", "1"),
        ("PeakCurrent", "1"),
        ("BatteryPower", "0"),
        ("ThrottlePercent", "0"),
        ("OutputOpeningPercent", "0"),
        ("ConsumedCharge", "0"),
    ),
    (
        ("PowerStageTemperature", "0"),
        ("BecTemperature", "0"),
        ("BecVoltage", "2"),
        ("BecCurrent", "2"),
        ("MeanCellVoltage", "2"),
        ("EnergyUsed", "1"),
        ("FrameRate", "0"),
        ("DataAge", "0"),
        ("CrcErrors", "0"),
        ("DroppedBytes", "0"),
    ),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--seconds",
        type=number_from(0.001, 1e6),
        metavar="N",
        help="end after N seconds (default: Ctrl-C)",
    )
    parser.add_argument(
        "--seed", type=int, default=1, metavar="N", help="seed of the simulated faults (default 1)"
    )
    parser.epilog = (
        "A simulated ESC on a pseudo terminal, the real gateway, python-can's in-process bus, "
        "and on the screen what a logger with the DBC and a CANopen master see. "
        "Exit code: 0 at its end, 1 something in it failed, 2 wrong usage."
    )


@dataclass
class Logger:
    """A bus participant that knows only the DBC."""

    database: "Database"
    values: dict[str, object] = field(default_factory=dict)
    frames: int = 0

    def __post_init__(self) -> None:
        self._messages = {message.frame_id: message for message in self.database.messages}
        self.units = {
            signal.name: signal.unit or "" for m in self.database.messages for signal in m.signals
        }
        self.flags = [
            s.name
            for m in self.database.messages
            for s in m.signals
            if s.length == 1 and not s.choices
        ]

    def take(self, message: "can.Message") -> None:
        """Decode a frame."""
        self.frames += 1
        if (known := self._messages.get(message.arbitration_id)) is not None:
            self.values.update(known.decode_simple(bytes(message.data)))

    def text(self, name: str, digits: str = "0") -> str:
        """A formatted value; a dash where it is not available."""
        value = self.values.get(name)
        if isinstance(value, (int, float)):
            return f"{value:,.{digits}f}".replace(",", " ")
        return "-" if value is None or str(value) == "NotAvailable" else str(value)

    def active(self) -> list[str]:
        """Flags that are set, while flags are valid."""
        if self.text("OperatingState") == "-":
            return []
        return [
            name
            for name in self.flags
            if self.values.get(name) == 1 and name != "ProgrammingAllowed"
        ]


@dataclass
class Master:
    """A minimal CANopen master: starts the node, reads one object a second, counts the node's messages."""

    bus: "can.BusABC"
    node_id: int = 1
    state: str = "-"
    cell_voltage: str = "-"
    emergency: str = "none yet"
    counts: dict[int, int] = field(default_factory=dict)
    _next_poll: float = 0.0

    def take(self, message: "can.Message", seconds: float) -> None:
        """Process a frame and react as a master."""
        data, node_id = bytes(message.data), self.node_id
        match message.arbitration_id - node_id:
            case cob_ids.HEARTBEAT:
                self.state = NmtState(data[0]).name.replace("_", "-")
                if data[0] in (NmtState.INITIALISING, NmtState.PRE_OPERATIONAL):
                    self._send(cob_ids.NMT, bytes((nmt.Command.START, node_id)))
            case 0x080:
                code, bit = int.from_bytes(data[:2], "little"), data[3]
                what = next((error.text for error in OperatingError if error == bit), "gateway")
                self.emergency = f"{code:04X}h {what}" if code else "0000h no error any more"
            case cob_ids.SDO_ANSWER:
                known = data[0] == 0x4B
                self.cell_voltage = (
                    f"{int.from_bytes(data[4:6], 'little') / 1000:.3f} V"
                    if known
                    else "not available"
                )
            case base if base & 0x7F == 0 and 0x180 <= base <= 0x500:
                number = (base >> 8) & 7
                self.counts[number] = self.counts.get(number, 0) + 1
        if seconds >= self._next_poll:
            self._next_poll = seconds + 1
            self._send(cob_ids.SDO_REQUEST + node_id, bytes.fromhex("40 01 20 05 00 00 00 00"))

    def line(self) -> str:
        """One line with everything that the master knows."""
        pdos = (
            " ".join(f"TPDO{number} {count}" for number, count in sorted(self.counts.items()))
            or "no PDO yet"
        )
        # no-break space: a narrow terminal breaks the line before SDO, not after it
        return f"node {self.node_id} {self.state}  {pdos}  SDO\N{NO-BREAK SPACE}2001h:5 {self.cell_voltage}  EMCY {self.emergency}"

    def _send(self, cob_id: int, data: bytes) -> None:
        import can

        self.bus.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))


def main(args: argparse.Namespace) -> int:
    with without_asammdf():
        import can

    from kontronik_can_gw.config.assemble import assemble
    from kontronik_can_gw.config.parse import parse
    from kontronik_can_gw.desk.pty import PtyEsc
    from kontronik_can_gw.gateway import Gateway
    from kontronik_can_gw.runtime.loop import Loop

    # the screen shows what the log would
    logging.getLogger("kontronik_can_gw").addHandler(logging.NullHandler())
    channel = f"demo-{os.getpid()}"
    stop = threading.Event()
    failures: list[BaseException] = []
    with contextlib.ExitStack() as stack:
        esc = stack.enter_context(PtyEsc())
        store = stack.enter_context(tempfile.TemporaryDirectory())
        tables = {
            "can": {"interface": "virtual", "channel": channel},
            "canopen": {"enabled": True, "store": store},
            "esc": [{"port": esc.path, "pole_pairs": 7, "gear": 9.8}],
        }
        config = parse(tables, "demo")
        loaded = assemble(config)
        assert loaded.database is not None
        logger = Logger(loaded.database)
        gateway = Gateway(loaded.escs, loaded.layout, time.monotonic_ns(), canopen=loaded.canopen)
        loop = Loop(gateway, [esc.path], config.can)
        bus = stack.enter_context(can.Bus(interface="virtual", channel=channel))
        master = Master(bus)
        loop.open()

        def running(work: object) -> threading.Thread:
            def guarded() -> None:
                try:
                    work()  # type: ignore[operator]
                except BaseException as error:  # shown by the main thread
                    failures.append(error)
                    stop.set()

            thread = threading.Thread(target=guarded, daemon=True)
            thread.start()
            return thread

        threads = [running(loop.run), running(lambda: _feed(esc, args.seed, stop))]
        with stopping_on_signals(stop.set):
            _show(logger, master, bus, args.seconds, stop)
        stop.set()
        loop.stop()
        for thread in threads:
            thread.join(2)
        if failures:
            raise RunError(f"the demonstration failed: {failures[0]!r}")
        if esc.received:
            raise RunError(
                f"the gateway sent {esc.received} bytes to the ESC; it must never send any"
            )
    print(
        f"kontronik-can-gw: {logger.frames} CAN frames decoded, 0 bytes sent to the ESC",
        file=sys.stderr,
    )
    return 0


def _feed(esc: object, seed: int, stop: threading.Event) -> None:
    from kontronik_can_gw.desk import pty
    from kontronik_can_gw.esc.simulator import (
        FLIGHT,
        SECOND_NS,
        Dropout,
        ErrorWindow,
        EscOptions,
        Faults,
        SimulatedEsc,
    )

    thrown_in = (
        OperatingError.POWER_STAGE_OVERTEMP_WARNING,
        OperatingError.BEC_OVERCURRENT,
        OperatingError.UNDERVOLTAGE,
        OperatingError.LIMIT_DISCHARGED_CAPACITY,
    )
    windows = [
        ErrorWindow(thrown_in[n % len(thrown_in)], (6 + 13 * n) * SECOND_NS, 3 * SECOND_NS)
        for n in range(1000)
    ]
    faults = Faults(
        noise=0.02,
        flipped_bits=1e-5,
        dropout=Dropout(SECOND_NS, 17 * SECOND_NS),
        errors=tuple(windows),
    )
    profile = tuple(phase._replace(duration_s=max(1.5, phase.duration_s * 0.4)) for phase in FLIGHT)
    simulated = SimulatedEsc(EscOptions(profile=profile, faults=faults), seed=seed)
    pty.run([(simulated, esc)], stop=stop.is_set)  # type: ignore[list-item]


def _show(
    logger: Logger, master: Master, bus: "can.BusABC", seconds: float | None, stop: threading.Event
) -> None:
    from rich.console import Console

    console = Console(highlight=False)
    begin = time.monotonic()
    end = None if seconds is None else begin + seconds

    def listen(pause: float) -> Iterator[None]:
        """Decode incoming frames; yield each ``pause`` seconds until the end."""
        next_time = begin + pause
        while not stop.is_set():
            now = time.monotonic()
            if end is not None and now >= end:
                return
            until = min(next_time, end) if end is not None else next_time
            message = bus.recv(max(0.0, min(until - now, 0.1)))
            if message is not None:
                logger.take(message)
                master.take(message, now)
            if time.monotonic() >= next_time:
                next_time += pause
                yield

    if console.is_terminal:
        from rich.live import Live

        with Live(console=console, auto_refresh=False, transient=False) as live:
            for _ in listen(_REFRESH_S):
                live.update(_screen(logger, master, time.monotonic() - begin), refresh=True)
    else:
        for _ in listen(_PLAIN_LINE_S):
            print(_plain_line(logger, master, time.monotonic() - begin), flush=True)


def _plain_line(logger: Logger, master: Master, seconds: float) -> str:
    words = [f"{seconds:6.1f} s  link {logger.text('LinkState'):9}"]
    for name, digits in (
        ("ElectricalSpeed", "0"),
        ("BatteryVoltage", "2"),
        ("BatteryCurrent", "1"),
        ("PowerStageTemperature", "0"),
    ):
        words.append(f"{name} {logger.text(name, digits)} {logger.units.get(name, '')}".rstrip())
    words.append(f"state {logger.text('OperatingState')}")
    active = logger.active()
    words.append(f"CANopen {master.line()}")
    return "  ".join(words) + (f"  FAULTS {', '.join(active)}" if active else "")


def _screen(logger: Logger, master: Master, seconds: float) -> "Group":
    from rich.console import Group
    from rich.panel import Panel
    from rich.table import Table
    from rich.text import Text

    link = logger.text("LinkState")
    head = Text.assemble(
        "link ",
        (link, "bold green" if link == "Ok" else "bold red"),
        f"   state {logger.text('OperatingState')}   device {logger.text('Device')} "
        f"firmware {logger.text('FirmwareMain')}.{logger.text('FirmwareSub')} layout {logger.text('Layout')}",
    )
    body = Table.grid(padding=(0, 2), expand=True)
    for _ in range(2):
        body.add_column(width=21, no_wrap=True)
        body.add_column(ratio=2, justify="right", no_wrap=True)
        body.add_column(ratio=2, style="dim", no_wrap=True)
    for left, right in zip(*_SHOWN, strict=True):
        cells: list[str | Text] = []
        for name, digits in (left, right):
            value = logger.text(name, digits)
            cells += [
                name,
                Text(value, "dim" if value == "-" else "bold"),
                logger.units.get(name, ""),
            ]
        body.add_row(*cells)
    active = logger.active()
    faults = Text(
        "faults: " + (", ".join(active) if active else "none"), "bold red" if active else "green"
    )
    foot = Text(
        f"{seconds:.0f} s, {logger.frames} CAN frames on the bus, uptime {logger.text('Uptime')} s. Ctrl-C ends.",
        "dim",
    )
    title = "demo: simulated ESC -> UART -> gateway -> CAN -> logger, CANopen master"
    canopen = Text(f"CANopen: {master.line()}", "cyan")
    return Group(
        Panel(Group(head, "", body, "", faults, "", canopen), title=title, title_align="left"), foot
    )
