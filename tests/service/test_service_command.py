"""``service`` as a command: staged files, round trips, what people changed, wrong uses; status with a stand-in for systemctl."""

import json
import os
import sys
from pathlib import Path

import pytest
from command_line import Done, refused, run

from kontronik_can_gw.cli import service
from kontronik_can_gw.errors import UserError

UNITS = "etc/systemd/system"
CONFIGURATION = "etc/kontronik-can-gw/gateway.toml"
RULES = "etc/udev/rules.d/70-kontronik-can-gw.rules"
SYSUSERS = "etc/sysusers.d/kontronik-can-gw.conf"
UNIT = f"{UNITS}/kontronik-can-gw.service"
NETWORK = "etc/systemd/network/50-kontronik-can-gw-can0"
FILES = [
    *(CONFIGURATION, SYSUSERS, "etc/tmpfiles.d/kontronik-can-gw.conf", RULES),
    *(UNIT, f"{UNITS}/kontronik-can-gw@.service"),
    f"{UNITS}/kontronik-can-gw@.service.d/instance.conf",
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
    assert "kontronik-can-gw.service was not enabled. When it is right: " in done.err


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
    assert "kontronik-can-gw.service is enabled. See: " in done.err
    assert "kontronik-can-gw-metrics.service is enabled. See: " in done.err
    assert (root / CONFIGURATION).read_text() == before
    unit = (root / UNITS / "kontronik-can-gw-metrics.service").read_text()
    assert f"ExecStart={EXECUTABLE} metrics -c /etc/" in unit
    assert {link.name: str(link.readlink()) for link in wants.iterdir()} == {
        name: f"/etc/systemd/system/{name}"
        for name in ("kontronik-can-gw.service", "kontronik-can-gw-metrics.service")
    }
    assert "runs" not in install(root, "--now").err  # below a folder nothing does


def test_an_install_removes_what_an_earlier_version_left(root: Path) -> None:
    """0.5.0's drop-in lets the gateway use IP, which it no longer needs."""
    old = root / UNITS / "kontronik-can-gw.service.d/prometheus.conf"
    old.parent.mkdir(parents=True)
    old.write_text("[Service]\nIPAddressAllow=localhost\n")
    example = root / "etc/systemd/network/50-kontronik-can-gw-can0.link.example"
    example.parent.mkdir()
    example.touch()
    said = install(root).err
    assert f"{old}: removed" in said and f"{example}: removed" in said
    assert not old.exists() and not example.exists()


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
    for name in ("left", "right"):
        (root / f"run/kontronik-can-gw-{name}").mkdir(parents=True)
    uninstall(root, "--instance", "left")
    assert [path.name for path in (root / "run").iterdir()] == ["kontronik-can-gw-right"]
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


def test_installing_twice_changes_nothing_and_what_was_another_is_kept_aside(root: Path) -> None:
    install(root)
    edit(root)
    install(root)
    assert "new" not in (again := install(root)).err and "replaced" not in again.err
    rules = root / RULES
    before = rules.read_text()
    rules.write_text(before + "# mine\n")
    said = f"{rules}: replaced, the one before is {rules.name}.bak. Your lines are in {rules.name}.bak: put them into 71-esc.rules\n"
    assert said in install(root).err
    assert rules.read_text() == before
    rules.write_text(before + "# mine, again\n")
    assert f"replaced, the one before is {rules.name}.bak2" in install(root).err
    assert rules.with_name(f"{rules.name}.bak").read_text() == before + "# mine\n"
    assert rules.with_name(f"{rules.name}.bak2").read_text() == before + "# mine, again\n"
    uninstall(root, "--purge")
    assert tree(root) == []


@pytest.mark.parametrize("name", [UNIT, RULES, f"{NETWORK}.network"])
def test_uninstall_keeps_what_was_changed_and_names_it(root: Path, name: str) -> None:
    install(root, "--network", 250_000)
    path = root / name
    path.write_text(path.read_text() + "# mine\n")
    said = uninstall(root)
    assert f"{path}: was changed, kept as {path.name}.bak\n" in said
    assert tree(root) == sorted([CONFIGURATION, f"{name}.bak"])
    assert (root / f"{name}.bak").read_text().endswith("# mine\n")
    uninstall(root, "--purge")
    assert tree(root) == []


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
    assert str(root / "etc") in done.err


# --- wrong uses


@pytest.mark.parametrize("kind", ["mqtt", "metrics"])
def test_a_service_whose_library_is_missing_is_not_installed(
    root: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service, "_own_program", lambda: EXECUTABLE)
    monkeypatch.setattr(service, "find_spec", lambda _name: None)
    said = refused(1, "service", "install", "--root", root, f"--{kind}")
    assert said == f"--{kind}: pip install 'kontronik-can-gw[{kind}]'"
    assert tree(root) == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("install --instance ../x", "'../x' is no name"),
        ("install --instance gateway", "'gateway' is no name"),
        ("install --network fast", "'fast' is not a bit rate in bit/s"),
        ("install --network 5000000", "'5000000' is not a bit rate in bit/s"),
        ("install --channel can+0", "'can+0' is no name"),
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
    assert "is not an absolute path without spaces" in done.err


@pytest.mark.parametrize("action", ["install", "status", "uninstall"])
def test_without_systemd_it_is_refused(
    action: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(service, "_BOOTED", tmp_path / "none")
    assert "this system does not run systemd." in refused(1, "service", action)


@pytest.mark.parametrize("action", ["install", "uninstall"])
def test_without_root_it_is_refused(
    action: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(service, "_BOOTED", tmp_path)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    said = refused(1, "service", action)
    assert said.startswith("only root may do that: sudo /")
    assert f" service {action} " in said


def test_a_program_that_the_services_user_cannot_reach_is_refused(tmp_path: Path) -> None:
    program = written(tmp_path / "closed" / "kontronik-can-gw")
    program.parent.chmod(0o700)
    with pytest.raises(UserError, match="the service's user cannot reach it: /"):
        service._check_program(str(program), is_own=False)


# --- status, with a stand-in for systemctl


SYSTEMCTL = """#!{python}
import json, sys
units = json.load(open({file!r}))
verb, unit = sys.argv[1], sys.argv[-1]
if verb == "show":
    print("\\n".join(units[unit].get(name, "") for name in sys.argv[4].split(",")))
elif verb == "list-units":
    print("\\n".join(f"{{name}} loaded" for name in units if name in sys.argv or "kontronik-can-gw@*.service" in sys.argv))
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
        ({}, [], 3, ["no service is in use. See: kontronik-can-gw service install --help"]),
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
    monkeypatch.setattr(service, "_BOOTED", tmp_path)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    done = run("service", "status", *words)
    assert (done.code, done.err) == (code, "")
    lines = done.out.splitlines()
    assert [line[: len(head)] for line, head in zip(lines, heads, strict=True)] == heads


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
