"""The command ``service``: staged files, round trips, files that people changed, wrong uses."""

import os
import re
from pathlib import Path

import pytest
from command_line import Done, refused, run

from kontronik_can_gw.cli import service
from kontronik_can_gw.cli.service import planned
from kontronik_can_gw.errors import UserError

pytestmark = pytest.mark.promise("service")

UNITS = "etc/systemd/system"
CONFIGURATION = "etc/kontronik-can-gw/gateway.toml"
RULES = "etc/udev/rules.d/70-kontronik-can-gw.rules"
UNIT = f"{UNITS}/kontronik-can-gw.service"
EXECUTABLE = "/opt/kontronik-can-gw/bin/kontronik-can-gw"
OF_0_5_0 = f"{UNITS}/kontronik-can-gw.service.d/prometheus.conf"
NETWORK = "etc/systemd/network/50-kontronik-can-gw-can0.network"


def install(root: Path, *words: object, executable: str = EXECUTABLE) -> Done:
    return run("service", "install", "--root", root, "--executable", executable, *words)


def uninstall(root: Path) -> str:
    done = run("service", "uninstall", "--root", root)
    assert done.code == 0
    return done.err


def tree(root: Path) -> list[str]:
    """Return the files and links in a root folder."""
    found = [path for path in root.rglob("*") if path.is_symlink() or path.is_file()]
    return sorted(str(path.relative_to(root)) for path in found)


def edit(root: Path, name: str = "gateway") -> str:
    text = '[[esc]]\nport = "/dev/esc_left"\n'
    (root / f"etc/kontronik-can-gw/{name}.toml").write_text(text)
    return text


def enabled(root: Path) -> dict[str, str]:
    links = (root / UNITS).glob("multi-user.target.wants/*")
    return {link.name: str(link.readlink()) for link in links}


def test_staged_install_writes_files_that_all_users_may_read(tmp_path: Path) -> None:
    done = install(tmp_path)
    assert done.code == 0
    names = [CONFIGURATION, *(place for place, _ in planned(""))]
    assert tree(tmp_path) == sorted(names)
    assert {(tmp_path / name).stat().st_mode & 0o777 for name in names} == {0o644}
    commands = {"": "run --wait", "-metrics": "metrics", "-mqtt": "mqtt", "-web": "web"}
    for kind, command in commands.items():
        text = (tmp_path / UNITS / f"kontronik-can-gw{kind}.service").read_text()
        (line,) = re.findall("(?m)^ExecStart=.*", text)
        assert f"{EXECUTABLE} {command} -c /etc/kontronik-can-gw/gateway.toml" in line
    assert "is the unchanged example. Set ports, bit rate and motors first." in done.err
    assert "kontronik-can-gw.service was not enabled. After the correction: " in done.err
    (tmp_path / CONFIGURATION).write_text("[can]\nbitrat = 5\n")
    assert "can.bitrat: unknown key" in install(tmp_path).err
    assert install(tmp_path, "--now").code == 1
    assert enabled(tmp_path) == {}


def test_configuration_with_restarts_enables_the_unit_of_its_interface(tmp_path: Path) -> None:
    install(tmp_path)
    text = edit(tmp_path) + '[can]\nchannel = "can7"\nrestart_after_s = 0.5\n'
    (tmp_path / CONFIGURATION).write_text(text)
    unit = "kontronik-can-gw-restart@can7.path"
    assert f"{unit} is enabled, because can.restart_after_s is not 0\n" in install(tmp_path).err
    assert enabled(tmp_path)[unit] == f"/{UNITS}/kontronik-can-gw-restart@.path"
    uninstall(tmp_path)
    assert tree(tmp_path) == [CONFIGURATION]


def test_edited_configuration_is_kept_and_changed_files_are_backed_up(tmp_path: Path) -> None:
    install(tmp_path)
    text = edit(tmp_path)
    said = install(tmp_path, "--now").err
    unit = "kontronik-can-gw.service"
    assert said.endswith(f"{unit} is enabled. See: systemctl status {unit}\n")
    assert "new" not in said
    assert "replaced" not in said
    assert (tmp_path / CONFIGURATION).read_text() == text
    assert enabled(tmp_path) == {"kontronik-can-gw.service": f"/{UNIT}"}
    rules = tmp_path / RULES
    before = rules.read_text()
    for mine, kept in (("# mine\n", f"{rules.name}.bak"), ("# again\n", f"{rules.name}.bak2")):
        rules.write_text(before + mine)
        said = install(tmp_path).err
        assert f"{rules}: replaced, the old file is {kept}. Your lines are in {kept}" in said
        assert rules.read_text() == before
        assert rules.with_name(kept).read_text() == before + mine


def test_uninstall_removes_installed_files_and_keeps_peoples_files(tmp_path: Path) -> None:
    for place in (OF_0_5_0, NETWORK, f"{NETWORK}.example"):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).write_text("of 0.5.0")
    assert f"{tmp_path / OF_0_5_0}: removed" in install(tmp_path).err
    edit(tmp_path)
    install(tmp_path)
    for name in (UNIT, RULES):
        with (tmp_path / name).open("a") as file:
            file.write("# mine\n")
    said = uninstall(tmp_path)
    assert f"{tmp_path / UNIT}: was changed, kept as kontronik-can-gw.service.bak\n" in said
    assert "kept: /etc/kontronik-can-gw, " in said.splitlines()[-1]
    assert tree(tmp_path) == sorted([CONFIGURATION, NETWORK, f"{UNIT}.bak", f"{RULES}.bak"])
    assert (tmp_path / f"{UNIT}.bak").read_text().endswith("# mine\n")
    assert "nothing is installed" in uninstall(tmp_path)


def test_instance_has_its_own_configuration(tmp_path: Path) -> None:
    for name in ("left", "status"):  # "status" was an action
        install(tmp_path, "--instance", name)
        edit(tmp_path, name)
        install(tmp_path, "--instance", name)
    template = f"/{UNITS}/kontronik-can-gw@.service"
    assert enabled(tmp_path) == {
        f"kontronik-can-gw@{name}.service": template for name in ("left", "status")
    }
    assert not (tmp_path / CONFIGURATION).exists()
    uninstall(tmp_path)
    assert enabled(tmp_path) == {}


def test_link_out_of_the_root_is_not_followed(tmp_path: Path) -> None:
    for name in ("elsewhere", "root"):
        (tmp_path / name).mkdir()
    (tmp_path / "root/etc").symlink_to(tmp_path / "elsewhere")
    done = install(tmp_path / "root")
    assert done.code == 1
    assert done.err.count("\n") == 1
    assert "is outside of" in done.err
    assert tree(tmp_path / "elsewhere") == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("install --instance ../x", "'../x' is not a name"),
        ("install --instance gateway", "'gateway' is not a name"),
        ("uninstall --instance left", "was removed. Type sudo systemctl disable --now kontronik"),
        ("status -n 3", "status: was removed. Type systemctl status"),
        ("uninstall --now", "unrecognized arguments: --now"),
    ],
)
def test_wrong_use_is_reported_in_the_last_line(words: str, said: str) -> None:
    assert said in refused(2, "service", *words.split())


@pytest.mark.parametrize("action", ["install", "uninstall"])
def test_command_needs_systemd_and_root(
    action: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(service, "_own_program", lambda: EXECUTABLE)
    monkeypatch.setattr(service, "_BOOTED", tmp_path / "none")
    assert "this system does not run systemd." in refused(1, "service", action)
    monkeypatch.setattr(service, "_BOOTED", tmp_path)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    said = refused(1, "service", action)
    assert said.startswith(
        f"service {action}: needs root. Type sudo {EXECUTABLE} service {action} "
    )


@pytest.mark.parametrize(
    "program",
    ["bin/x", "/a b", "/a%h/x", "/a/../x", '/a"x', "/a\nExec=/x"],
)
def test_program_that_a_unit_cannot_contain_is_refused(tmp_path: Path, program: str) -> None:
    done = install(tmp_path, executable=program)
    assert done.code == 2
    assert tree(tmp_path) == []
    assert "is not an absolute path without spaces" in done.err


def test_program_that_the_services_user_cannot_reach_is_refused(tmp_path: Path) -> None:
    (tmp_path / "opt").mkdir(0o700)
    with pytest.raises(UserError, match="the service's user cannot access /"):
        service._check_program(f"{tmp_path}/opt/x", is_own=False)
