"""The Debian packages in fresh roots of both releases.

They are built, installed, upgraded from an installation of 0.5.0, booted and purged. This is a step
of `make release` (tests/run.py): python -m pytest tests/deb/in_fresh_roots.py. It needs root for
debootstrap and chroot. Roots are downloaded once and kept in tests/deb/.cache. Commands in a root
have no network. ARM is tried with the release's own Python under qemu-user.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import make_deb
import pytest

from kontronik_can_gw.config.keys import REMOVED_KEYS

pytestmark = pytest.mark.promise("packages")

HERE = Path(__file__).resolve().parent
PROJECT = make_deb.PROJECT
CACHE = HERE / ".cache"
RELEASES = ("bookworm", "trixie")
VERSION_0_5_0 = "7d60342"
CAPTURE = PROJECT / "tests" / "golden" / "captures" / "state.kcap"
CONFIGURATION = "etc/kontronik-can-gw/gateway.toml"
WANTS = "etc/systemd/system/multi-user.target.wants"
UNIT = "kontronik-can-gw.service"
BOOT_LIMIT_S = 600
EMULATORS = {
    "arm64": ("qemu-aarch64", "-cpu", "cortex-a53"),  # signed pointers of the default are slow
    "armhf": ("qemu-arm",),
}
OF_APT = re.compile(
    r"(var/(cache|log|lib/(apt|dpkg))|proc|sys|dev|run|tmp)/|root/.*\.deb$|etc/.*-$"
)
"""Files that any installation changes, and that the package need not remove."""
IN_A_NAMESPACE = """
ip link set lo up
mount -t proc proc "$0/proc"
mount -t sysfs sys "$0/sys"
mount -t devpts -o newinstance,ptmxmode=666 devpts "$0/dev/pts"
mount -t tmpfs run "$0/run"
exec chroot "$0" env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LC_ALL=C.UTF-8 \\
    DEBIAN_FRONTEND=noninteractive "$@"
"""

if os.geteuid():
    pytest.skip("needs root: sudo make release ARGS='--only deb'", allow_module_level=True)


@dataclass(frozen=True)
class Root:
    """A folder with a Debian system."""

    path: Path

    def run(self, *words: str, code: int | None = 0) -> str:
        """Run a command in the folder /root of the root, without a network. Return its output."""
        spaces = ("unshare", "--net", "--mount", "--pid", "--fork", "--kill-child")
        command = [*spaces, "sh", "-c", IN_A_NAMESPACE, str(self.path), "sh", "-c"]
        done = subprocess.run(
            [*command, 'cd /root; exec "$@"', "sh", *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
            timeout=300,
        )
        assert "Traceback" not in done.stdout, done.stdout
        assert code is None or done.returncode == code, (words, done.returncode, done.stdout)
        return done.stdout

    def gateway(self, *words: str, code: int | None = 0) -> str:
        return self.run("timeout", "60", "kontronik-can-gw", *words, code=code)

    def install(self, package: Path) -> str:
        shutil.copy(package, self.path / "root")
        return self.run("apt-get", "install", "-y", f"/root/{package.name}")

    def files(self) -> dict[str, str]:
        """Return every file except apt's. Files that list users have their content."""
        found = {}
        for path in self.path.rglob("*"):
            name = str(path.relative_to(self.path))
            if not OF_APT.match(name):
                is_list = name in ("etc/passwd", "etc/group", "etc/shadow", "etc/gshadow")
                found[name] = path.read_text() if is_list else ""
        return found

    def text(self, name: str) -> str:
        return (self.path / name).read_text()


@pytest.fixture(scope="module")
def work() -> Iterator[Path]:
    """Yield a folder that is visible in a virtual machine, unlike /tmp."""
    CACHE.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="work.", dir=CACHE) as folder:
        Path(folder).chmod(0o755)
        yield Path(folder)


@pytest.fixture(scope="module")
def packages(work: Path) -> dict[str, Path]:
    """Build the packages twice and check that they are equal. Return them by architecture.

    The second build is in a copy of the sources, with another umask, language and time zone. So the
    wheels and the compiled cores are compared, too.
    """
    assert make_deb.main(work / "packages") == 0
    copy = work / "a copy of the sources"
    kept_out = shutil.ignore_patterns(".venv", ".cache", "work.*", ".git", "*.so", "__pycache__")
    shutil.copytree(make_deb.PROJECT, copy, ignore=kept_out)
    others = {"TZ": "Asia/Kathmandu", "LC_ALL": "C", "LANG": "tr_TR.UTF-8", "PYTHONPATH": str(copy)}
    others["SOURCE_DATE_EPOCH"] = str(make_deb.source_time())
    command = ["sh", "-c", 'umask 077; exec "$@"', "sh", sys.executable]
    command += [str(copy / "deb/make_deb.py"), str(work / "again")]
    subprocess.run(command, env=os.environ | others, check=True)
    made = sorted((work / "packages").glob("*.deb"))
    assert len(made) == 3
    for path in sorted((work / "packages").iterdir()):
        assert path.read_bytes() == (work / "again" / path.name).read_bytes(), path.name
    return {path.stem.rpartition("_")[2]: path for path in made}


@pytest.fixture
def root(request: pytest.FixtureRequest, work: Path) -> Iterator[Root]:
    """Yield a fresh root of a release, with Python and systemd."""
    release = request.param
    kept = CACHE / f"{release}.tar"
    if not kept.exists():
        made = work / release
        options = ("--variant=minbase", "--include=python3,systemd")
        subprocess.run(["debootstrap", *options, release, str(made)], check=True)
        subprocess.run(["tar", "-C", made, "-cf", f"{kept}.part", "."], check=True)
        Path(f"{kept}.part").rename(kept)
        shutil.rmtree(made)
    with tempfile.TemporaryDirectory(prefix=f"{release}.", dir=work) as folder:
        subprocess.run(["tar", "-C", folder, "-xf", kept], check=True)
        Path(folder).chmod(0o755)
        yield Root(Path(folder))


both_releases = pytest.mark.parametrize("root", RELEASES, indirect=True)


def purge(
    root: Root,
    before: dict[str, str],
    *left: str,
) -> None:
    root.run("apt-get", "purge", "-y", "kontronik-can-gw")
    after = root.files()
    assert {name: after.get(name) for name in before} == before
    assert sorted(set(after) - set(before)) == sorted(left)


def test_lintian_finds_no_fault(packages: dict[str, Path]) -> None:
    command = ["lintian", "--allow-root", *map(str, packages.values())]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout == ""
    assert done.returncode == 0


@both_releases
def test_every_command_works_in_a_fresh_root(packages: dict[str, Path], root: Root) -> None:
    before = root.files()
    said = root.install(packages["amd64"])
    assert f"Then run: systemctl enable --now {make_deb.NAME}" in said
    groups = root.run("id", "-nG", "kontronik-can-gw").split()
    assert sorted(groups) == ["dialout", "kontronik-can-gw", "uucp"]
    said = root.run("systemd-analyze", "verify", UNIT, "kontronik-can-gw-mqtt.service")
    assert "kontronik" not in said
    shutil.copy(CAPTURE, root.path / "root" / "flight.kcap")
    commands = re.findall(r"^    (\w+) ", root.gateway("--help"), re.MULTILINE)
    assert len(commands) > 20
    for command in commands:
        assert f"usage: kontronik-can-gw {command}" in root.gateway(command, "--help")
    for line in (
        "init gateway.toml",
        "schema",
        "describe",
        "completion bash",
        "dbc --esc 2",
        "eds",
        "check -c gateway.toml",
        "export c firmware",
        "monitor flight.kcap --once",
        "report flight.kcap -o t.html",
        "demo --seconds 1",
        "convert flight.kcap - --to candump",
        *(f"convert flight.kcap t.{form}" for form in ["csv", "jsonl", "log", "asc", "blf", "trc"]),
    ):
        root.gateway(*line.split())
    for line, library in (("t.parquet", "pyarrow"), ("t.mf4 --to mf4-log", "asammdf")):
        said = root.gateway("convert", "flight.kcap", *line.split(), code=1)
        assert said.count("\n") == 1
        assert f"needs {library}" in said
        assert "The Debian package leaves it out." in said
    assert "core: C" in root.gateway("doctor", "-c", "gateway.toml", code=1)
    assert root.gateway("status", code=3).count("\n") == 1
    assert "needs" not in root.run("timeout", "5", "kontronik-can-gw", "metrics", code=124)
    line = "timeout 5 kontronik-can-gw mqtt --channel none --broker 127.0.0.1"
    assert "needs paho" not in root.run(*line.split(), code=None)
    root.run("/usr/share/python3/runtime.d/kontronik-can-gw.rtupdate", "rtupdate", "3.1", "3.2")
    for path in (root.path / "root").glob("[!.]*"):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    purge(root, before)


@both_releases
def test_package_can_be_installed_and_purged_without_systemd(
    packages: dict[str, Path],
    root: Root,
) -> None:
    root.run("apt-get", "purge", "-y", "systemd")
    before = root.files()
    root.install(packages["amd64"])
    assert "core: C" in root.gateway("doctor", "-c", f"/{CONFIGURATION}", code=1)
    assert "(dialout)" in root.run("id", "kontronik-can-gw")
    purge(root, before)


def install_0_5_0(root: Root, work: Path) -> str:
    """Write the files of `service install` of 0.5.0. Return the configuration.

    The configuration has every key that was removed after 0.5.0.
    """
    sources = work / "0.5.0"
    sources.mkdir(exist_ok=True)
    archive = ["git", "-C", str(PROJECT), "archive", VERSION_0_5_0]
    tar = subprocess.run(archive, stdout=subprocess.PIPE, check=True)
    subprocess.run(["tar", "-x", "-C", str(sources)], input=tar.stdout, check=True)
    make_deb.put(root.path / "opt/kontronik-can-gw/bin/kontronik-can-gw", "#!/bin/sh\n", 0o755)
    command = [sys.executable, "-m", "kontronik_can_gw", "service", "install", "--mqtt"]
    command += ["--executable", "/opt/kontronik-can-gw/bin/kontronik-can-gw", "--prometheus"]
    command += ["--network", "500000", "--root", str(root.path)]
    subprocess.run(command, cwd=sources, check=True, capture_output=True)
    text = root.text(CONFIGURATION).replace('"can0"', '"vcan0"')
    text = re.sub("^port = .*", 'port = "/run/esc1"', text, flags=re.MULTILINE)
    for key in REMOVED_KEYS:
        text, count = re.subn(f"^#({key.rpartition('.')[2]} =)", r"\1", text, flags=re.MULTILINE)
        assert count == 1, key
    make_deb.put(root.path / CONFIGURATION, text)
    (root.path / WANTS).mkdir(exist_ok=True)
    for name in (UNIT, "kontronik-can-gw@left.service"):
        template = re.sub("@left", "@", name)
        (root.path / WANTS / name).symlink_to(f"/etc/systemd/system/{template}")
    rules = root.path / "etc/udev/rules.d/70-kontronik-can-gw.rules"
    rules.write_text(rules.read_text() + 'ENV{ID_SERIAL_SHORT}=="A10K1ABC", SYMLINK+="esc_left"\n')
    return text


def booted(
    root: Root,
    out: Path,
    script: str,
    *how: str,
) -> dict[str, Any]:
    """Boot the root in a virtual machine and run a script. Return the facts that it found.

    With ``ro`` the root is read-only, and /var is in memory.
    """
    out.mkdir(exist_ok=True)
    for name in ("on_board.py", "on_upgrade.py"):
        shutil.copy(HERE / name, out)
    command = [sys.executable, "-B", f"{PROJECT}/tests/vm/vm_run.py", "--backend", "uml"]
    command += [f"--timeout={BOOT_LIMIT_S}", f"--rw={root.path.parent}", "--"]
    command += ["sh", f"{HERE}/boot_root.sh", str(root.path), str(out), script, *how]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    facts = out / "facts.json"
    said = out / "said"
    talk = done.stdout + done.stderr
    if said.exists():
        talk += said.read_text()
    assert facts.exists(), talk
    found: dict[str, Any] = json.loads(facts.read_text())
    return found


@both_releases
def test_package_replaces_0_5_0_runs_read_only_and_is_purged(
    packages: dict[str, Path],
    root: Root,
    work: Path,
) -> None:
    for name in ("sysusers.d", "udev/rules.d"):  # folders of systemd that this root lacks
        (root.path / "etc" / name).mkdir(parents=True, exist_ok=True)
    before = root.files()
    configuration = install_0_5_0(root, work)
    said = root.install(packages["amd64"])
    assert "70-kontronik-can-gw.rules: was changed by hand, so it is kept" in said
    ours = [path for path in (root.path / "etc").rglob("*kontronik*") if not path.is_dir()]
    assert sorted(str(path.relative_to(root.path / "etc")) for path in ours) == [
        *(f"systemd/network/50-kontronik-can-gw-can0.{kind}" for kind in ("link", "network")),
        f"systemd/system/multi-user.target.wants/{UNIT}",
        "systemd/system/multi-user.target.wants/kontronik-can-gw@left.service",
        "udev/rules.d/70-kontronik-can-gw.rules",
    ]
    assert str((root.path / WANTS / UNIT).readlink()) == f"/usr/lib/systemd/system/{UNIT}"

    facts = booted(root, work / f"{root.path.name}.out", "on_board.py", "ro")
    assert facts["fresh"], facts["log"]
    assert "User=kontronik-can-gw\nActiveState=active\n" in facts["unit"]
    assert f"/lib/systemd/system/{UNIT}" in facts["unit"]
    assert "core: C\n" in facts["log"]
    for key in REMOVED_KEYS:
        assert f"{key}: was removed and is ignored." in facts["log"]
    assert '"can": {"interface": "socketcan", "channel": "vcan0"' in facts["status"]
    assert facts["writable"] == ["/var/lib"]
    assert f"{UNIT} is active" in facts["doctor"]

    root.install(newer(packages["amd64"], work / "newer"))
    assert root.text(CONFIGURATION) == configuration
    assert "99" in root.run("dpkg-query", "-W", "kontronik-can-gw")
    root.run("apt-get", "remove", "-y", "kontronik-can-gw")
    assert root.text(CONFIGURATION) == configuration
    assert not (root.path / "usr/lib/kontronik-can-gw").exists()
    shutil.rmtree(root.path / "opt/kontronik-can-gw")
    network = "etc/systemd/network/50-kontronik-can-gw-can0"
    purge(root, before, f"{network}.link", f"{network}.network")


@both_releases
def test_running_gateway_is_restarted_by_an_upgrade_and_ended_by_removal(
    packages: dict[str, Path],
    root: Root,
    work: Path,
) -> None:
    root.install(packages["amd64"])
    text = root.text(CONFIGURATION).replace('"can0"', '"vcan0"')
    text = re.sub("^port = .*", 'port = "/run/esc1"', text, flags=re.MULTILINE)
    make_deb.put(root.path / CONFIGURATION, text)
    out = work / f"{root.path.name}.out"
    newer(packages["amd64"], out)
    facts = booted(root, out, "on_upgrade.py")
    assert facts["fresh"], facts["install said"]
    assert facts["fresh after upgrade"], facts["upgrade said"]
    before = facts["installed"]
    after = facts["upgraded"]
    assert before["FragmentPath"] == f"/etc/systemd/system/{UNIT}"
    assert after["FragmentPath"].endswith(f"/lib/systemd/system/{UNIT}")
    assert after["FragmentPath"] != before["FragmentPath"]
    assert before["MainPID"] != after["MainPID"]
    assert after["NRestarts"] == "0"
    assert facts["removed"]["ActiveState"] == "inactive", facts["removal said"]
    assert facts["removed"]["LoadState"] == "not-found"
    assert facts["left"] == "", facts["purge said"]


def newer(package: Path, folder: Path) -> Path:
    """Write a copy of the package as version 99 with changed units. Return its path."""
    folder.mkdir(exist_ok=True)
    made = folder / "newer.deb"
    with tempfile.TemporaryDirectory(dir=folder) as tree:
        subprocess.run(["dpkg-deb", "-R", package, f"{tree}/x"], check=True)
        control = Path(tree, "x/DEBIAN/control")
        control.write_text(re.sub("(?m)^Version: .*", "Version: 99", control.read_text()))
        for unit in Path(tree, "x/usr/lib/systemd/system").glob("*.service"):
            unit.write_text(unit.read_text() + "# newer\n")
        command = ["dpkg-deb", "--root-owner-group", "-Zgzip", "-b", f"{tree}/x", str(made)]
        subprocess.run(command, check=True)
    return made


@pytest.mark.parametrize(
    ("architecture", "release"),
    list(zip(EMULATORS, reversed(RELEASES), strict=True)),
)
def test_core_of_an_arm_package_runs_in_the_releases_python(
    packages: dict[str, Path],
    work: Path,
    architecture: str,
    release: str,
) -> None:
    """It converts a capture to the same table as on this machine.

    Each release is tested with one architecture.
    """
    kept = CACHE / f"{release}.{architecture}"
    options = (f"--arch={architecture}", "--variant=minbase", "--include=python3")
    archives = "var/cache/apt/archives"
    if not kept.exists():
        fetched = work / architecture
        command = ["debootstrap", "--download-only", *options, release, str(fetched)]
        subprocess.run(command, check=True)
        shutil.copytree(fetched / archives, kept)
    with tempfile.TemporaryDirectory(dir=work) as folder:
        for package in [*kept.glob("*.deb"), packages[architecture]]:
            subprocess.run(["dpkg-deb", "-x", package, folder], check=True)
        script = (
            f"import sys; sys.path.insert(0, '{folder}/usr/lib/kontronik-can-gw')\n"
            "from kontronik_can_gw.cli import main\n"
            "from kontronik_can_gw.native.load import library\n"
            f"assert library()[0] is not None, library()[1]\nsys.exit(main(sys.argv[1:]))"
        )
        words = ["convert", str(CAPTURE)]
        command = [*EMULATORS[architecture], "-L", folder, f"{folder}/usr/bin/python3"]
        environment = os.environ | {"PYTHONHOME": f"{folder}/usr"}
        tables = [work / f"{architecture}.csv", work / f"{architecture}.here.csv"]
        subprocess.run(
            [*command, "-c", script, *words, str(tables[0])],
            env=environment,
            check=True,
            timeout=300,
        )
        here = [sys.executable, "-m", "kontronik_can_gw", *words, str(tables[1])]
        subprocess.run(here, cwd=PROJECT, check=True)
        assert tables[0].read_bytes() == tables[1].read_bytes()
