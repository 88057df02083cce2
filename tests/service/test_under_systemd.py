"""The installed service under a real systemd, in a virtual machine.

It starts, is confined, is restarted and is removed completely. One run of inside_systemd.py gathers
the facts in a minute or two, and the tests check them.
"""

import json
import os
import re
import shutil
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from kontronik_can_gw.native.objects import shared_object

pytestmark = [
    pytest.mark.promise("service"),
    pytest.mark.extended,
    pytest.mark.usefixtures("c_compiler"),
]

HERE = Path(__file__).resolve().parent
PROJECT = HERE.parents[1]
INSTALLED = Path(sys.prefix, "bin", "kontronik-can-gw")
TIMEOUT_S = 1200
Facts = dict[str, Any]


def obstacle() -> str | None:
    """Return why these tests cannot run here, with the remedy, or None."""
    search = os.environ.get("PATH", os.defpath) + ":/usr/sbin:/sbin"
    if not all(shutil.which(each, path=search) for each in ("linux.uml", "cc")):
        packages = "user-mode-linux can-utils iproute2 busybox-static gcc libc6-dev"
        return f"no User Mode Linux: sudo apt-get install {packages}"
    if not Path("/lib/systemd/systemd").exists() or shutil.which("systemd-sysusers") is None:
        return "no systemd on this machine: sudo apt-get install systemd"
    if not INSTALLED.exists():
        return f"{INSTALLED} is missing: python -m pip install -e '.[test]'"
    if str(PROJECT).startswith(("/tmp/", "/var/tmp/")):
        return "the checkout is below /tmp, which a service does not see: move it"
    return None


def hidden_folders() -> list[str]:
    """Return the folders that the service's unprivileged user needs but cannot reach."""
    found: list[str] = []
    needed = [str(Path(name).resolve()) for name in (sys.base_prefix, sys.prefix, str(PROJECT))]
    for folder in dict.fromkeys(needed):
        closed = [part for part in Path(folder).parents if not part.stat().st_mode & stat.S_IXOTH]
        if closed and not any(folder.startswith(f"{other}/") for other in found):
            found.append(folder)
    return found


@pytest.fixture(scope="module")
def facts(tmp_path_factory: pytest.TempPathFactory) -> Facts:
    if reason := obstacle():
        pytest.skip(reason)
    folder = tmp_path_factory.mktemp("systemd")
    folder.chmod(0o755)
    command = [sys.executable, "-B", f"{PROJECT}/tests/vm/vm_run.py", "--backend", "uml"]
    command += [f"--timeout={TIMEOUT_S}", f"--rw={folder}", "--", "sh", f"{HERE}/boot_systemd.sh"]
    command += [sys.executable, f"{HERE}/inside_systemd.py", str(folder), *hidden_folders()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S + 60)
    file = folder / "facts.json"
    said = folder / "said"
    talk = done.stdout + done.stderr
    if said.exists():
        talk += said.read_text()
    assert file.exists(), talk
    found: Facts = json.loads(file.read_text())
    assert "end" in found, talk
    return found


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        # an example that was not edited is not started
        ("after install", {"ActiveState": "inactive", "UnitFileState": "disabled"}),
        ("running", {"ActiveState": "active", "UnitFileState": "enabled"}),
        ("killed", {"NRestarts": "1"}),
        ("frozen", {"NRestarts": "2"}),
        # several instances at the same time
        ("both 0", {"ActiveState": "active"}),
        ("both 1", {"ActiveState": "active"}),
        ("left", {"ActiveState": "inactive", "UnitFileState": "disabled"}),
        ("after uninstall 0", {"ActiveState": "inactive"}),
        ("running in the end", {"ActiveState": "active"}),
    ],
)
def test_systemd_shows_the_expected_state(facts: Facts, place: str, expected: Facts) -> None:
    name, _, number = place.rpartition(" ")
    shown = facts[name][int(number)] if number.isdigit() else facts[place]
    assert {key: shown[key] for key in expected} == expected


@pytest.mark.parametrize(
    ("action", "code", "said"),
    [
        (
            "install",
            0,
            "gateway.toml: is the unchanged example. Set ports, bit rate and motors first.",
        ),
        ("install now", 0, "is enabled. See: systemctl status kontronik-can-gw.service\n"),
        ("install left", 0, "kontronik-can-gw@left.service is enabled."),
        ("install with faulty configuration", 1, "gateway.toml: esc[1].nonsense: unknown key."),
        ("uninstall", 0, "kept: /etc/kontronik-can-gw"),
        ("end", 0, ""),
    ],
)
def test_action_reports_its_result(facts: Facts, action: str, code: int, said: str) -> None:
    done = facts[action]
    assert (done["code"], said in done["talk"]) == (code, True), done
    assert facts["same process"], "the process from before the faulty configuration"


def test_service_runs_as_its_own_user_without_any_right(facts: Facts) -> None:
    process = dict(line.split(":\t", 1) for line in facts["process"].splitlines() if ":\t" in line)
    assert "0" not in process["Uid"].split() + process["Gid"].split()
    assert len(process["Groups"].split()) == 3  # its own group and the groups of serial ports
    assert {process[f"Cap{kind}"] for kind in ("Inh", "Prm", "Eff", "Bnd", "Amb")} == {"0" * 16}
    assert process["NoNewPrivs"] == "1"
    assert process["Seccomp"] == "2"
    assert facts["nice"] == -10
    assert facts["oom"] == "-500"


def test_telemetry_of_a_port_of_its_groups_reaches_the_bus(facts: Facts) -> None:
    assert facts["fresh"]
    assert "telemetry ok" in facts["running"]["StatusText"]


def test_folders_of_the_service_have_its_owner_and_mode(facts: Facts) -> None:
    assert facts["folders"] == {
        "/run/kontronik-can-gw": ["0o755", "kontronik-can-gw"],
        "/run/kontronik-can-gw/lock": ["0o755", "kontronik-can-gw"],
        "/var/lib/kontronik-can-gw": ["0o700", "kontronik-can-gw"],
    }


def test_folder_of_locks_remains_when_the_service_stops(facts: Facts) -> None:
    assert any("vcan0" in name and "messages" in name for name in facts["locks"])
    assert facts["locks after a stop"] == ["x"], "the file that the probe wrote"


def test_killed_or_frozen_process_is_replaced_and_logs_its_stack(facts: Facts) -> None:
    assert facts["running again after kill"] >= 0
    assert facts["fresh after kill"]
    assert facts["running again after freeze"] >= 5, "not before the watchdog's time has ended"
    assert any("most recent call first" in str(message) for _, message in facts["log"])
    assert "esc1: telemetry ok" in facts["both"][0]["StatusText"]


def test_sandbox_allows_only_the_needed_actions(facts: Facts) -> None:
    needed = {"CAN socket", "netlink", "abstract socket", "state folder", "runtime folder"}
    needed |= {"lock folder", "terminal", "ctypes", "other processes", "machine-id", "clock state"}
    refused = dict.fromkeys(("internet", "packet"), "Errno 97")
    refused |= dict.fromkeys(("write /etc", "run folder", "set kernel"), "Errno 30")
    denied = ["write and execute", "another device", "namespace", "priority", "another user"]
    denied += ["set clock", "adjust clock"]
    refused |= dict.fromkeys(denied, "Errno 1]")
    refused["cache folder"] = "KeyError"
    probe = facts["probe"]
    assert set(probe) == {*needed, *refused}
    assert [name for name in needed if probe[name] != "works"] == []
    assert [name for name, error in refused.items() if error not in probe[name]] == []


@pytest.mark.skipif(not shared_object().exists(), reason="the core in C was not built")
def test_c_core_can_be_loaded_in_the_sandbox(facts: Facts) -> None:
    assert "core: C" in [message for _, message in facts["log"]]


def test_state_of_the_clock_is_known_in_the_sandbox(facts: Facts) -> None:
    before, synchronised, stepped = facts["clock"]
    assert (before["synchronized"], before["max_error_s"], before["steps"]) == (False, None, 0)
    assert before["hardware"] == ""
    assert synchronised["synchronized"] is True
    assert 0 < synchronised["max_error_s"] < 1
    assert stepped["steps"] == 1
    assert 3599 < stepped["last_step_s"] < 3601
    messages = [str(message) for _, message in facts["log"]]
    assert any(message.startswith("the clock was set by +3600.") for message in messages)


def test_blocked_interface_is_restarted_by_the_restart_unit(facts: Facts) -> None:
    found = facts["restart"]
    assert found["install"]["code"] == 0, found["install"]
    assert found["path"]["UnitFileState"] == "enabled"
    assert found["path"]["ActiveState"] == "active"
    assert found["shaper"]["code"] == 0, found["shaper"]
    assert found["restarted"] >= 0, found
    assert found["works again"] >= 0, found
    assert found["service"]["Result"] == "success", found["service"]
    assert ",UP," in found["interface"]
    assert found["gateway"]["NRestarts"] == "0", "the gateway itself goes on"


def test_metrics_are_served_and_the_gateway_still_cannot_use_ip(facts: Facts) -> None:
    done, text, probe = facts["metrics"]
    assert done["code"] == 0
    assert "kontronik_gateway_escs 1.0" in text
    assert probe == facts["probe"]


def test_live_page_runs_and_asks_for_its_token(facts: Facts) -> None:
    found = facts["web"]
    assert found["before"]["UnitFileState"] == "disabled"
    assert (found["start"]["code"], found["page"]["ActiveState"]) == (0, "active")
    assert found["address"]["code"] == 0
    status, text, _ = found["without token"]
    assert status == 403
    assert "esc1" not in text
    assert found["foreign name"][0] == 421
    assert found["with token"] == 200
    assert "token=" not in found["log"]
    assert found["folders"] == {
        "/var/cache/kontronik-can-gw-web": ["0o700", "kontronik-can-gw"],
        "/var/cache/kontronik-can-gw-web/address.json": ["0o600", "kontronik-can-gw"],
    }
    assert facts["after uninstall"][2]["ActiveState"] == "inactive"


def test_live_page_makes_a_report_in_its_sandbox(facts: Facts) -> None:
    assert facts["web"]["flight"]["summary"]["voltage"] > 10
    assert facts["web"]["report"] == 200


def test_live_page_may_write_only_its_cache(facts: Facts) -> None:
    process = dict(
        line.split(":\t", 1) for line in facts["web"]["process"].splitlines() if ":\t" in line
    )
    assert "0" not in process["Uid"].split() + process["Gid"].split()
    assert {process[f"Cap{kind}"] for kind in ("Inh", "Prm", "Eff", "Bnd", "Amb")} == {"0" * 16}
    exposure = re.search(r"exposure level for \S+: ([\d.]+)", facts["web"]["exposure"])
    assert exposure
    assert float(exposure[1]) <= 1.6
    probe = facts["probe of web"]
    works = {name for name, result in probe.items() if result == "works"}
    needed = {"CAN socket", "internet", "abstract socket", "cache folder", "ctypes", "machine-id"}
    assert works == {*needed, "terminal", "priority"}, probe


def test_uninstall_keeps_configuration_and_state(facts: Facts) -> None:
    assert facts["after uninstall"][1] == [
        "/etc/kontronik-can-gw",
        "/var/lib/kontronik-can-gw",
        "/var/lib/kontronik-can-gw-left",
        "/var/lib/kontronik-can-gw-probe",
    ]
