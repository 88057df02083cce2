"""The bench: a gateway process, candump, simulated ESCs, and the comparison of what was sent with what was recorded."""

import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Self, cast

import canopen
import cantools.database
from cantools.database.can import Database

from kontronik_can_gw.config import shipped
from kontronik_can_gw.offline import pty
from kontronik_can_gw.protocol.fields import InfoData, LiveData, rows
from kontronik_can_gw.protocol.states import OperatingState
from kontronik_can_gw.simulator import EscOptions, Phase, Sent, SimulatedEsc

SNA = "NotAvailable"


def ip(*words: str) -> None:
    """``ip`` with these words."""
    subprocess.run(["ip", *words], check=True)


def wait_for(condition: Callable[[], bool], seconds: float, what: str) -> float:
    """Wait until something holds; the seconds it took. AssertionError when it does not come."""
    begin = time.monotonic()
    while not condition():
        if time.monotonic() - begin > seconds:
            raise AssertionError(f"{what}: not within {seconds} s")
        time.sleep(0.005)
    return time.monotonic() - begin


class GatewayProcess:
    """``kontronik-can-gw run`` as its own process."""

    def __init__(self, config: Path, *options: str) -> None:
        command = [sys.executable, "-m", "kontronik_can_gw", "run", "-c", str(config), *options]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr
        for line in self.process.stderr:
            self.lines.append(line.rstrip())

    @property
    def log(self) -> str:
        return "\n".join(self.lines)

    def wait_for_line(self, text: str, seconds: float = 20) -> float:
        """Wait until a log line holds ``text``."""

        def seen() -> bool:
            if self.process.poll() is not None:
                self._reader.join(2)
                assert text in self.log, f"the gateway ended with {self.process.returncode}:\n{self.log}"
            return text in self.log

        return wait_for(seen, seconds, f"log line {text!r} in:\n{self.log}")

    def end(self, signal_number: int = 15, seconds: float = 5) -> int:
        """Send a signal and wait for the exit code."""
        self.process.send_signal(signal_number)
        code = self.process.wait(seconds)
        self._reader.join(2)
        return code

    def kill(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._reader.join(2)
        for stream in (self.process.stdout, self.process.stderr):
            if stream:
                stream.close()


class Recorded(NamedTuple):
    """A line of candump."""

    time: float
    can_id: int
    data: bytes


class Candump:
    """``candump -L`` of an interface."""

    def __init__(self, interface: str) -> None:
        command = ["candump", "-D", "-L", "-r", "4194304", f"{interface},0:0,#FFFFFFFF"]
        self.frames: list[Recorded] = []
        self._process = subprocess.Popen(["stdbuf", "-oL", *command], stdout=subprocess.PIPE, text=True)
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self._process.stdout
        for line in self._process.stdout:
            found = re.match(r"\((\d+\.\d+)\) \S+ ([0-9A-F]+)#(#\d)?([0-9A-F]*)", line)
            assert found, line
            self.frames.append(Recorded(float(found[1]), int(found[2], 16), bytes.fromhex(found[4])))

    def of(self, can_id: int) -> list[Recorded]:
        return [frame for frame in list(self.frames) if frame.can_id == can_id]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        time.sleep(0.1)  # what the kernel still holds for it
        self._process.terminate()
        self._process.wait()
        self._thread.join(5)
        if self._process.stdout:
            self._process.stdout.close()


class Bench:
    """Simulated ESCs on ptys, sending in real time in a thread, with a record of what was sent when."""

    def __init__(self, escs: Sequence[EscOptions], seed: int = 1) -> None:
        self.ports = [pty.PtyEsc() for _ in escs]
        self.sent: list[list[tuple[float, Sent]]] = [[] for _ in escs]
        self._options = escs
        self._seed = seed
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        self._stop.clear()
        simulated = [SimulatedEsc(options, seed=self._seed + i) for i, options in enumerate(self._options)]
        pairs = list(zip(simulated, self.ports, strict=True))

        def note(index: int, sent: Sent, taken: bool) -> None:
            assert taken
            self.sent[index].append((time.time(), sent))

        self._thread = threading.Thread(
            target=lambda: pty.run(pairs, stop=self._stop.is_set, on_sent=note), daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        if self._thread:
            self._thread.join(5)

    def live(self, index: int) -> list[tuple[float, LiveData]]:
        return [(when, sent.data) for when, sent in self.sent[index] if isinstance(sent.data, LiveData)]

    def info(self, index: int) -> list[tuple[float, InfoData]]:
        return [(when, sent.data) for when, sent in self.sent[index] if isinstance(sent.data, InfoData)]

    def close(self) -> None:
        self.stop()
        for port in self.ports:
            port.check()
            port.close()


@contextmanager
def bench(*escs: EscOptions) -> Iterator[Bench]:
    """A bench that also checks, at its end, that nothing was ever transmitted to an ESC."""
    made = Bench(escs)
    try:
        yield made
    finally:
        made.close()
    assert [port.received for port in made.ports] == [0] * len(escs), "something was transmitted to an ESC"


def configuration(interface: str, ports: Sequence[str], dbc: str = "", esc: str = "") -> str:
    """A configuration text for these ports."""
    parts = [f'[can]\ninterface = "socketcan"\nchannel = "{interface}"\nbitrate = 1000000\n{dbc}\n']
    parts += [f'[[esc]]\nport = "{port}"\npole_pairs = 7\ngear = 9.8\n{esc}\n' for port in ports]
    return "\n".join(parts)


def database_of(config: Path) -> Database:
    """What ``kontronik-can-gw dbc -c`` writes for a configuration, loaded strictly: the logger's view."""
    command = [sys.executable, "-m", "kontronik_can_gw", "dbc", "-c", str(config)]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    loaded = cantools.database.load_string(text, "dbc", strict=True)
    assert isinstance(loaded, Database)
    return loaded


def snake(signal_name: str, prefix: str) -> str:
    """``Esc1BatteryVoltage`` -> ``battery_voltage``."""
    text = signal_name.removeprefix(prefix).removesuffix("Percent")
    return re.sub(r"(?<!^)(?=[A-Z])", "_", text).lower()


def expected(data: LiveData | InfoData) -> dict[str, Any]:
    """Field name to physical value as a logger should see it."""
    values: dict[str, Any] = {n: row.physical(getattr(data, n)) for n, row in rows(type(data)).items()}
    if isinstance(data, LiveData):
        values["operating_state_raw"] = data.operating_state
        for bit in range(24):
            values[f"bit{bit}"] = data.operating_errors >> bit & 1
    else:
        values |= {"device": data.device, "device_raw": data.device, "variant": data.variant}
        values |= {"firmware_main": data.firmware_word >> 8, "firmware_sub": data.firmware_word & 255}
    return values


def agrees(decoded: dict[str, Any], data: LiveData | InfoData, prefix: str) -> bool:
    """True if every signal that is a field of the frame has exactly its value."""
    wanted = expected(data)
    found = {snake(name, prefix): value for name, value in decoded.items()}
    common = [name for name in found if name in wanted]
    return all(abs(found[name] - wanted[name]) < 1e-6 for name in common)


# --- CANopen

EDS = shipped("eds/kontronik_esc.eds")
SERIAL = 0x00100200
"""Of the first node. Few ones: each costs a fastscan a time-out."""
LIVELY = (Phase("up", 0.5, 90, OperatingState.Forward, 0.5), Phase("down", 0.5, 30, OperatingState.Forward, 0.5))
"""A flight in which no two frames are alike."""


def canopen_configuration(
    interface: str, ports: Sequence[str], store: Path, node_id: int = 1, canopen: str = "", dbc: str = "", esc: str = ""
) -> str:
    """A configuration text with CANopen nodes from ``node_id`` on; the DBC output is on too unless ``dbc`` says otherwise."""
    table = f'[canopen]\nenabled = true\nnode_id = {node_id}\nserial = {SERIAL}\nstore = "{store}"\n{canopen}'
    return configuration(interface, ports, f"{dbc}\n{table}", esc)


@contextmanager
def gateway_process(file: Path, toml: str) -> Iterator[GatewayProcess]:
    """A gateway that has opened everything, with this configuration text, killed at the end if it still runs."""
    file.write_text(toml)
    process = GatewayProcess(file)
    try:
        process.wait_for_line(f"esc{toml.count('[[esc]]')}: /dev/pts")
        yield process
    finally:
        process.kill()


class Master:
    """The canopen library as the master of a bus: its network and remote nodes made from the shipped EDS."""

    def __init__(self, interface: str) -> None:
        self.network = canopen.Network()
        self.network.connect(interface="socketcan", channel=interface)
        self._objects = canopen.import_od(str(EDS))

    def node(self, node_id: int) -> canopen.RemoteNode:
        """The node with this ID, from now on or since an earlier call."""
        if node_id in self.network:
            return cast(canopen.RemoteNode, self.network[node_id])
        node = canopen.RemoteNode(node_id, self._objects)
        node.sdo.RESPONSE_TIMEOUT = 2  # a slow machine is not what is tested
        self.network.add_node(node)
        return node

    def upload(self, node_id: int, index: int, sub: int = 0) -> bytes:
        return bytes(self.node(node_id).sdo.upload(index, sub))

    def number(self, node_id: int, index: int, sub: int = 0) -> int:
        """A whole number by SDO, without sign."""
        return int.from_bytes(self.upload(node_id, index, sub), "little")

    def write(self, node_id: int, index: int, sub: int, value: int, size: int) -> None:
        self.node(node_id).sdo.download(index, sub, value.to_bytes(size, "little"))

    def refusal(self, act: Callable[[], object]) -> int:
        """The code of the abort that an act ends with."""
        try:
            act()
        except canopen.SdoAbortedError as error:
            return int(error.code)
        raise AssertionError("it was not refused")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.network.disconnect()


@contextmanager
def nodes_running(
    interface: str, folder: Path, *escs: EscOptions, options: str = "", dbc: str = "", esc: str = "", node_id: int = 1
) -> Iterator[tuple[Bench, Candump, GatewayProcess, Master]]:
    """Simulated ESCs (not started yet), their gateway with CANopen nodes, a recording of the bus, and a master."""
    with bench(*escs) as run, Candump(interface) as dump, Master(interface) as master:
        toml = canopen_configuration(
            interface, [port.path for port in run.ports], folder / "store", node_id, options, dbc, esc
        )
        with gateway_process(folder / "gateway.toml", toml) as gateway:
            if node_id < 128:
                wait_for(lambda: bool(dump.of(0x700 + node_id)), 5, "a boot-up")
            yield run, dump, gateway, master
