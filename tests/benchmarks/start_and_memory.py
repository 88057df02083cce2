"""How long the gateway takes from its start to the first CAN frame, and the memory it takes: the whole command, as its own process."""

import contextlib
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
import uuid
from dataclasses import replace
from pathlib import Path

from programs import CANOPEN, EVERYTHING, STANDIN, config_text, end, median, running, start
from registry import ROOT, Context, Figure, benchmark

from kontronik_can_gw.desk.pty import PtyEsc
from kontronik_can_gw.lean import without_asammdf

SHIPPED = ROOT / "dbc" / "kontronik_esc.dbc"
_PATIENCE_S = 20.0
_EXTENDED = 0x80000000


def first_frame_ms(escs: int, config: str) -> float:
    """Start the gateway on a bus of its own, wait for its first frame, end it."""
    name = f"kontronik-bench-{uuid.uuid4().hex[:12]}"
    with (
        tempfile.TemporaryDirectory(prefix="kontronik-bench-") as made,
        socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener,
        contextlib.ExitStack() as opened,
    ):
        ports = [opened.enter_context(PtyEsc()).path for _ in range(escs)]
        folder = Path(made)
        listener.bind("\0" + name)
        listener.listen(1)
        listener.settimeout(_PATIENCE_S)
        file = folder / "gateway.toml"
        file.write_text(config_text(ports, SHIPPED, folder, config))
        command = [sys.executable, str(STANDIN), name, "ours", "run", "-c", str(file)]
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
        log = opened.enter_context((folder / "errors").open("w+"))
        begun = time.perf_counter()
        process = start(command, stdin=subprocess.DEVNULL, stderr=log, env=environment)
        opened.callback(end, process)
        try:
            bus = opened.enter_context(listener.accept()[0])
            bus.settimeout(_PATIENCE_S)
            bus.recv(128)
        except TimeoutError:
            said = (folder / "errors").read_text()
            raise RuntimeError(f"no frame came; the gateway said: {said}") from None
        return (time.perf_counter() - begun) * 1e3


@benchmark("start", "from exec to the first CAN frame: 1 and 8 ESCs, CANopen")
def start_up(context: Context) -> list[Figure]:
    """From exec to the first CAN frame, by turns."""
    cases = {"1 ESC": (1, ""), "8 ESCs": (8, "")}
    cases |= {"1 ESC, CANopen": (1, CANOPEN), "8 ESCs, CANopen": (8, CANOPEN)}
    first_frame_ms(1, CANOPEN)  # what is compiled at the first run is there from now on
    found: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(2 * context.rounds - 1):
        for name, (escs, config) in cases.items():
            found[name].append(first_frame_ms(escs, config))
    return [
        Figure(f"first CAN frame, {name}", median(times), "ms", "<= 250" if name == "1 ESC" else "")
        for name, times in found.items()
    ]


def rss_mb(pid: int) -> float:
    """Of a process now."""
    found = re.search(r"^VmRSS:\s+(\d+) kB$", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
    assert found
    return int(found[1]) / 1024


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


@benchmark("memory", "RSS with 1 to 64 ESCs, CANopen, recorder")
def memory(context: Context) -> list[Figure]:
    """After some seconds of traffic."""
    cases = {
        "1 ESC": (1, "", "<= 24"),
        "64 ESCs": (64, "", ""),
        "1 ESC, CANopen": (1, CANOPEN, ""),
        "8 ESCs, CANopen": (8, CANOPEN, ""),
        "1 ESC, CANopen, recorder": (1, EVERYTHING, ""),
    }
    short = replace(context, seconds=min(context.seconds, 3.0))
    rss: dict[str, float] = {}
    with tempfile.TemporaryDirectory(prefix="kontronik-bench-") as made:
        dbc = many_escs_dbc(Path(made))
        for case, (escs, config, _) in cases.items():
            with running(short, "ours", escs, dbc=dbc, config=config) as (feeder, gateway):
                feeder.measure(gateway)
                rss[case] = rss_mb(gateway.pid)
            context.say(f"{case}: RSS {rss[case]:.1f} MB")
    further = (rss["64 ESCs"] - rss["1 ESC"]) / 63
    nodes = (rss["8 ESCs, CANopen"] - rss["1 ESC, CANopen"]) / 7
    return [
        *(Figure(f"RSS, {case}", rss[case], "MB", aim) for case, (_, _, aim) in cases.items()),
        Figure("RSS, each further ESC", further, "MB", "<= 0.05"),
        Figure("RSS, each further ESC, CANopen", nodes, "MB"),
    ]
