"""The content of the Debian packages, built without a network.

They are built from these sources, with replacements for the libraries and the core's objects.
`make release` installs, upgrades and removes the packages in fresh Debian roots, and runs the
gateway from them (in_fresh_roots.py).
"""

import gzip
import hashlib
import importlib.metadata
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from email import message_from_string
from pathlib import Path
from typing import Any, NamedTuple

import make_deb
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from sbom import licence_of

from kontronik_can_gw.cli.service import PLAIN, planned

pytestmark = pytest.mark.promise("packages")

PROJECT = make_deb.PROJECT
LEFT_OUT = {"wrapt", "markdown-it-py", "pygments", "argparse-addons", "crccheck"}
"""Dependencies of libraries that no command of ours imports."""
PINS = [
    Requirement(line.split(" --hash")[0])
    for line in (make_deb.HERE / "vendored.txt").read_text().splitlines()
    if not line.startswith("#")
]
VENDORED = {canonicalize_name(pin.name): pin for pin in PINS}
CANTOOLS = """Metadata-Version: 2.1
Name: cantools
Version: 45.1.0
Summary: CAN BUS tools.
License: MIT
Requires-Dist: bitstruct>=8.16.1
Requires-Dist: python-can>=3.3.4
Requires-Dist: matplotlib; extra == 'plot'
"""
EPOCH = "1700000000"
OWN = f"./usr/lib/{make_deb.NAME}/kontronik_can_gw/"

if shutil.which("dpkg-deb") is None:
    pytest.skip("no dpkg-deb: it is Debian's and Ubuntu's", allow_module_level=True)


def zipped(path: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as file:
        for name, content in files.items():
            file.writestr(name, content)
    return path


def inputs(folder: Path) -> tuple[Path, list[Path]]:
    """Make replacements for the wheels of the gateway and of the libraries."""
    files = {}
    for path in (PROJECT / "kontronik_can_gw").rglob("*"):
        if path.is_file() and path.suffix in (".py", ".toml", ".service"):
            files[str(path.relative_to(PROJECT))] = path.read_bytes()
    for machine in make_deb.MACHINES.values():
        files[f"kontronik_can_gw/native/core-{machine}.so"] = machine.encode()
    wheel = zipped(folder / "gateway.whl", files)
    library = {"bitstruct/__init__.py": b"", "bitstruct/c.so": b"", "bitstruct.data/scripts/x": b""}
    user = {"cantools/__init__.py": b"", "cantools-45.1.0.dist-info/METADATA": CANTOOLS.encode()}
    return wheel, [
        zipped(folder / "bitstruct-8.24.0-cp311-cp311-linux_x86_64.whl", library),
        zipped(folder / "cantools-45.1.0-py3-none-any.whl", user),
    ]


class Built(NamedTuple):
    """Packages, and the wheels that they are made of."""

    wheel: Path
    libraries: list[Path]
    packages: list[Path]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    """Build the packages, which takes seconds."""
    folder = tmp_path_factory.mktemp("deb")
    wheel, libraries = inputs(folder)
    with pytest.MonkeyPatch.context() as patch:
        # The sources may be without a repository.
        patch.setenv("SOURCE_DATE_EPOCH", EPOCH)
        packages = make_deb.make(wheel, libraries, folder / "out")
    return Built(wheel, libraries, packages)


@pytest.fixture(scope="module")
def made(built: Built) -> dict[str, bytes]:
    """Return the contents of the packages by architecture."""
    return {path.stem.rpartition("_")[2]: path.read_bytes() for path in built.packages}


@pytest.mark.parametrize("is_git_installed", [True, False])
def test_without_a_repository_the_remedy_is_given_in_one_line(
    is_git_installed: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("SOURCE_DATE_EPOCH", raising=False)
    monkeypatch.setattr(make_deb, "PROJECT", tmp_path)
    if not is_git_installed:
        monkeypatch.setenv("PATH", str(tmp_path))
    expected = r"^make_deb\.py: .*git is missing.* SOURCE_DATE_EPOCH=.* make deb$"
    with pytest.raises(SystemExit, match=expected):
        make_deb.source_time()


def contents(package: bytes, part: str = "--fsys-tarfile") -> dict[str, tarfile.TarInfo]:
    return {member.name: member for member in opened(package, part).getmembers()}


def opened(package: bytes, part: str = "--fsys-tarfile") -> tarfile.TarFile:
    done = subprocess.run(
        ["dpkg-deb", part, "/dev/stdin"],
        input=package,
        capture_output=True,
        check=True,
    )
    return tarfile.open(fileobj=io.BytesIO(done.stdout))


def text(package: bytes, name: str, part: str = "--fsys-tarfile") -> str:
    file = opened(package, part).extractfile(name)
    assert file is not None
    content = file.read()
    if name.endswith(".gz"):
        content = gzip.decompress(content)
    return content.decode()


def test_each_package_has_only_its_object_and_depends_only_on_python(
    made: dict[str, bytes],
) -> None:
    assert set(made) == {"amd64", "arm64", "armhf"}
    for architecture, package in made.items():
        objects = [name for name in contents(package) if name.endswith(".so")]
        assert objects == [f"{OWN}native/core-{make_deb.MACHINES[architecture]}.so"]
        assert text(package, objects[0]) == make_deb.MACHINES[architecture]
        lines = text(package, "./control", "--ctrl-tarfile")
        control = dict(re.findall(r"^(\S+): (.*)$", lines, re.MULTILINE))
        assert control["Architecture"] == architecture
        assert control["Depends"] == "python3 (>= 3.11)"
        assert control["Version"] == make_deb.version()


def test_no_file_is_in_etc_or_var_and_all_files_belong_to_root(made: dict[str, bytes]) -> None:
    found = contents(made["amd64"])
    assert [name for name in found if name.startswith(("./etc", "./var", "./run"))] == []
    programs = ("/bin/kontronik-can-gw", "take-over", "make-user", "rtupdate")
    for name, member in found.items():
        is_executable = member.isdir() or name.endswith(programs)
        mode = 0o755 if is_executable else 0o644
        assert (member.uid, member.gid, member.uname) == (0, 0, "root"), name
        assert member.mode & 0o777 == mode, name


def test_package_has_units_rules_completion_and_manual(made: dict[str, bytes]) -> None:
    package = made["armhf"]
    found = contents(package)
    for kind in ("", "-mqtt", "-metrics"):
        for instance in ("", "@"):
            name = f"kontronik-can-gw{kind}{instance}.service"
            unit = text(package, f"./usr/lib/systemd/system/{name}")
            assert unit.startswith("[Unit]\n")
            start = "^ExecStart=(/bin/sh .* )?/usr/bin/kontronik-can-gw (run|mqtt|metrics) "
            assert re.search(start, unit, re.MULTILINE)
            assert re.search("@[A-Z]+@", unit) is None
    for name in (
        "lib/sysusers.d/kontronik-can-gw.conf",
        "lib/tmpfiles.d/kontronik-can-gw.conf",
        "lib/udev/rules.d/70-kontronik-can-gw.rules",
        "share/doc/kontronik-can-gw/copyright",
        "share/doc/kontronik-can-gw/examples/50-kontronik-can-gw-can0.network",
        *(f"share/{place}" for place in make_deb.COMPLETIONS.values()),
    ):
        assert found[f"./usr/{name}"].size, name
    manual = text(package, "./usr/share/man/man1/kontronik-can-gw.1.gz").replace("\\", "")
    assert "COMMAND fI,'kontronik-can-gw service install'" in manual
    assert "--wait" in manual


def test_dpkg_can_verify_every_file(made: dict[str, bytes]) -> None:
    package = made["arm64"]
    sums = text(package, "./md5sums", "--ctrl-tarfile").splitlines()
    listed = [line.split("  ", 1)[1] for line in sums]
    files = [name[2:] for name, member in contents(package).items() if member.isfile()]
    assert sorted(listed) == sorted(files)


@pytest.fixture
def board(tmp_path: Path) -> Path:
    """Return a root with the package's files of the service and its scripts.

    The tools that the scripts call are replaced.
    """
    make_deb.put_service(tmp_path)
    for name in ("take-over", *make_deb.SCRIPTS):
        script = (make_deb.HERE / name).read_text()
        script, count = re.subn(r"/(etc|usr/lib|var|run)(?=/|\s)", rf"{tmp_path}/\1", script)
        assert count
        make_deb.put(tmp_path / "usr/lib/kontronik-can-gw" / name, script, 0o755)
    for name in ("py3clean", "getent", "userdel", "systemctl"):
        make_deb.put(tmp_path / "bin" / name, f'#!/bin/sh\necho {name} "$@"\n', 0o755)
    return tmp_path


def script(board: Path, name: str, *words: str) -> str:
    """Run a script of the package in the root. Return its output."""
    path = board / "usr/lib/kontronik-can-gw" / name
    environment = os.environ | {"PATH": f"{board}/bin:{os.environ['PATH']}"}
    done = subprocess.run(
        [path, *words],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stderr == ""
    assert done.returncode == 0
    return done.stdout


def installed(board: Path) -> list[Path]:
    """Write the files of `service install` for a program in /opt. Return the paths."""
    files = planned("/opt/x/bin/kontronik-can-gw")
    for place, content in files:
        make_deb.put(board / place, content)
    return sorted(path for path in (board / "etc").rglob("*") if path.is_file())


@pytest.mark.parametrize(
    "words",
    [
        ("take-over",),
        ("prerm", "upgrade", "99"),
        ("prerm", "remove"),
    ],
)
def test_package_removes_files_of_service_install(board: Path, words: tuple[str, ...]) -> None:
    """It also does so before another version's files replace the files to compare with."""
    installed(board)
    link = board / "etc/systemd/system/multi-user.target.wants/kontronik-can-gw@left.service"
    link.parent.mkdir()
    link.symlink_to(board / "etc/systemd/system/kontronik-can-gw@.service")
    assert "changed by hand" not in script(board, *words)
    left = {str(path.relative_to(board / "etc")) for path in (board / "etc").rglob("*")}
    expected = {"sysusers.d", "systemd", "systemd/system", "tmpfiles.d", "udev", "udev/rules.d"}
    expected |= {str(path.relative_to(board / "etc")) for path in (link.parent, link)}
    assert left == expected
    assert link.readlink() == board / "usr/lib/systemd/system/kontronik-can-gw@.service"


def test_files_changed_by_hand_are_kept_and_reported(board: Path) -> None:
    files = installed(board)
    for path in files:
        path.write_text(path.read_text() + "# mine\n")
    said = script(board, "take-over").splitlines()
    suffix = ": was changed by hand, so it is kept and used instead of the package's file"
    assert set(said) == {f"{path}{suffix}" for path in files}
    assert all(path.exists() for path in files)


def test_purge_keeps_network_files_and_another_installations_files(board: Path) -> None:
    kept = [board / "etc/kontronik-can-gw/gateway.toml", board / "var/lib/kontronik-can-gw/esc1"]
    network = board / "etc/systemd/network/50-kontronik-can-gw-can0.network"
    for path in (*kept, network):
        make_deb.put(path, "x")
    installed(board)
    said = script(board, "postrm", "purge")
    assert ".service: is not part of the package. Configurations" in said
    assert "userdel" not in said
    assert all(path.exists() for path in kept)
    script(board, "take-over")
    assert "userdel kontronik-can-gw" in script(board, "postrm", "purge")
    left = [*(board / "etc").rglob("*kontronik*"), *(board / "var").rglob("*kontronik*")]
    assert [path.name for path in left] == [network.name]


@pytest.mark.parametrize("is_there", [False, True])
def test_without_systemd_the_user_is_the_one_that_sysusers_would_create(
    is_there: bool,
    tmp_path: Path,
) -> None:
    """Only replacements are in PATH, so systemd-sysusers is missing."""
    for name in ("useradd", "groupadd"):
        make_deb.put(tmp_path / name, f'#!/bin/sh\necho {name} "$@"\n', 0o755)
    make_deb.put(tmp_path / "getent", f"#!/bin/sh\nexit {0 if is_there else 2}\n", 0o755)
    done = subprocess.run(
        ["/bin/sh", make_deb.HERE / "make-user"],
        env={"PATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    if is_there:
        assert done.stdout == ""
        return
    made = done.stdout.splitlines()
    assert made[:2] == ["groupadd --system dialout", "groupadd --system uucp"]
    lines = (PLAIN / "sysusers.conf").read_text().splitlines()
    rows = [shlex.split(line) for line in lines if not line.startswith("#")]
    groups = [row[2] for row in rows if row[0] == "m"]
    ((_, user, _, comment, home, shell),) = [row for row in rows if row[0] == "u"]
    assert shell == "-"  # means nologin for a system user
    assert made[2] == (
        f"useradd --system --user-group --groups {','.join(groups)} --no-create-home "
        f"--home-dir {home} --shell /usr/sbin/nologin --comment {comment} {user}"
    )


def test_with_systemd_sysusers_creates_the_user(tmp_path: Path) -> None:
    make_deb.put(tmp_path / "systemd-sysusers", '#!/bin/sh\necho sysusers "$@"\n', 0o755)
    command = ["/bin/sh", str(make_deb.HERE / "make-user")]
    said = subprocess.check_output(command, env={"PATH": str(tmp_path)}, text=True)
    assert said == "sysusers kontronik-can-gw.conf\n"


def test_every_library_is_pinned_or_left_out_by_name() -> None:
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    shipped = ("mqtt", "metrics", "web")
    lines = [*project["dependencies"], *(line for extra in shipped for line in extras[extra])]
    waiting = [Requirement(line) for line in lines]
    needed = set[str]()
    while waiting:
        requirement = waiting.pop()
        name = canonicalize_name(requirement.name)
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        if name in LEFT_OUT or name in needed:
            continue
        assert name in VENDORED, f"{name} is not in deb/vendored.txt"
        (pinned,) = VENDORED[name].specifier
        assert requirement.specifier.contains(pinned.version), (str(requirement), pinned.version)
        needed.add(name)
        waiting += map(Requirement, importlib.metadata.requires(name) or [])
    assert needed == set(VENDORED)


def test_no_command_imports_a_library_that_is_left_out() -> None:
    script = (
        "import importlib, pkgutil, sys\n"
        "for name in sys.argv[1:]: sys.modules[name] = None\n"
        "import kontronik_can_gw\n"
        "for module in pkgutil.walk_packages(kontronik_can_gw.__path__, 'kontronik_can_gw.'):\n"
        "    if not module.name.endswith('__main__') and '.core-' not in module.name:\n"
        "        importlib.import_module(module.name)\n"
        "from kontronik_can_gw.cli import main\n"
        "assert main(['demo', '--seconds', '0.1']) == 0\n"
        "import can.interfaces.socketcan, can.interfaces.slcan, can.interfaces.pcan\n"
        "import canopen, cantools.database\n"
    )
    modules = ["wrapt", "markdown_it", "pygments", "argparse_addons", "crccheck", "diskcache"]
    modules += ["msgpack", "bitstruct.c", "numpy", "pyarrow", "asammdf"]
    command = [sys.executable, "-c", script, *modules]
    done = subprocess.run(
        command,
        cwd=PROJECT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


# --- bill of materials


def bill_of(package: bytes) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(
        text(package, f"./usr/share/doc/{make_deb.NAME}/{make_deb.NAME}.cdx.json")
    )
    return found


def test_bill_of_materials_is_valid_cyclonedx(made: dict[str, bytes]) -> None:
    validation = pytest.importorskip("cyclonedx.validation.json")
    schema = pytest.importorskip("cyclonedx.schema")
    validator = validation.JsonStrictValidator(schema.SchemaVersion.V1_6)
    for package in made.values():
        assert validator.validate_str(json.dumps(bill_of(package))) is None


def test_bill_of_materials_lists_core_and_libraries(made: dict[str, bytes]) -> None:
    bill = bill_of(made["arm64"])
    own = bill["metadata"]["component"]
    assert (own["name"], own["version"]) == (make_deb.NAME, make_deb.version())
    assert own["purl"].endswith("?arch=arm64")
    assert bill["metadata"]["timestamp"] == "2023-11-14T22:13:20Z"
    core, bitstruct, cantools = bill["components"]
    assert core["hashes"] == [{"alg": "SHA-256", "content": hashlib.sha256(b"aarch64").hexdigest()}]
    assert bitstruct["purl"] == "pkg:pypi/bitstruct@8.24.0"
    assert cantools["licenses"] == [{"license": {"id": "MIT"}}]
    depends = {each["ref"]: each["dependsOn"] for each in bill["dependencies"]}
    assert depends["pkg:pypi/cantools@45.1.0"] == ["pkg:pypi/bitstruct@8.24.0"]
    assert set(depends[own["bom-ref"]]) == {each["bom-ref"] for each in bill["components"]}


def test_bill_of_materials_is_beside_the_package_too(built: Built) -> None:
    package = built.packages[0]
    beside = package.with_suffix(".cdx.json").read_text()
    assert json.loads(beside) == bill_of(package.read_bytes())


@pytest.mark.parametrize(
    ("head", "licence"),
    [
        (
            "License-Expression: Apache-2.0 OR BSD-2-Clause",
            {"expression": "Apache-2.0 OR BSD-2-Clause"},
        ),
        ("License: LGPL v3", {"license": {"id": "LGPL-3.0-only"}}),
        ("License: my own", {"license": {"name": "my own"}}),
        ("Classifier: License :: OSI Approved :: MIT License", {"license": {"id": "MIT"}}),
        ("Summary: x", None),
    ],
)
def test_licence_is_taken_from_the_metadata_of_the_wheel(head: str, licence: object) -> None:
    assert licence_of(message_from_string(f"Name: x\nVersion: 1\n{head}\n\n")) == licence


# --- two builds

ANOTHER_TIME = """
import time
_time = time.time
time.time = lambda: _time() + 40 * 86400
"""


def test_two_builds_in_different_surroundings_are_equal(built: Built, tmp_path: Path) -> None:
    """They differ in folder, time, time zone, language, hash seed, umask and order of files."""
    script = (
        "import os, sys; os.umask(0o077); sys.path.insert(0, sys.argv[1]); "
        "from pathlib import Path; import make_deb; "
        "make_deb.make(Path(sys.argv[2]), [Path(p) for p in sys.argv[4:]], Path(sys.argv[3]))"
    )
    later = tmp_path / "later"
    later.mkdir()
    (later / "sitecustomize.py").write_text(ANOTHER_TIME)
    project = tmp_path / "a" / "long folder with blanks" / "and ümlauts"
    project.mkdir(parents=True)
    for name in ("deb", "kontronik_can_gw", "dbc", "eds", "CHANGELOG.md", "LICENSE"):
        source = PROJECT / name
        copy = shutil.copytree if source.is_dir() else shutil.copyfile
        copy(source, project / name)
    out = tmp_path / "out"
    environment = {
        "TZ": "Pacific/Kiritimati",
        "LC_ALL": "tr_TR.UTF-8",
        "LANG": "de_DE.UTF-8",
        "LANGUAGE": "de:fr",
        "COLUMNS": "200",
        "PYTHONHASHSEED": "77",
        "PYTHONPATH": f"{later}{os.pathsep}{project}",
        "DPKG_DEB_THREADS_MAX": "3",
        "SOURCE_DATE_EPOCH": EPOCH,
    }
    words = [project / "deb", built.wheel, out, *reversed(built.libraries)]
    subprocess.run(
        [sys.executable, "-c", script, *map(str, words)],
        env=os.environ | environment,
        check=True,
    )
    first, second = (
        {path.name: path.read_bytes() for path in folder.iterdir()}
        for folder in (built.packages[0].parent, out)
    )
    assert len(first) == 6
    assert first.keys() == second.keys()
    for name, content in first.items():
        assert content == second[name], name
