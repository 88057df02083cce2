"""How long the gateway takes from its start to the first CAN frame, and the memory it takes: the whole command, as its own process."""

import contextlib
import os
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from bench_programs import STANDIN, config_text, end, median, running, start
from registry import ROOT, Benchmark, Context, Figure, NotEqual

from kontronik_can_gw.dbc_output.layout import load_database
from kontronik_can_gw.lean import without_asammdf
from kontronik_can_gw.offline.pty import PtyEsc
from kontronik_can_gw.protocol.codec import Layout, encode
from kontronik_can_gw.protocol.fields import LiveData

SHIPPED = ROOT / "dbc" / "kontronik_esc.dbc"
LIVE = LiveData(electrical_speed=12_345, battery_voltage=2442)
CANOPEN = '[canopen]\nenabled = true\nnode_id = 1\nstore = "{folder}/store"\n'
RECORDER = '[record]\ndirectory = "{folder}/captures"\n'
PROMETHEUS = '[statistics]\nfile = "{folder}/status.json"\nprometheus = "127.0.0.1:{port}"\n'
_PATIENCE_S = 20.0
_EXTENDED = 0x80000000


# --- start


class Bus:
    """The other end of the bus: the first frames, with their time."""

    def __init__(self, channel: str = "") -> None:
        self._listener: socket.socket | None = None
        if channel:
            self.name = f"can:{channel}"
            self._socket: socket.socket | None = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
            self._socket.bind((channel,))
            self._socket.settimeout(_PATIENCE_S)
        else:
            self._socket = None
            self.name = f"unix:kontronik-bench-{uuid.uuid4().hex[:12]}"
            self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            self._listener.bind("\0" + self.name.partition(":")[2])
            self._listener.listen(1)
            self._listener.settimeout(_PATIENCE_S)

    def frame(self) -> tuple[int, bytes]:
        """The next frame: id as SocketCAN has it, and data."""
        if self._socket is None:
            assert self._listener is not None
            self._socket, _ = self._listener.accept()
            self._socket.settimeout(_PATIENCE_S)
        packet = self._socket.recv(128)
        return int.from_bytes(packet[:4], sys.byteorder), packet[8 : 8 + packet[4]]

    def close(self) -> None:
        for each in (self._socket, self._listener):
            if each is not None:
                each.close()


@contextlib.contextmanager
def sending(escs: int) -> Iterator[list[str]]:
    """ESCs that send live frames at 100 Hz, one like the other; their ports."""
    terminals = [PtyEsc() for _ in range(escs)]
    stop = threading.Event()
    wire = encode(LIVE, Layout.V4)

    def send() -> None:
        while not stop.wait(0.01):
            for terminal in terminals:
                terminal.write(wire)

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    try:
        yield [terminal.path for terminal in terminals]
    finally:
        stop.set()
        thread.join()
        for terminal in terminals:
            terminal.close()


@dataclass
class Started:
    """What one start took, in milliseconds from the start of the process. ``cpu_ms`` until the first values."""

    first_ms: float
    values_ms: float
    cpu_ms: float


def start_once(context: Context, ports: list[str], config: str, python: tuple[str, ...] = ()) -> tuple[Started, str]:
    """Start the gateway, wait for its first frame and for the first with values of an ESC, end it. Also what it said."""
    with tempfile.TemporaryDirectory(prefix="kontronik-bench-") as name, contextlib.closing(Bus(context.vcan)) as bus:
        folder = Path(name)
        file = folder / "gateway.toml"
        text = config_text(ports, context.vcan or "lo", SHIPPED, folder, config.format(folder=folder))
        file.write_text(text.replace("[dbc]", "bitrate = 1000000\n[dbc]", 1))
        errors = (folder / "errors").open("w+")
        command = [sys.executable, *python, str(STANDIN), bus.name, "ours", "run", "-c", str(file)]
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
        with errors:
            begun = time.perf_counter()
            process = start(command, stdin=subprocess.DEVNULL, stderr=errors, env=environment)
            try:
                frame = bus.frame()
                first = time.perf_counter() - begun
                while not (voltage := _voltage(*frame)):
                    frame = bus.frame()
                values = time.perf_counter() - begun
                fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
            except (TimeoutError, FileNotFoundError):
                raise RuntimeError(f"no frame came; the gateway said: {(folder / 'errors').read_text()}") from None
            finally:
                end(process)
            if abs(voltage - LIVE.battery_voltage / 100) > 1e-6:
                raise NotEqual(
                    f"start: the first voltage on the bus is {voltage}, the ESC sends {LIVE.battery_voltage / 100}"
                )
            cpu = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
            return Started(first * 1e3, values * 1e3, cpu * 1e3), (folder / "errors").read_text()


_database = None


def _voltage(can_id: int, data: bytes) -> float | None:
    """The battery voltage by cantools, if this is the first ESC's frame with it and has one."""
    global _database
    if _database is None:
        _database = load_database(SHIPPED)
    message = next(message for message in _database.messages if "BatteryVoltage" in message.signal_tree)
    if can_id != message.frame_id:
        return None
    decoded = message.decode(data)
    assert isinstance(decoded, dict)
    value = decoded["BatteryVoltage"]
    return float(value) if isinstance(value, (int, float)) else None


def imports(said: str, least_ms: float = 3.0) -> list[tuple[str, float]]:
    """By -X importtime: modules with what they import in turn, the dearest first."""
    lines = re.findall(r"^import time:\s*\d+ \|\s*(\d+) \| +(\S+)$", said, re.MULTILINE)
    found = [(name, int(us) / 1000) for us, name in lines if int(us) >= 1000 * least_ms]
    return sorted(found, key=lambda each: -each[1])


def start_up(context: Context) -> list[Figure]:
    """From exec to the first CAN frame."""
    figures = []
    rounds = 1 if context.quick else 2 * context.rounds + 1
    cases = [("1 ESC", 1, ""), ("8 ESCs", 8, ""), ("1 ESC, CANopen", 1, CANOPEN), ("8 ESCs, CANopen", 8, CANOPEN)]
    with sending(1) as one, sending(8) as eight:
        ports = {1: one, 8: eight}
        start_once(context, one, CANOPEN)  # what is compiled at the first run is there from now on
        found: dict[str, list[Started]] = {name: [] for name, _, _ in cases}
        for _ in range(rounds):  # by turns
            for name, escs, config in cases:
                found[name].append(start_once(context, ports[escs], config)[0])
        _, said = start_once(context, one, "", ("-X", "importtime"))
    for name, _, _ in cases:
        first = median([each.first_ms for each in found[name]])
        values = median([each.values_ms for each in found[name]])
        cpu = median([each.cpu_ms for each in found[name]])
        context.say(f"{name}: first frame after {first:.0f} ms, values after {values:.0f} ms, CPU {cpu:.0f} ms")
        target = "<= 500" if name == "1 ESC" else ""
        note = f"first values after {values:.0f} ms; CPU {cpu:.0f} ms"
        figures.append(Figure(f"first CAN frame, {name}", first, "ms", target, first <= 500 if target else None, note))
    context.data["starts"] = {name: [asdict(each) for each in runs] for name, runs in found.items()}
    context.data["imports_ms"] = imports(said)[:40]
    top = ", ".join(f"{name} {ms:.0f}" for name, ms in context.data["imports_ms"][:8])
    context.say(f"imports, each with what it imports (ms, slowed by the look at them): {top}")
    return figures


# --- memory


@dataclass
class Memory:
    """Of a process, in MB. ``unique``: what no other process shares; ``shared fairly`` is PSS."""

    resident: float
    proportional: float
    unique: float


def memory_of(pid: int) -> Memory:
    """Of a process now."""
    text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    kb = {key: int(value) for key, value in re.findall(r"^(\w+):\s+(\d+) kB$", text, re.MULTILINE)}
    return Memory(kb["Rss"] / 1024, kb["Pss"] / 1024, (kb["Private_Clean"] + kb["Private_Dirty"]) / 1024)


def many_escs_dbc(folder: Path) -> Path:
    """The shipped DBC with 29-bit ids, so that there is room for 64 ESCs, and sent so seldom that the bus would bear it."""
    with without_asammdf():
        text = SHIPPED.read_text()
    ids = "|".join(sorted(set(re.findall(r"^BO_ (\d+)", text, re.MULTILINE))))
    text = re.sub(rf"\b({ids})\b", lambda found: str(int(found[1]) | _EXTENDED), text)
    text = re.sub(r'(BA_ "GenMsgDelayTime" BO_ \d+) \d+', r"\1 500", text)
    text = re.sub(r'(BA_ "GenMsgCycleTime" BO_ \d+) [1-9]\d*', r"\1 1000", text)
    file = folder / "many_escs.dbc"
    file.write_text(text)
    return file


def free_port() -> int:
    """A TCP port that nobody has at the moment."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def memory(context: Context) -> list[Figure]:
    """After some seconds of traffic."""
    cases = [
        *((f"{escs} ESC", escs, "") for escs in (1, 2, 8, 64)),
        *((f"{escs} ESC, CANopen", escs, CANOPEN) for escs in (1, 8)),
        ("1 ESC, recorder", 1, RECORDER),
        ("1 ESC, Prometheus", 1, PROMETHEUS),
        ("1 ESC, all", 1, CANOPEN + RECORDER + PROMETHEUS),
    ]
    found: dict[str, Memory] = {}
    seconds = 0.5 if context.quick else 3.0
    with tempfile.TemporaryDirectory(prefix="kontronik-bench-") as name:
        dbc = many_escs_dbc(Path(name))
        for number, (case, escs, config) in enumerate(cases):
            own = Path(name) / str(number)
            own.mkdir()
            text = config.format(folder=own, port=free_port())
            with running(context, "ours", escs, seconds=seconds, dbc=dbc, config=text) as (feeder, gateway):
                measured = feeder.measure(gateway)
                found[case] = memory_of(gateway.pid)
            now = found[case]
            context.say(
                f"{case}: RSS {now.resident:.1f} MB, PSS {now.proportional:.1f}, USS {now.unique:.1f} after {measured.sent} live frames"
            )
    context.data["memory_mb"] = {case: asdict(each) for case, each in found.items()}
    context.data["seconds"] = seconds
    figures = []
    for case, now in found.items():
        target = "<= 40" if case == "1 ESC" else ""
        note = f"PSS {now.proportional:.1f}, USS {now.unique:.1f}"
        figures.append(Figure(f"RSS, {case}", now.resident, "MB", target, now.resident <= 40 if target else None, note))
    for first, last, further, target in (
        ("1 ESC", "8 ESC", 7, ""),
        ("1 ESC", "64 ESC", 63, "<= 0.3"),
        ("1 ESC, CANopen", "8 ESC, CANopen", 7, ""),
    ):
        each = (found[last].resident - found[first].resident) / further
        name = f"each further ESC up to {last.replace(' ESC', '')}"
        figures.append(Figure(name, each, "MB", target, each <= 0.3 if target else None, "RSS"))
    return figures


BENCHMARKS = [
    Benchmark("start", "from the start of the command to its first CAN frame: 1 and 8 ESCs, CANopen", start_up),
    Benchmark("memory", "RSS, PSS and USS with 1 to 64 ESCs, CANopen, recorder, Prometheus", memory),
]
