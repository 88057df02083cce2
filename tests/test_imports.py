"""A running gateway imports only the listed libraries.

The real ``run`` command runs with a replacement for its CAN interface. Its modules are listed
after it has sent values. A gateway on a small board pays for each library in time and memory, and
libraries import others: python-can imports asammdf if it is installed. The gateway imports
cantools without python-can. A program that then uses more of cantools still finds all of it.
"""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from kontronik_can_gw.desk.pty import PtyEsc
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import LiveData

pytestmark = pytest.mark.promise("light")

LIVE = encode(LiveData(electrical_speed=12_345, battery_voltage=2442), WireLayout.V4)
STANDIN = Path(__file__).resolve().parent / "benchmarks"

CANTOOLS = {"cantools", "argparse_addons", "bitstruct", "textparser", "crccheck", "diskcache"}
ALWAYS = {"kontronik_can_gw", "serial"}
"""Libraries that every gateway may import."""
OWN = {"cli": {"run", "common", "arguments", "recording"}, "desk": set[str]()}
"""Modules of the package's large folders that may be imported. Other folders are unrestricted."""
NEVER = {"tkinter", "curses", "multiprocessing", "unittest", "pydoc", "doctest", "asyncio", "ssl"}
NEVER |= {"sqlite3", "email"}
"""Modules of the standard library that a gateway does not import."""
NODES = '[canopen]\nenabled = true\nself_start = true\nnode_id = 1\nstore = "store"\n'
CANOPEN = {"kontronik_can_gw.canopen", "kontronik_can_gw.runtime.files.store"}
RECORDER = {
    f"kontronik_can_gw.{name}"
    for name in ("assembly.capture_setup", "capture.recorded_gateway", "runtime.files.recorder")
}
CONFIGURATIONS = {
    "DBC": ("", CANTOOLS, set[str]()),
    "CANopen only": (f"[dbc]\nenabled = false\n{NODES}", set[str](), CANOPEN),
    "DBC and CANopen": (NODES, CANTOOLS, CANOPEN),
    "recorder": ('[record]\ndirectory = "captures"\n', CANTOOLS, RECORDER),
    "status": ('[statistics]\nfile = "status.json"\n', CANTOOLS, set[str]()),
}
"""Tables of the configuration, the libraries that they need, and their optional own modules.

An optional module is one that is imported only with some of the tables.
"""

AT_THE_END = """
import atexit, sys
sys.path.append({standin!r})
{extra}
from standin import use
use("{bus}")
sys.path.pop()

from kontronik_can_gw.runtime.system import locks
locks.PREFIX += "{bus}/"  # tests may run side by side, all on "lo"

def write():
    with open({file!r}, "w") as file:
        names = sorted(name for name, module in sys.modules.items() if module is not None)
        file.write("\\n".join(names))

atexit.register(write)
"""


def imported(folder: Path, tables: str, extra: str = "") -> set[str]:
    """Return the modules of a gateway with these tables after it has sent values of an ESC.

    The code ``extra`` runs in its process at the start.
    """
    bus = f"kontronik-test-{os.getpid()}-{time.monotonic_ns()}"
    names = folder / "names"
    (folder / "sitecustomize.py").write_text(
        AT_THE_END.format(standin=str(STANDIN), extra=extra, bus=bus, file=str(names))
    )
    with PtyEsc() as esc, socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind("\0" + bus)
        listener.listen(1)
        listener.settimeout(60)
        config = folder / "gateway.toml"
        can = '[can]\ninterface = "socketcan"\nchannel = "lo"\n'
        config.write_text(f'{can}{tables}[[esc]]\nport = "{esc.path}"\n')
        process = subprocess.Popen(
            [sys.executable, "-m", "kontronik_can_gw", "run", "-c", str(config)],
            env=os.environ | {"PYTHONPATH": str(folder)},
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            peer, _ = listener.accept()
            with peer:
                peer.settimeout(0.1)
                _until_values(peer, esc)
            process.send_signal(signal.SIGTERM)
            _, said = process.communicate(timeout=60)
        finally:
            process.kill()
            process.communicate()
    assert process.returncode == 0, said
    return set(names.read_text().splitlines())


def _until_values(peer: socket.socket, esc: PtyEsc) -> None:
    """Send frames of the ESC until its voltage, 24.42 V, is on the bus in a message or a PDO."""
    until = time.monotonic() + 60
    while time.monotonic() < until:
        esc.write(LIVE)
        try:
            packet = peer.recv(128)
        except TimeoutError:
            continue
        if (2442).to_bytes(2, "little") in packet[8:]:
            return
    raise AssertionError("no values came")


def surplus(modules: set[str], allowed: set[str]) -> set[str]:
    """Return the modules that are neither in the standard library nor allowed."""
    libraries = {name.partition(".")[0] for name in modules}
    found = {
        name
        for name in libraries - allowed
        if name not in sys.stdlib_module_names and not name.startswith("_")
    }
    for folder, may in OWN.items():
        in_folder = {name for name in modules if name.startswith(f"kontronik_can_gw.{folder}.")}
        found |= {name for name in in_folder if name.split(".")[2] not in may}
    return found - {"sitecustomize", "standin", "distutils-precedence"}


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_running_gateway_imports_only_the_listed_modules(name: str, tmp_path: Path) -> None:
    tables, further, own = CONFIGURATIONS[name]
    modules = imported(tmp_path, tables)
    assert "kontronik_can_gw.runtime.loop" in modules
    assert surplus(modules, ALWAYS | further) == set()
    assert modules & NEVER == set()
    assert modules & (CANOPEN | RECORDER) == own


def test_module_that_is_not_listed_is_found(tmp_path: Path) -> None:
    """The test imports a library and a module of ours that a gateway does not need."""
    modules = imported(
        tmp_path,
        "",
        "import rich.console, kontronik_can_gw.desk.recordings.layouts",
    )
    found = surplus(modules, ALWAYS | CANTOOLS)
    assert {"rich", "kontronik_can_gw.desk.recordings.layouts"} <= found


LEAN = "import sys; from kontronik_can_gw.light_imports import without_asammdf\n"
DATABASE = f"{LEAN}with without_asammdf(): import cantools.database\n"
AFTERWARDS = f"""{LEAN}with without_asammdf(): import can
print('asammdf' in sys.modules); import asammdf
"""
WHOLE = f"""{DATABASE}
import cantools
before = cantools.database
from cantools import Error, database
print('can' in sys.modules, hasattr(cantools, 'nothing_of_this_name'), Error.__name__)
print(cantools.tester.Tester.__name__, before is cantools.database, 'can' in sys.modules)
"""


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (WHOLE, "True False Error\nTester True True"),
        (f"import cantools; before = cantools\n{DATABASE}print(before is cantools)", "True"),
        (AFTERWARDS, "False"),
    ],
    ids=[
        "cantools is complete when more of it is imported",
        "a cantools that was imported before is kept",
        "asammdf can be imported afterwards",
    ],
)
def test_libraries_are_imported_without_others_and_remain_complete(code: str, said: str) -> None:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, said), done.stderr
