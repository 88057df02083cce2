"""``service`` as a command: staged files, round trips, what people changed, wrong uses; status with a stand-in for systemctl."""

import hashlib
import json
import os
import sys
from pathlib import Path

import pytest
from command_line import Done, refused, run

from kontronik_can_gw.cli import service, service_machine
from kontronik_can_gw.cli.service_files import is_ours
from kontronik_can_gw.errors import UserError

UNITS = "etc/systemd/system"
CONFIGURATION = "etc/kontronik-can-gw/gateway.toml"
RULES = "etc/udev/rules.d/70-kontronik-can-gw.rules"
SYSUSERS = "etc/sysusers.d/kontronik-can-gw.conf"
UNIT = f"{UNITS}/kontronik-can-gw.service"
NETWORK = "etc/systemd/network/50-kontronik-can-gw-can0"
FILES = [
    *(CONFIGURATION, SYSUSERS, "etc/tmpfiles.d/kontronik-can-gw.conf", RULES),
    *(f"{NETWORK}.link.example", f"{NETWORK}.network.example"),
    *(UNIT, f"{UNITS}/kontronik-can-gw@.service"),
]
EXECUTABLE = "/opt/kontronik-can-gw/bin/kontronik-can-gw"


def install(root: Path, *words: object, executable: str = EXECUTABLE) -> Done:
    return run("service", "install", "--root", root, "--executable", executable, *words)


def uninstall(root: Path, *words: object) -> str:
    done = run("service", "uninstall", "--root", root, *words)
    assert done.code == 0
    return done.err


def tree(root: Path) -> list[str]:
    """What was added to a root folder."""
    found = [path for path in root.rglob("*") if path.is_symlink() or path.is_file()]
    names = {str(path.relative_to(root)) for path in found}
    return sorted(names - {EXECUTABLE.lstrip("/")})


def edit(root: Path, name: str = "gateway", before: str = "") -> None:
    text = f'{before}[[esc]]\nport = "/dev/esc_left"\n'
    (root / f"etc/kontronik-can-gw/{name}.toml").write_text(text)


def written(program: Path) -> Path:
    program.parent.mkdir(parents=True)
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    return program


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A root folder with the program in it."""
    written(tmp_path / "image" / EXECUTABLE.lstrip("/"))
    return tmp_path / "image"


@pytest.fixture
def wants(root: Path) -> Path:
    return root / UNITS / "multi-user.target.wants"


# --- install and uninstall below a folder


def test_a_staged_install_writes_files_that_all_may_read(root: Path) -> None:
    done = install(root)
    assert done.code == 0
    assert tree(root) == sorted(FILES)
    assert {(root / name).stat().st_mode & 0o777 for name in FILES} == {0o644}
    assert f"ExecStart={EXECUTABLE} run --wait" in (root / UNIT).read_text()
    assert "is the example. Set ports, bit rate and motors first." in done.err
    assert done.err.endswith("kontronik-can-gw.service was not enabled.\n")


def test_uninstall_removes_what_install_wrote_and_keeps_the_configuration(root: Path) -> None:
    install(root, "--metrics", "--mqtt", "--network", 500_000)
    edit(root)
    install(root, "--metrics")
    uninstall(root)
    assert tree(root) == [CONFIGURATION]
    assert "nothing is installed" in uninstall(root)


def test_purge_removes_configurations_and_parameters_and_nothing_of_others(root: Path) -> None:
    install(root)
    for name in ("kontronik-can-gw", "kontronik-can-gw-left", "kontronik-can-gwen"):
        (root / "var/lib" / name).mkdir(parents=True)
        (root / "var/lib" / name / "esc1.params").write_text("x")
    uninstall(root, "--purge")
    assert tree(root) == ["var/lib/kontronik-can-gwen/esc1.params"]
    assert not (root / "var/lib/kontronik-can-gw").exists()


def test_an_edited_configuration_is_kept_and_its_services_are_enabled(
    root: Path, wants: Path
) -> None:
    install(root)
    edit(root)
    before = (root / CONFIGURATION).read_text()
    done = install(root, "--metrics")
    assert "kontronik-can-gw.service is enabled\n" in done.err
    assert "kontronik-can-gw-metrics.service is enabled\n" in done.err
    assert (root / CONFIGURATION).read_text() == before
    unit = (root / UNITS / "kontronik-can-gw-metrics.service").read_text()
    assert f"ExecStart={EXECUTABLE} metrics -c /etc/" in unit
    assert {link.name: str(link.readlink()) for link in wants.iterdir()} == {
        name: f"/etc/systemd/system/{name}"
        for name in ("kontronik-can-gw.service", "kontronik-can-gw-metrics.service")
    }
    assert install(root).code == 0


def test_an_install_removes_what_an_earlier_version_left(root: Path) -> None:
    """0.5.0's drop-in lets the gateway use IP, which it no longer needs."""
    body = "[Service]\nIPAddressAllow=localhost\n"
    checksum = hashlib.sha256(body.encode()).hexdigest()
    head = f'# Written by "kontronik-can-gw service install" 0.5.0, checksum {checksum}.'
    folders = [root / UNITS / f"kontronik-can-gw{end}.service.d" for end in ("", "@")]
    ours, changed = (folder / "prometheus.conf" for folder in folders)
    for file, text in ((ours, body), (changed, body + "# by hand\n")):
        file.parent.mkdir(parents=True)
        file.write_text(f"{head}\n{text}")
    assert f"{ours}: removed" in install(root).err
    assert not ours.parent.exists()
    assert changed.exists()


@pytest.mark.parametrize("kind", ["metrics", "mqtt"])
def test_what_stands_by_the_gateway_is_a_service_of_its_own(root: Path, kind: str) -> None:
    install(root, f"--{kind}")
    edit(root, before='[mqtt]\nbroker = "broker.example"\n')
    assert f"kontronik-can-gw-{kind}.service is enabled" in install(root, f"--{kind}").err
    unit = root / UNITS / f"kontronik-can-gw-{kind}.service"
    assert f"ExecStart={EXECUTABLE} {kind} -c /etc/" in unit.read_text()
    link = root / UNITS / f"multi-user.target.wants/kontronik-can-gw-{kind}.service"
    assert str(link.readlink()) == f"/{UNITS}/{unit.name}"
    uninstall(root)
    assert not unit.exists() and not link.is_symlink()


def test_mqtt_without_a_broker_is_installed_but_not_enabled(root: Path) -> None:
    install(root)
    edit(root)
    said = "gateway.toml: mqtt.broker is not set. kontronik-can-gw-mqtt.service was not enabled."
    assert said in install(root, "--mqtt").err
    names = [path.name for path in (root / UNITS / "multi-user.target.wants").iterdir()]
    assert names == ["kontronik-can-gw.service"]


def test_an_instance_has_its_own_configuration_and_goes_alone(root: Path, wants: Path) -> None:
    for name in ("left", "right"):
        install(root, "--instance", name)
        edit(root, name)
        install(root, "--instance", name)
    template = f"/{UNITS}/kontronik-can-gw@.service"
    assert {link.name: str(link.readlink()) for link in wants.iterdir()} == {
        f"kontronik-can-gw@{name}.service": template for name in ("left", "right")
    }
    assert not (root / CONFIGURATION).exists()
    uninstall(root, "--instance", "left")
    assert [link.name for link in wants.iterdir()] == ["kontronik-can-gw@right.service"]
    assert (root / template.lstrip("/")).exists()
    uninstall(root)
    assert list(wants.iterdir()) == []


def test_a_faulty_configuration_is_reported_and_not_enabled(root: Path, wants: Path) -> None:
    install(root)
    (root / CONFIGURATION).write_text("[can]\nbitrat = 5\n")
    done = install(root)
    assert done.code == 0
    assert "can.bitrat: unknown key" in done.err
    assert not wants.exists()
    assert install(root, "--now").code == 1


def test_an_active_network_file_takes_the_place_of_its_example_and_is_replaced(root: Path) -> None:
    install(root)
    install(root, "--network", 250_000)
    network = root / f"{NETWORK}.network"
    assert "BitRate=250000" in network.read_text()
    assert f"{network}: replaced\n" in install(root, "--network", 500_000).err
    assert "BitRate=500000" in network.read_text()
    install(root)
    assert sorted(network.parent.iterdir()) == [network.with_suffix(".link"), network]


def test_what_was_changed_by_hand_stays_and_is_put_aside_by_uninstall(root: Path) -> None:
    rules, unit = root / RULES, root / UNIT
    unit.parent.mkdir(parents=True)
    unit.write_text("[Service]\nExecStart=/bin/true\n")
    install(root)
    mine = rules.read_text() + "# mine\n"
    rules.write_text(mine)
    done = install(root)
    assert done.code == 0
    for path in (rules, unit):
        assert f"{path}: kept, it was changed by hand. Remove it" in done.err
    assert rules.read_text() == mine
    assert unit.read_text() == "[Service]\nExecStart=/bin/true\n"
    name = rules.name
    assert f"{name}: was changed by hand, kept as {name}.bak" in uninstall(root)
    assert rules.with_name(f"{name}.bak").read_text() == mine
    assert not rules.exists()
    assert f"{rules}: new\n" in install(root).err
    assert is_ours(rules.read_text())


def test_the_group_of_serial_ports_and_a_home_folder_are_those_of_the_machine(root: Path) -> None:
    (root / "etc").mkdir()
    (root / "etc/group").write_text("root:x:0:\nuucp:x:986:\n")
    install(root, executable="/home/pi/.venv/bin/kontronik-can-gw")
    unit = (root / UNIT).read_text()
    assert "\nSupplementaryGroups=uucp\n" in unit
    assert "\nProtectHome=read-only\n" in unit
    assert "m kontronik-can-gw uucp\n" in (root / SYSUSERS).read_text()


def test_a_link_that_leads_out_of_the_root_is_not_followed(root: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (root / "etc").symlink_to(tmp_path / "elsewhere")
    done = install(root)
    assert (done.code, done.err.count("\n")) == (1, 1)
    assert "leads out of" in done.err
    assert tree(tmp_path / "elsewhere") == []


def test_a_folder_that_cannot_be_written_is_one_line(root: Path) -> None:
    (root / "etc").write_text("a file")
    done = install(root)
    assert (done.code, done.err.count("\n")) == (1, 1)
    assert "cannot be" in done.err


# --- wrong uses


@pytest.mark.parametrize("kind", ["mqtt", "metrics"])
def test_a_service_whose_library_is_missing_is_not_installed(
    root: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service, "own_executable", lambda: EXECUTABLE)
    monkeypatch.setattr(service, "find_spec", lambda _name: None)
    said = refused(1, "service", "install", "--root", root, f"--{kind}")
    assert said.startswith(f"--{kind}: needs ")
    assert said.endswith(f": pip install 'kontronik-can-gw[{kind}]'")
    assert tree(root) == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("install --instance ../x", "'../x' is no name: letters, digits, _ . -"),
        ("install --instance gateway", "'gateway' is the plain service's configuration"),
        ("install --network fast", "'fast' is not a bit rate in bit/s"),
        ("install --network 5000000", "'5000000' is not a bit rate in bit/s"),
        ("install --channel can+0", "'can+0' is not the name of an interface"),
        ("status -n many", "'many' is not a number of lines"),
        ("uninstall --now", "unrecognized arguments: --now"),
    ],
)
def test_a_wrong_use_is_reported_in_the_last_line(words: str, said: str) -> None:
    assert said in refused(2, "service", *words.split())


@pytest.mark.parametrize(
    "executable", ["bin/x", "/a b", "/a%h/x", "/a/../x", '/a"x', "/a\nExecStartPre=/x"]
)
def test_a_program_that_a_unit_cannot_hold_is_refused(root: Path, executable: str) -> None:
    done = install(root, executable=executable)
    assert (done.code, tree(root)) == (2, [])
    assert "must be an absolute path without spaces" in done.err


@pytest.mark.parametrize("action", ["install", "status", "uninstall"])
def test_without_systemd_it_is_refused(
    action: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(service_machine, "_BOOTED", tmp_path / "none")
    assert "this system does not run systemd." in refused(1, "service", action)


@pytest.mark.parametrize("action", ["install", "uninstall"])
def test_without_root_it_is_refused(
    action: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(service_machine, "_BOOTED", tmp_path)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    said = refused(1, "service", action)
    assert said.startswith("only root may do that: sudo /")
    assert f" service {action} " in said


def test_a_program_that_the_services_user_cannot_reach_is_refused(tmp_path: Path) -> None:
    program = written(tmp_path / "closed" / "kontronik-can-gw")
    program.parent.chmod(0o700)
    with pytest.raises(UserError) as error:
        service_machine.check_executable(str(program), Path("/"))
    said = str(error.value)
    assert "the service has a /tmp of its own" in said or "is closed to others" in said


# --- status, with a stand-in for systemctl


def test_closed_folders_on_the_way_are_found(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    (tmp_path / "a").mkdir(mode=0o755)
    (tmp_path / "a/b").mkdir(mode=0o750)
    (tmp_path / "a/b/x").write_text("x")
    found = service_machine.closed_to_others(tmp_path / "a/b/x")
    assert found is not None
    (tmp_path / "a/b").chmod(0o711)
    (tmp_path / "a/b/x").chmod(0o640)
    below = [service_machine.closed_to_others(tmp_path / name) for name in ("a/b/x", "a/b")]
    outside = service_machine.closed_to_others(tmp_path.parent)
    assert below == ([tmp_path / "a/b/x", None] if outside is None else [outside, outside])


SYSTEMCTL = """#!{python}
import json, sys
units = json.load(open({file!r}))
verb, unit = sys.argv[1], sys.argv[-1]
if verb == "show":
    print(units.get(unit, {{"LoadState": "not-found"}}).get(sys.argv[4], ""))
elif verb == "list-units":
    print("\\n".join(f"{{name}} loaded" for name in units if "@" in name))
elif verb == "status":
    print(f"{{unit}} has {{sys.argv[5]}} lines of log\\033[31m")
"""
RUNNING = {"LoadState": "loaded", "ActiveState": "active", "UnitFileState": "enabled"}
FAILED = RUNNING | {"ActiveState": "activating", "UnitFileState": "disabled"}
IDLE = FAILED | {"ActiveState": "inactive"}
PLAIN = "kontronik-can-gw.service"
LEFT, RIGHT = "kontronik-can-gw@left.service", "kontronik-can-gw@right.service"


@pytest.mark.parametrize(
    ("units", "words", "code", "heads"),
    [
        ({PLAIN: RUNNING}, [], 0, [f"{PLAIN} has 10 lines of log?[31m"]),
        ({PLAIN: FAILED}, ["-n", 0], 3, [f"{PLAIN} has 0 lines of log?[31m"]),
        ({}, [], 3, [f"{PLAIN}: not installed. See: kontronik-can-gw service install --help"]),
        ({PLAIN: IDLE, LEFT: RUNNING, RIGHT: FAILED}, [], 3, [LEFT, RIGHT]),
        ({PLAIN: RUNNING, LEFT: RUNNING}, [], 0, [PLAIN, LEFT]),
        ({PLAIN: IDLE, LEFT: RUNNING, RIGHT: FAILED}, ["--instance", "left"], 0, [LEFT]),
    ],
)
def test_status_is_systemds_account_of_the_services_in_use(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    units: dict[str, dict[str, str]],
    words: list[object],
    code: int,
    heads: list[str],
) -> None:
    file, tool = tmp_path / "units.json", tmp_path / "systemctl"
    file.write_text(json.dumps(units))
    tool.write_text(SYSTEMCTL.format(python=sys.executable, file=str(file)))
    tool.chmod(0o755)
    monkeypatch.setattr(service_machine, "_BOOTED", tmp_path)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    done = run("service", "status", *words)
    assert (done.code, done.err) == (code, "")
    lines = done.out.splitlines()
    assert [line[: len(head)] for line, head in zip(lines, heads, strict=True)] == heads
