"""The installed files, checked line by line, and by systemd's own tools if they are installed."""

import ast
import ipaddress
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pytest

import kontronik_can_gw
from kontronik_can_gw.cli.service import planned
from kontronik_can_gw.runtime.can.interface_restart import FOLDER
from kontronik_can_gw.runtime.system.folders import NAME, RUN

pytestmark = pytest.mark.promise("service")

NAMES = ("kontronik-can-gw.service", "kontronik-can-gw@.service")
BESIDE = tuple(
    f"kontronik-can-gw-{kind}{end}.service"
    for kind in ("mqtt", "metrics", "web")
    for end in ("", "@")
)
ENABLE = "no systemd-analyze on this machine: sudo apt-get install systemd"
MAX_EXPOSED = 2.0
RESTART = ("kontronik-can-gw-restart@.path", "kontronik-can-gw-restart@.service")
PROJECT = Path(__file__).resolve().parents[2]


def files() -> dict[str, str]:
    """Return the texts of all files by name. For *.conf it is the name of the folder."""
    found = {}
    for place, text in planned("/bin/true"):
        path = Path(place)
        if path.suffix == ".conf":
            path = path.parent
        found[path.name] = text
    return found


def units(folder: Path, beside: bool = False) -> list[Path]:
    """Write the units of the gateway, or of the services beside it, to a folder. Return the paths.

    The template is written as an instance.
    """
    found = []
    for name in BESIDE if beside else NAMES:
        found.append(folder / name.replace("@", "@left"))
        found[-1].write_text(files()[name])
    return found


def settings(text: str) -> dict[str, list[str]]:
    found: defaultdict[str, list[str]] = defaultdict(list)
    for line in text.splitlines():
        if line and line[0] not in "#[":
            name, _, value = line.partition("=")
            found[name].append(value)
    return found


def analyze(*words: str) -> "subprocess.CompletedProcess[str]":
    if shutil.which("systemd-analyze") is None:
        pytest.skip(ENABLE)
    environment = os.environ | {"SYSTEMD_COLORS": "0", "LC_ALL": "C.UTF-8"}
    command = ["systemd-analyze", *words]
    return subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=60,
        env=environment,
    )


# --- by systemd's tools


@pytest.mark.extended
@pytest.mark.parametrize("beside", [False, True])
def test_systemd_finds_no_fault_in_the_units(tmp_path: Path, beside: bool) -> None:
    for unit in units(tmp_path, beside):
        done = analyze("verify", "--man=no", str(unit))
        lines = (done.stdout + done.stderr).splitlines()
        ours = [line for line in lines if "kontronik" in line or str(tmp_path) in line]
        assert (done.returncode, ours) == (0, []), done.stderr


@pytest.mark.extended
@pytest.mark.parametrize("beside", [False, True])
def test_service_has_a_low_exposure_level(tmp_path: Path, beside: bool) -> None:
    for unit in units(tmp_path, beside):
        done = analyze("security", "--offline=true", "--no-pager", str(unit))
        found = re.search(r"Overall exposure level for \S+: ([\d.]+)", done.stdout)
        assert found, done.stdout + done.stderr
        assert float(found[1]) <= (1.6 if "web" in unit.name else MAX_EXPOSED)


@pytest.mark.extended
def test_restart_of_an_interface_has_a_low_exposure_level(tmp_path: Path) -> None:
    """docs/security.md states the figure."""
    for name in RESTART:
        (tmp_path / name.replace("@", "@can0")).write_text(files()[name])
    service = tmp_path / "kontronik-can-gw-restart@can0.service"
    done = analyze("security", "--offline=true", "--no-pager", str(service))
    assert "Overall exposure level for kontronik-can-gw-restart@can0.service: 1.1" in done.stdout
    assert "1.1" in (PROJECT / "docs/security.md").read_text()
    done = analyze("verify", "--man=no", *map(str, tmp_path.iterdir()))
    lines = (done.stdout + done.stderr).splitlines()
    assert [line for line in lines if "kontronik" in line or str(tmp_path) in line] == []


# --- line by line


def test_restart_takes_the_interface_from_the_instance_and_runs_only_ip() -> None:
    path, service = (settings(files()[name]) for name in RESTART)
    request = str(RUN / NAME / FOLDER / "%i")
    assert {key: path[key] for key in path if key != "Description"} == {
        "PathChanged": [request],
        "WantedBy": ["multi-user.target"],
    }
    assert service["ExecStart"] == ["ip link set dev %i down", "ip link set dev %i up"]
    assert service["CapabilityBoundingSet"] == service["AmbientCapabilities"] == ["CAP_NET_ADMIN"]
    assert service["RestrictAddressFamilies"] == ["AF_NETLINK"]
    assert service["DynamicUser"] == service["NoNewPrivileges"] == ["yes"]
    assert not [name for name in service if name.startswith(("EnvironmentFile", "PassEnv"))]


EVERY = [*NAMES, *BESIDE]


@pytest.mark.parametrize("name", EVERY)
def test_service_never_gives_up_and_has_no_rights_of_root(name: str) -> None:
    """test_under_systemd.py tries the forbidden actions under a real systemd."""
    unit = settings(files()[name])
    kept = {"Restart": "always", "StartLimitIntervalSec": "0", "TimeoutStopSec": "5s"}
    kept |= {"User": "kontronik-can-gw", "Group": "kontronik-can-gw", "NoNewPrivileges": "yes"}
    kept |= {"CapabilityBoundingSet": "", "AmbientCapabilities": ""}
    if "mqtt" not in name:  # mqtt has to reach a broker
        kept["IPAddressDeny"] = "any"
    kept |= {"ProtectHome": "read-only", "WantedBy": "multi-user.target"}
    kept |= {"LimitCORE": "0"}  # a core dump would fill a memory card and delay the restart
    assert {name: unit[name] for name in kept} == {name: [text] for name, text in kept.items()}
    assert unit["RestartSec"] == ["250ms" if name in NAMES else "5s"]
    never = ("ExecStartPre", "RestartPrevent", "ExecCondition", "Condition")
    assert not [name for name in unit if name.startswith(never)]


LOCKING = [name for name in EVERY if "metrics" not in name and "web" not in name]


@pytest.mark.parametrize("name", LOCKING)
def test_service_that_reports_to_systemd_is_watched(name: str) -> None:
    """If it hangs, it is ended so that the log has the stack of each thread."""
    unit = settings(files()[name])
    kept = {"Type": "notify", "WatchdogSec": "10s", "TimeoutStartSec": "90s"}
    kept |= {"Environment": "PYTHONFAULTHANDLER=1"}
    assert {name: unit[name] for name in kept} == {name: [text] for name, text in kept.items()}


@pytest.mark.parametrize("name", LOCKING)
def test_service_may_write_the_locks_that_all_gateways_share(name: str) -> None:
    lock = f"-{RUN / NAME / 'lock'}"
    wanted = f"{lock} -{RUN / NAME / 'restart'}" if name in NAMES else lock
    assert settings(files()[name])["ReadWritePaths"] == [wanted]


@pytest.mark.parametrize("name", [name for name in EVERY if "web" in name])
def test_live_page_may_write_only_its_cache_and_reach_only_private_networks(
    name: str,
) -> None:
    """docs/security.md states the figure."""
    unit = settings(files()[name])
    suffix = "-%i" if "@" in name else ""
    assert unit["CacheDirectory"] == [f"kontronik-can-gw-web{suffix}"]
    assert f"STATE_DIRECTORY=/var/lib/kontronik-can-gw{suffix}" in unit["Environment"]
    assert unit["CacheDirectoryMode"] == ["0700"]
    assert unit["ProtectSystem"] == ["strict"]
    assert not {"ReadWritePaths", "StateDirectory", "RuntimeDirectory"} & set(unit)
    families = set(unit["RestrictAddressFamilies"][0].split())
    assert families == {"AF_CAN", "AF_UNIX", "AF_INET", "AF_INET6"}
    assert "LISTEN=127.0.0.1:8044" in unit["Environment"]
    allowed = unit["IPAddressAllow"][0].split()
    private = [each for each in allowed if "/" in each]
    assert all(ipaddress.ip_network(each).is_private for each in private)
    assert set(allowed) - set(private) == {"localhost", "link-local"}


@pytest.mark.parametrize("name", [*EVERY, RESTART[1]])
def test_service_may_not_write_below_run(name: str) -> None:
    """systemd 252 leaves /run writable for a service that gets a /proc of its own."""
    unit = settings(files()[name])
    assert unit["ProtectSystem"] == ["strict"]
    assert unit["ReadOnlyPaths"] == ["/run"]


@pytest.mark.parametrize("name", NAMES)
def test_statistics_are_readable_by_all_and_the_store_is_private(name: str) -> None:
    """The plain service's folder stays when it ends, because it holds the locks of all."""
    unit = settings(files()[name])
    kept = {"RuntimeDirectoryMode": "0755", "RuntimeDirectoryPreserve": "yes"}
    kept |= {"StateDirectoryMode": "0700"}
    assert {name: unit[name] for name in kept} == {name: [text] for name, text in kept.items()}


def test_service_may_open_serial_ports_and_no_other_device() -> None:
    """test_under_systemd.py tries the effect, and the folder of locks, under a real systemd."""
    unit = settings(files()[NAMES[0]])
    kinds = ("USB", "ACM", "S", "AMA", "SC", "mxc", "THS")
    assert unit["DeviceAllow"] == [f"char-tty{kind} rw" for kind in kinds]
    assert unit["DevicePolicy"] == ["closed"]
    assert "PrivateDevices" not in unit, "it would hide ports that are plugged in later"
    # /proc shows other programs that have a port open, such as a getty that sends to the ESC.
    assert unit["ProtectProc"] == ["default"]
    assert "PrivateUsers" not in unit
    # An adapter may be plugged in while the service runs. Its driver has to be loaded before that.
    drivers = {"modprobe@usbserial.service", "modprobe@cdc_acm.service"}
    for name in ("Wants", "After"):
        assert drivers <= set(unit[name][0].split())


PACKAGE = Path(kontronik_can_gw.__file__).parent
IN_LIBRARIES: dict[str, set[str]] = {
    "run": set(),
    # paho connects to the broker; getaddrinfo asks the kernel for this machine's addresses
    "mqtt": {"AF_INET", "AF_INET6", "AF_NETLINK"},
    "metrics": set(),
    "web": {"AF_INET", "AF_INET6", "AF_UNIX"},  # asyncio and uvicorn
}
"""The address families that libraries need, by command."""


def reachable(command: str) -> set[Path]:
    """Return the modules that a command may import at any time."""
    found: set[Path] = set()
    waiting = {f"kontronik_can_gw.cli.{command}"}
    while waiting:
        place = PACKAGE.parent.joinpath(*waiting.pop().split("."))
        file = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
        if file in found or not file.exists():
            continue
        found.add(file)
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                waiting |= {each.name for each in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                waiting |= {f"{node.module}.{each.name}" for each in node.names} | {node.module}
    return {file for file in found if file.is_relative_to(PACKAGE)}


def named_families(files: set[Path]) -> set[str]:
    """Return the address families that modules name, such as socket.AF_CAN."""
    found = set()
    for file in files:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and node.attr.startswith("AF_"):
                found.add(node.attr)
    return found


def allowed_families(unit: str) -> set[str]:
    """Return the address families that a unit permits."""
    lines = settings(unit)["RestrictAddressFamilies"]
    return set(" ".join(lines).split())


@pytest.mark.parametrize("name", EVERY)
def test_unit_permits_the_socket_families_that_its_command_opens(name: str) -> None:
    unit = files()[name]
    (line,) = settings(unit)["ExecStart"]
    command = line.partition("/bin/true ")[2].split()[0]
    modules = reachable(command)
    if command == "metrics":
        # The modules that it shares with other commands open no socket there.
        modules = {PACKAGE / "desk" / "metrics.py"}
    named = named_families(modules)
    if command == "web":
        # Without rtnetlink its advice on a missing interface has no bit rate.
        named.remove("AF_NETLINK")
    assert allowed_families(unit) == named | IN_LIBRARIES[command]


def test_signal_usr1_does_not_end_the_gateway_while_the_interpreter_starts() -> None:
    """The shell of the unit starts a program with the signal ignored, and with all its words."""
    (line,) = settings(files()[NAMES[0]])["ExecStart"]
    words = shlex.split(line.replace("$$", "$").replace("/bin/true", sys.executable))
    at = words.index(sys.executable)
    code = "import os, signal, sys; os.kill(os.getpid(), signal.SIGUSR1); print(sys.argv[1:])"
    program = [*words[: at + 1], "-c", code, *words[at + 1 :]]
    done = subprocess.run(program, capture_output=True, text=True, check=True)
    assert done.stdout == f"{words[at + 1 :]}\n"


def test_gateway_may_use_only_can_rtnetlink_and_the_notify_socket() -> None:
    assert allowed_families(files()[NAMES[0]]) == {"AF_CAN", "AF_NETLINK", "AF_UNIX"}


def test_instance_has_its_own_configuration_and_folders() -> None:
    plain, own = (settings(files()[name]) for name in NAMES)
    changed = {name for name in plain if plain[name] != own[name]}
    assert changed == {"ExecStart", "StateDirectory", "RuntimeDirectory"}
    assert own["ExecStart"][0].endswith(" -c /etc/kontronik-can-gw/%i.toml")
    assert own["StateDirectory"] == own["RuntimeDirectory"] == ["kontronik-can-gw-%i"]


def test_metrics_are_only_served_to_this_machine() -> None:
    for name, config in zip(BESIDE[2:4], ("gateway", "%i"), strict=True):
        unit = settings(files()[name])
        command = f"/bin/true metrics -c /etc/kontronik-can-gw/{config}.toml --listen ${{LISTEN}}"
        assert unit["ExecStart"] == [command]
        assert unit["Environment"] == ["LISTEN=127.0.0.1:9123"]
        assert unit["IPAddressDeny"] == ["any"]
        assert unit["IPAddressAllow"] == ["localhost"]


def test_udev_rules_keep_modem_manager_away(tmp_path: Path) -> None:
    """udev also checks the rules if it can (udevadm verify, systemd 254)."""
    text = files()["70-kontronik-can-gw.rules"]
    ignored = [line for line in text.splitlines() if 'ENV{ID_MM_DEVICE_IGNORE}="1"' in line]
    assert [line.split(",")[0] for line in ignored] == ['SUBSYSTEM=="usb"', 'SUBSYSTEM=="tty"']
    assert all("0403" in line for line in ignored)
    udevadm = shutil.which("udevadm", path=os.environ.get("PATH", "") + ":/usr/sbin:/sbin:/bin")
    rules = tmp_path / "70-kontronik-can-gw.rules"
    rules.write_text(text)
    if udevadm is None:
        return
    shown = subprocess.run([udevadm, "-h"], capture_output=True, text=True)
    if "verify" in shown.stdout:
        subprocess.run([udevadm, "verify", str(rules)], check=True, capture_output=True)
