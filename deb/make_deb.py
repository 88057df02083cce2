"""The Debian packages for amd64, arm64 and armhf, each without need of a network or compiler: make deb.

    python deb/make_deb.py [FOLDER]

Gateway and core come from the wheel of `make wheels`, with an object for each machine; the libraries of vendored.txt by pip, checked by
their hashes. The files of the service are those that `service install` writes. SOURCE_DATE_EPOCH, else the time of the last commit, is the
time of everything in a package: the same sources give the same bytes.
"""

import gzip
import hashlib
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from email.utils import formatdate
from pathlib import Path

from kontronik_can_gw import __version__
from kontronik_can_gw.cli.service import PLAIN, planned
from kontronik_can_gw.native.objects import shared_object

HERE = Path(__file__).resolve().parent
PROJECT = HERE.parent
NAME = "kontronik-can-gw"
MACHINES = {"amd64": "x86_64", "arm64": "aarch64", "armhf": "armv7l"}
"""Debian's name of an architecture, and the kernel's of its machine."""
SCRIPTS = ("postinst", "prerm", "postrm")
SERVICE = {
    "etc/systemd/system": "usr/lib/systemd/system",
    "etc/sysusers.d": "usr/lib/sysusers.d",
    "etc/tmpfiles.d": "usr/lib/tmpfiles.d",
    "etc/udev/rules.d": "usr/lib/udev/rules.d",
}
"""Where `service install` writes, and where a package puts the same."""
COMPLETIONS = {
    "bash": f"bash-completion/completions/{NAME}",
    "zsh": f"zsh/vendor-completions/_{NAME}",
    "fish": f"fish/vendor_completions.d/{NAME}.fish",
}
_PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "-q")
_FOR_ANY = ("--python-version", "3.11", "--platform", "manylinux2014_x86_64")


def version() -> str:
    """Debian's version: what comes before a release, as 0.6.0rc1 and 0.6.0.dev1, sorts before it."""
    return re.sub(r"\.?(a|b|rc|dev)(\d+)$", r"~\1\2", __version__)


def source_time() -> int:
    """Seconds since 1970 of everything in a package. Exits with one line if it is unknown."""
    if given := os.environ.get("SOURCE_DATE_EPOCH"):
        return int(given)
    command = ["git", "-C", str(PROJECT), "log", "-1", "--format=%ct"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        sys.exit(
            "make_deb.py: git cannot tell the time of the last commit: it is missing, or this is no "
            "clone. Set it by hand: SOURCE_DATE_EPOCH=$(date +%s) make deb"
        )
    return int(done.stdout)


def download(folder: Path) -> list[Path]:
    """The wheels of vendored.txt."""
    command = [*_PIP, "download", "--no-deps", "--only-binary=:all:", "--require-hashes", *_FOR_ANY]
    subprocess.run([*command, "-d", folder, "-r", HERE / "vendored.txt"], check=True)
    return sorted(folder.iterdir())


def unpack(wheel: Path, folder: Path, keep: str = "") -> None:
    """A wheel's modules and licences, without its scripts and without objects but the one named ``keep``."""
    with zipfile.ZipFile(wheel) as file:
        for name in file.namelist():
            is_object = name.endswith(".so") and Path(name).name != keep
            if ".data/" not in name and not is_object and not name.endswith(("/RECORD", "/WHEEL")):
                file.extract(name, folder)


def output_of(*command: str) -> str:
    """What a program prints that uses these sources."""
    environment = os.environ | {"PYTHONPATH": str(PROJECT), "COLUMNS": "80"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"make_deb.py: {' '.join(command)}: {done.stderr}")
    return done.stdout


def gateway(*words: str) -> str:
    """What a command of ours prints."""
    return output_of(sys.executable, "-m", "kontronik_can_gw", *words)


def put(path: Path, content: str | bytes, mode: int = 0o644) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    path.chmod(mode)


def compressed(text: str | bytes) -> bytes:
    """As gzip -9n."""
    return gzip.compress(text.encode() if isinstance(text, str) else text, 9, mtime=0)


def put_service(tree: Path) -> None:
    """Units and the like, as `service install` writes them for a program in /usr/bin."""
    for place, text in planned(f"/usr/bin/{NAME}"):
        folder = next(folder for folder in SERVICE if place.startswith(folder))
        put(tree / SERVICE[folder] / Path(place).relative_to(folder), text)
    for kind in ("network", "link"):
        text = (PLAIN / f"can.{kind}").read_text(encoding="utf-8")
        put(tree / f"usr/share/doc/{NAME}/examples/50-{NAME}-can0.{kind}", text)


def manual_page() -> str:
    """Made from the options of all commands."""
    tool = str(Path(sys.executable).with_name("argparse-manpage"))
    words = ["--module", "kontronik_can_gw.cli", "--function", "make_parser", "--prog", NAME]
    words += ["--project-name", NAME, "--version", version(), "--manual-title", "User Commands"]
    words += ["--description", "gateway from KONTRONIK ESC telemetry to CAN, CANopen, DroneCAN"]
    return output_of(tool, *words)


def put_documents(tree: Path, seconds: int) -> None:
    """Manual page, completion, copyright, changelog."""
    share = tree / "usr/share"
    for shell, place in COMPLETIONS.items():
        put(share / place, gateway("completion", shell))
    put(share / f"man/man1/{NAME}.1.gz", compressed(manual_page()))
    document = share / "doc" / NAME
    put(document / "copyright", (HERE / "copyright").read_bytes())
    put(document / "CHANGELOG.md.gz", compressed((PROJECT / "CHANGELOG.md").read_bytes()))
    maintainer = re.findall(r"^Maintainer: (.*)$", (HERE / "control").read_text(), re.MULTILINE)[0]
    entry = f"{NAME} ({version()}) stable; urgency=medium\n\n  * See CHANGELOG.md.gz.\n\n"
    put(
        document / "changelog.gz",
        compressed(f"{entry} -- {maintainer} <>  {formatdate(seconds)}\n"),
    )
    put(share / "lintian/overrides" / NAME, (HERE / "lintian-overrides").read_bytes())


def make_tree(tree: Path, wheel: Path, libraries: Sequence[Path], seconds: int) -> None:
    """All that is the same for every machine; of the core's objects none."""
    modules = tree / "usr/lib" / NAME
    for each in [wheel, *libraries]:
        unpack(each, modules)
    put(tree / "usr/bin" / NAME, (HERE / "program").read_bytes(), 0o755)
    for name in ("take-over", "make-user"):
        put(modules / name, (HERE / name).read_bytes(), 0o755)
    put(
        tree / f"usr/share/python3/runtime.d/{NAME}.rtupdate",
        (HERE / "rtupdate").read_bytes(),
        0o755,
    )
    put_service(tree)
    put_documents(tree, seconds)


def put_control(tree: Path, architecture: str) -> None:
    """The files in DEBIAN."""
    files = sorted(path for path in tree.rglob("*") if path.is_file())
    sums = ""
    for path in files:
        digest = hashlib.md5(path.read_bytes(), usedforsecurity=False).hexdigest()
        sums += f"{digest}  {path.relative_to(tree)}\n"
    words = {
        "VERSION": version(),
        "ARCHITECTURE": architecture,
        "SIZE": str(sum(-(-path.stat().st_size // 1024) for path in files)),
    }
    text = (HERE / "control").read_text("utf-8")
    control = tree / "DEBIAN"
    put(control / "control", re.sub("@([A-Z]+)@", lambda found: words[found[1]], text))
    put(control / "md5sums", sums)
    for name in SCRIPTS:
        put(control / name, (HERE / name).read_bytes(), 0o755)


def build(tree: Path, wheel: Path, architecture: str, seconds: int, folder: Path) -> Path:
    """Make the package of one architecture from a tree of ``make_tree``, which gets its object and is not of use afterwards."""
    unpack(wheel, tree / "usr/lib" / NAME, shared_object(MACHINES[architecture]).name)
    put_control(tree, architecture)
    for path in [tree, *tree.rglob("*")]:
        path.chmod(0o755 if path.is_dir() or path.stat().st_mode & 0o100 else 0o644)
        os.utime(path, (seconds, seconds))
    package = folder / f"{NAME}_{version()}_{architecture}.deb"
    folder.mkdir(parents=True, exist_ok=True)
    command = ["dpkg-deb", "--root-owner-group", "-Zxz", "--build", str(tree), str(package)]
    environment = os.environ | {"SOURCE_DATE_EPOCH": str(seconds)}
    subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
    return package


def make(wheel: Path, libraries: Sequence[Path], folder: Path) -> list[Path]:
    """The packages of all architectures."""
    seconds, made = source_time(), []
    with tempfile.TemporaryDirectory(prefix="kcg-deb.") as scratch:
        common = Path(scratch, "common")
        make_tree(common, wheel, libraries, seconds)
        for architecture in MACHINES:
            tree = Path(scratch, architecture)
            shutil.copytree(common, tree)
            made.append(build(tree, wheel, architecture, seconds, folder))
    return made


def core_wheel(folder: Path) -> Path:
    """The wheel of `make wheels`, whose objects were all looked at and run."""
    subprocess.run([sys.executable, PROJECT / "tests/native/wheels.py", folder], check=True)
    (wheel,) = folder.iterdir()
    return wheel


def main(folder: Path) -> int:
    try:
        with tempfile.TemporaryDirectory(prefix="kcg-deb.") as scratch:
            wheel = core_wheel(Path(scratch, "core"))
            packages = make(wheel, download(Path(scratch, "libraries")), folder)
    except subprocess.CalledProcessError as error:
        print(f"make_deb.py: {shlex.join(map(str, error.cmd))}: failed", file=sys.stderr)
        return 1
    print(*packages, sep="\n")
    return 0


if __name__ == "__main__":
    if len(sys.argv) > 2:
        sys.exit(__doc__)
    sys.exit(main(Path(sys.argv[1] if sys.argv[1:] else "dist")))
