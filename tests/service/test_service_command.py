"""``service`` as a command: staged files, round trips, what people changed, wrong uses."""

import os
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


FILES = [
    *(CONFIGURATION, SYSUSERS, "etc/tmpfiles.d/kontronik-can-gw.conf", RULES),
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


def test_a_staged_install_writes_files_that_all_may_read(root: Path) -> None:
    done = install(root)
    assert done.code == 0
    assert tree(root) == sorted(FILES)
    assert {(root / name).stat().st_mode & 0o777 for name in FILES} == {0o644}
    assert f"ExecStart={EXECUTABLE} run --wait" in (root / UNIT).read_text()
    assert "is the example. Set ports, bit rate and motors first." in done.err
    assert "kontronik-can-gw.service was not enabled. When it is right: " in done.err
    (root / CONFIGURATION).write_text("[can]\nbitrat = 5\n")
    assert "can.bitrat: unknown key" in install(root).err
    assert install(root, "--now").code == 1
    assert not (root / UNITS / "multi-user.target.wants").exists()


def test_uninstall_removes_what_install_wrote_and_keeps_the_configuration(root: Path) -> None:
    old = root / UNITS / "kontronik-can-gw.service.d/prometheus.conf"  # of 0.5.0
    old.parent.mkdir(parents=True)
    old.touch()
    networks = [
        root / f"etc/systemd/network/50-kontronik-can-gw-can0.{end}" for end in ("link", "network")
    ]
    networks[0].parent.mkdir()
    for path in networks:
        path.write_text("of 0.5.0")
    assert f"{old}: removed" in install(root).err
    install(root, "--metrics", "--mqtt")
    edit(root)
    install(root, "--metrics")
    example = networks[1].with_suffix(".network.example")
    example.touch()
    kept = uninstall(root).splitlines()[-1]
    assert [str(path) in kept for path in (*networks, example)] == [True, True, False]
    assert {path.read_text() for path in networks} == {"of 0.5.0"}
    assert tree(root) == sorted(
        [CONFIGURATION, *(str(path.relative_to(root)) for path in networks)]
    )
    assert "nothing is installed" in uninstall(root)


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


@pytest.mark.parametrize("name", [UNIT, RULES])
def test_uninstall_keeps_what_was_changed_and_names_it(root: Path, name: str) -> None:
    install(root)
    path = root / name
    path.write_text(path.read_text() + "# mine\n")
    said = uninstall(root)
    assert f"{path}: was changed, kept as {path.name}.bak\n" in said
    assert tree(root) == sorted([CONFIGURATION, f"{name}.bak"])
    assert (root / f"{name}.bak").read_text().endswith("# mine\n")


def test_a_link_that_leads_out_of_the_root_is_not_followed(root: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (root / "etc").symlink_to(tmp_path / "elsewhere")
    done = install(root)
    assert (done.code, done.err.count("\n")) == (1, 1)
    assert "leads out of" in done.err
    assert tree(tmp_path / "elsewhere") == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("install --instance ../x", "'../x' is no name"),
        ("install --instance gateway", "'gateway' is no name"),
        ("install --network 500000", "--network: was removed. Copy the two files"),
        ("uninstall --purge", "--purge: was removed. Leave it out, then type sudo rm -r"),
        ("status -n 3", "status: was removed. Type systemctl status"),
        ("uninstall --now", "unrecognized arguments: --now"),
    ],
)
def test_a_wrong_use_is_reported_in_the_last_line(words: str, said: str) -> None:
    assert said in refused(2, "service", *words.split())


def test_an_edited_configuration_is_kept_and_its_services_are_enabled(
    root: Path, wants: Path
) -> None:
    install(root)
    edit(root)
    before = (root / CONFIGURATION).read_text()
    done = install(root, "--metrics", "--mqtt")
    for name in ("kontronik-can-gw", "kontronik-can-gw-metrics"):
        assert f"{name}.service is enabled. See: " in done.err
    assert "mqtt.broker is not set. kontronik-can-gw-mqtt.service was not enabled." in done.err
    assert (root / CONFIGURATION).read_text() == before
    edit(root, before='[mqtt]\nbroker = "broker.example"\n')
    assert "runs" not in install(root, "--mqtt", "--now").err  # below a folder nothing does
    kinds = ("", "-metrics", "-mqtt")
    assert {link.name: str(link.readlink()) for link in wants.iterdir()} == {
        f"kontronik-can-gw{kind}.service": f"/{UNITS}/kontronik-can-gw{kind}.service"
        for kind in kinds
    }
    for kind, command in zip(kinds, ("run --wait", "metrics", "mqtt"), strict=True):
        text = (root / UNITS / f"kontronik-can-gw{kind}.service").read_text()
        assert f"ExecStart={EXECUTABLE} {command} -c /etc/kontronik-can-gw/gateway.toml" in text


def test_it_needs_systemd_root_a_folder_and_the_libraries(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "etc").write_text("a file")
    monkeypatch.setattr(service, "_own_program", lambda: EXECUTABLE)
    assert str(tmp_path / "etc") in refused(1, "service", "install", "--root", tmp_path)
    monkeypatch.setattr(service, "find_spec", lambda _name: None)
    said = refused(1, "service", "install", "--root", root, "--mqtt")
    assert said == "--mqtt: pip install 'kontronik-can-gw[mqtt]'"
    assert tree(root) == []
    for action in ("install", "uninstall"):
        monkeypatch.setattr(service, "_BOOTED", tmp_path / "none")
        assert "this system does not run systemd." in refused(1, "service", action)
        monkeypatch.setattr(service, "_BOOTED", tmp_path)
        monkeypatch.setattr(os, "geteuid", lambda: 1000)
        said = refused(1, "service", action)
        assert said.startswith(f"only root may do that: sudo {EXECUTABLE} service {action} ")
        monkeypatch.undo()
        monkeypatch.setattr(service, "_own_program", lambda: EXECUTABLE)


@pytest.mark.parametrize("program", ["bin/x", "/a b", "/a%h/x", "/a/../x", '/a"x', "/a\nExec=/x"])
def test_a_program_that_a_unit_cannot_hold_or_its_user_not_reach_is_refused(
    root: Path, program: str
) -> None:
    done = install(root, executable=program)
    assert (done.code, tree(root)) == (2, [])
    assert "is not an absolute path without spaces" in done.err
    (root / "opt").chmod(0o700)
    with pytest.raises(UserError, match="the service's user cannot reach it: /"):
        service._check_program(f"{root}{EXECUTABLE}", is_own=False)


def test_a_service_may_have_the_name_of_a_removed_action(root: Path) -> None:
    assert install(root, "--instance", "status").code == 0
    assert (root / "etc/kontronik-can-gw/status.toml").exists()
