"""Installs, disturbs and removes the service. systemd runs this in a VM (boot_systemd.sh).

inside_systemd.py FOLDER        writes its observations to FOLDER/facts.json
inside_systemd.py --probe       prints the abilities of a process in the service's sandbox as JSON
"""

import contextlib
import json
import mmap
import os
import shutil
import socket
import stat
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[1] / "deb"))

from on_board import LIMIT_S, fresh

PROGRAM = str(Path(sys.prefix, "bin", "kontronik-can-gw"))
CONFIGURATION = Path("/etc/kontronik-can-gw/gateway.toml")
UNIT = "kontronik-can-gw.service"
WEB = "kontronik-can-gw-web.service"
RESTART = "kontronik-can-gw-restart@vcan0"
WEB_CACHE = "/var/cache/kontronik-can-gw-web"
LINK = "/run/esc"
LOCKS = "/run/kontronik-can-gw/lock"
FORBIDDEN = "/dev/not_a_serial_port"
Facts = dict[str, Any]


def run(*words: str) -> dict[str, Any]:
    done = subprocess.run(
        words,
        capture_output=True,
        text=True,
        check=False,
        timeout=LIMIT_S,
    )
    return {"code": done.returncode, "out": done.stdout, "talk": done.stderr}


def service(*words: str) -> dict[str, Any]:
    return run(PROGRAM, "service", *words)


def shown(unit: str = UNIT) -> dict[str, str]:
    names = "ActiveState,SubState,MainPID,NRestarts,StatusText,UnitFileState,Result,Type"
    lines = run("systemctl", "show", "-p", names, unit)["out"].splitlines()
    return dict(line.partition("=")[::2] for line in lines)


def until(condition: Callable[[], bool]) -> float:
    """Wait until a condition is true. Return the time in s, or -1 if it stays false."""
    start = time.monotonic()
    while time.monotonic() - start < LIMIT_S:
        if condition():
            return time.monotonic() - start
        # The machine has one processor. Checking all the time would delay the condition.
        time.sleep(0.2)
    return -1.0


def write_configuration(file: Path, channel: str, port: str, can: str = "") -> None:
    file.write_text(f'[can]\nchannel = "{channel}"\n{can}[[esc]]\nport = "{port}"\n')


def entries() -> list[dict[str, Any]]:
    lines = run("journalctl", "-u", UNIT, "-o", "json", "--no-pager")["out"].splitlines()
    return [json.loads(line) for line in lines]


def fetched() -> str:
    """Return the metrics as Prometheus gets them, or "" without an answer."""
    run("ip", "link", "set", "lo", "up")
    found: list[str] = []

    def ask() -> bool:
        with (
            contextlib.suppress(OSError),
            urllib.request.urlopen("http://127.0.0.1:9123/metrics", timeout=5) as answer,
        ):
            found.append(answer.read().decode())
        return bool(found)

    until(ask)
    return "".join(found)


def main(folder: Path) -> None:
    facts: Facts = {}
    try:
        trial(facts)
    finally:
        (folder / "facts.json").write_text(json.dumps(facts, indent=1))


def trial(facts: Facts) -> None:
    for name in ("vcan0", "vcan1"):
        for words in (("add", name, "type", "vcan"), ("set", name, "up")):
            facts[f"link {name} {words[0]}"] = run("ip", "link", *words)
    facts["install"] = service("install")
    facts["after install"] = shown()

    silent: Any = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    simulator = subprocess.Popen([PROGRAM, "simulate", "--link", LINK], **silent)
    until(Path(LINK).exists)
    shutil.chown(LINK, "root", "dialout")
    Path(LINK).chmod(0o660)
    write_configuration(CONFIGURATION, "vcan0", LINK)
    facts["install now"] = service("install", "--now")
    facts["fresh"] = fresh()
    until(lambda: "telemetry ok" in shown()["StatusText"])  # reported once a second
    facts["running"] = shown()
    facts["clock"] = clock_states()
    pid = facts["running"]["MainPID"]
    facts["process"] = Path(f"/proc/{pid}/status").read_text()
    facts["nice"] = os.getpriority(os.PRIO_PROCESS, int(pid))
    facts["oom"] = Path(f"/proc/{pid}/oom_score_adj").read_text().strip()
    facts["folders"] = {
        path: [oct(Path(path).stat().st_mode & 0o777), Path(path).owner()]
        for path in ("/run/kontronik-can-gw", LOCKS, "/var/lib/kontronik-can-gw")
        if Path(path).exists()
    }

    facts["web"] = live_page()
    facts["restart"] = interface_restart()
    pid = shown()["MainPID"]

    def is_another() -> bool:
        return shown()["MainPID"] not in ("0", pid) and shown()["ActiveState"] == "active"

    os.kill(int(pid), 9)
    facts["running again after kill"] = until(is_another)
    facts["fresh after kill"] = fresh()
    facts["killed"] = shown()

    pid = facts["killed"]["MainPID"]
    os.kill(int(pid), 19)  # SIGSTOP stops all its threads
    facts["running again after freeze"] = until(is_another)
    facts["frozen"] = shown()
    pid = facts["frozen"]["MainPID"]
    until(lambda: "telemetry ok" in shown()["StatusText"])

    good = CONFIGURATION.read_text()
    CONFIGURATION.write_text(good + "nonsense = 1\n")
    facts["install with faulty configuration"] = service("install", "--now")
    CONFIGURATION.write_text(good)
    facts["same process"] = shown()["MainPID"] == pid

    write_configuration(CONFIGURATION.with_name("left.toml"), "vcan1", "/dev/ttyUSB7")
    facts["install left"] = service("install", "--instance", "left", "--now")
    facts["both"] = [shown(), shown("kontronik-can-gw@left.service")]
    simulator.terminate()
    facts["end of left"] = run("systemctl", "disable", "--now", "kontronik-can-gw@left.service")
    facts["left"] = shown("kontronik-can-gw@left.service")

    # All users may open this device, except the service.
    os.mknod(FORBIDDEN, 0o666 | stat.S_IFCHR, os.makedev(1, 11))
    os.chmod(FORBIDDEN, 0o666)
    facts["probe"] = probed("kontronik-can-gw@probe.service")
    facts["probe of web"] = probed("kontronik-can-gw-web@probe.service")
    metrics = run("systemctl", "enable", "--now", "kontronik-can-gw-metrics.service")
    facts["metrics"] = metrics, fetched(), probed("kontronik-can-gw@probe.service")
    facts["log"] = [[entry.get("PRIORITY"), entry.get("MESSAGE")] for entry in entries()]

    facts["uninstall"] = service("uninstall")
    facts["after uninstall"] = [shown(), left_over(), shown(WEB)]
    facts["install again"] = service("install", "--now")
    facts["running in the end"] = shown()
    facts["locks"] = sorted(path.name.partition(".")[2] for path in Path(LOCKS).iterdir())
    run("systemctl", "stop", UNIT)
    facts["locks after a stop"] = [path.name for path in Path(LOCKS).iterdir()]
    facts["end"] = service("uninstall")


def live_page() -> Facts:
    """Serve the page to the network, with the flights of a gateway that records."""
    run("ip", "link", "set", "lo", "up")
    write_configuration(CONFIGURATION, "vcan0", LINK, '[record]\ndirectory = "state"\n')
    found: Facts = {"install": service("install", "--now"), "before": shown(WEB)}
    until(lambda: "telemetry ok" in shown()["StatusText"])
    own = Path(f"/run/systemd/system/{WEB}.d/own.conf")
    own.parent.mkdir()
    own.write_text("[Service]\nEnvironment=LISTEN=0.0.0.0:8044\n")
    run("systemctl", "daemon-reload")
    found["start"] = run("systemctl", "enable", "--now", WEB)
    found["answered"] = until(lambda: answer("/")[0] > 0)
    found["page"] = shown(WEB)
    found["process"] = run("cat", f"/proc/{found['page']['MainPID']}/status")["out"]
    found["exposure"] = run("systemd-analyze", "security", "--no-pager", WEB)["out"]
    found["address"] = run(PROGRAM, "web", "--address")
    token = found["address"]["out"].partition("?token=")[2].partition("\n")[0]
    found["without token"] = answer("/")
    found["foreign name"] = answer("/", Host="evil.example")
    found["with token"], _, cookie = answer(f"/?token={token}")
    page: dict[str, str] = {"Cookie": cookie.partition(";")[0], "X-Kontronik-Page": "1"}

    def flight() -> Facts:
        _, body, _ = answer("/flights.json", **page)
        flights = json.loads(body)["flights"] if body.startswith("{") else []
        return dict(flights[-1]) if flights else {}

    run("systemctl", "stop", UNIT)  # a capture that is being written has no numbers yet
    until(lambda: bool(flight().get("summary")))
    found["flight"] = flight()
    answer(f"/make/{found['flight'].get('id')}/report", **page)
    until(lambda: is_made(flight()))
    found["report"] = answer(f"/flights/{found['flight'].get('id')}/report", **page)[0]
    found["folders"] = {
        path: [oct(Path(path).stat().st_mode & 0o777), Path(path).owner()]
        for path in (WEB_CACHE, f"{WEB_CACHE}/address.json")
    }
    found["log"] = run("journalctl", "-u", WEB, "-o", "cat", "--no-pager")["out"]
    return found


def is_made(flight: Facts) -> bool:
    """Return True if the report of a flight is made or has failed."""
    state = flight["states"]["report"] if flight else {}
    return state == "made" or isinstance(state, dict)


def answer(path: str, **headers: str) -> tuple[int, str, str]:
    """Return status, text and cookie of the page's answer. The status is 0 without an answer."""
    request = urllib.request.Request(f"http://127.0.0.1:8044{path}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=20) as done:
            return done.status, done.read().decode(), done.headers.get("Set-Cookie", "")
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode(), ""
    except OSError:
        return 0, "", ""


def interface_restart() -> Facts:
    """Let no frame leave the interface until the restart unit has restarted it.

    A traffic shaper holds the frames: after the first ten, it lets one pass in 16 s.
    """
    write_configuration(CONFIGURATION, "vcan0", LINK, "restart_after_s = 0.5\n")
    found: Facts = {"install": service("install", "--now")}
    until(lambda: "telemetry ok" in shown()["StatusText"])
    found["path"] = shown(f"{RESTART}.path")
    shaper = ("dev", "vcan0", "root")
    words = ("tbf", "rate", "8bit", "burst", "160", "limit", "1600")
    found["shaper"] = run("tc", "qdisc", "add", *shaper, *words)

    def is_logged(text: str) -> bool:
        return any(text in str(entry.get("MESSAGE")) for entry in entries())

    found["restarted"] = until(lambda: is_logged("no frame left it, so it is restarted"))
    run("tc", "qdisc", "del", *shaper)
    found["works again"] = until(lambda: is_logged("works again after"))
    found["service"] = shown(f"{RESTART}.service")
    found["interface"] = run("ip", "link", "show", "dev", "vcan0")["out"]
    found["gateway"] = shown()
    return found


def clock_states() -> list[Any]:
    """Return the clock's state in the status: at first, after synchronising it, after a step."""
    file = Path("/run/kontronik-can-gw/status.json")

    def state() -> Any:
        return json.loads(file.read_text())["clock"]

    found = [state()]
    synchronise()
    until(lambda: state()["synchronized"])
    found.append(state())
    time.clock_settime(time.CLOCK_REALTIME, time.time() + 3600)
    until(lambda: state()["steps"])
    found.append(state())
    return found


def synchronise() -> None:
    """Tell the kernel that the clock is synchronised, as a time service does."""
    import ctypes

    numbers = (ctypes.c_long * 64)()
    numbers[0] = 0x0004 | 0x0010  # ADJ_MAXERROR, ADJ_STATUS
    numbers[3] = 1000  # maxerror in µs; the status, with STA_UNSYNC, is 0
    if ctypes.CDLL(None, use_errno=True).adjtimex(numbers) < 0:
        raise OSError(ctypes.get_errno(), "adjtimex")


def left_over() -> list[str]:
    found = [*Path("/etc").rglob("*kontronik*"), *Path("/var/lib").glob("kontronik*")]
    return sorted(str(path) for path in found)


def probed(unit: str) -> Facts:
    """Run the probe as an instance of a template unit, in its sandbox. Return its result."""
    folder = Path(f"/run/systemd/system/{unit}.d")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "probe.conf").write_text(
        "[Service]\nType=oneshot\nRestart=no\nWatchdogSec=0\nExecStart=\n"
        f"ExecStart={sys.executable} -B {__file__} --probe\n"
        "StandardOutput=truncate:/run/probe.json\n"
    )
    run("systemctl", "daemon-reload")
    done = run("systemctl", "start", unit)
    try:
        found: Facts = json.loads(Path("/run/probe.json").read_text())
    except ValueError:
        return done
    return found


def probe() -> None:
    """Try actions that must work or must fail in the sandbox, and print the results."""
    tries: dict[str, Callable[[], object]] = {
        "CAN socket": lambda: socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW),
        "netlink": lambda: socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, 0),
        "abstract socket": lambda: socket.socket(socket.AF_UNIX).bind("\0kontronik-can-gw/probe"),
        "state folder": lambda: Path(os.environ["STATE_DIRECTORY"], "x").write_text("x"),
        "runtime folder": lambda: Path(os.environ["RUNTIME_DIRECTORY"], "x").write_text("x"),
        "cache folder": lambda: Path(os.environ["CACHE_DIRECTORY"], "x").write_text("x"),
        "run folder": lambda: Path("/run/lock/x").write_text("x"),
        "lock folder": lambda: Path(LOCKS, "x").write_text("x"),
        "other processes": lambda: Path("/proc/1/stat").read_text(),
        "machine-id": lambda: Path("/etc/machine-id").read_text(),
        "ctypes": lambda: __import__("ctypes").CFUNCTYPE(None)(print),
        "terminal": lambda: os.open("/dev/ptmx", os.O_RDWR),
        "internet": lambda: socket.socket(socket.AF_INET, socket.SOCK_STREAM),
        "packet": lambda: socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0),
        "write /etc": lambda: Path("/etc/kontronik-can-gw/x").write_text("x"),
        "write and execute": lambda: mmap.mmap(-1, 4096, prot=mmap.PROT_WRITE | mmap.PROT_EXEC),
        "another device": lambda: os.open(FORBIDDEN, os.O_RDONLY),
        "set kernel": lambda: Path("/proc/sys/kernel/panic").write_text("1"),
        "namespace": unshared,
        "priority": lambda: os.setpriority(os.PRIO_PROCESS, 0, 5),
        "another user": lambda: os.setuid(0),
        "clock state": clock_error,
        "set clock": lambda: time.clock_settime(time.CLOCK_REALTIME, time.time()),
        "adjust clock": synchronise,
    }
    found = {}
    for name, attempt in tries.items():
        try:
            attempt()
            found[name] = "works"
        except Exception as error:
            found[name] = f"{type(error).__name__}: {error}"
    print(json.dumps(found))


def clock_error() -> None:
    """Read the largest error of the clock. OSError if the sandbox forbids it."""
    from kontronik_can_gw.runtime.system.clock import max_error_us

    if max_error_us() is None:
        raise OSError("adjtimex is refused")


def unshared() -> None:
    """Call unshare(2) for a user name space, which Python 3.11 does not support."""
    import ctypes

    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(0x10000000) != 0:
        raise OSError(ctypes.get_errno(), "unshare")


if __name__ == "__main__":
    if sys.argv[1:] == ["--probe"]:
        with contextlib.suppress(BrokenPipeError):
            probe()
    else:
        main(Path(sys.argv[1]))
