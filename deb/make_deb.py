"""Builds the Debian packages for amd64, arm64 and armhf, as `make deb` does.

    python deb/make_deb.py [FOLDER]

The packages need neither a network nor a compiler. The gateway and the core are taken from the
wheel of `make wheels`, which has an object for each machine. pip downloads the libraries in
vendored.txt and checks their hashes. The files of the service are the ones that `service install`
writes. Beside each package is its software bill of materials (sbom.py), which is also in the
package.

The same sources give the same bytes, whatever the folder, the time, the time zone, the language and
the umask of the build are. All files in a package have the time SOURCE_DATE_EPOCH, or the time of
the last commit if it is not set.
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

from sbom import bill_of_materials

from kontronik_can_gw import __version__
from kontronik_can_gw.cli.service import PLAIN, planned
from kontronik_can_gw.native.objects import shared_object

HERE = Path(__file__).resolve().parent
PROJECT = HERE.parent
NAME = "kontronik-can-gw"
MACHINES = {"amd64": "x86_64", "arm64": "aarch64", "armhf": "armv7l"}
"""Debian's names of architectures, and the kernel's names of their machines."""
SCRIPTS = ("postinst", "prerm", "postrm")
SERVICE = {
    "etc/systemd/system": "usr/lib/systemd/system",
    "etc/sysusers.d": "usr/lib/sysusers.d",
    "etc/tmpfiles.d": "usr/lib/tmpfiles.d",
    "etc/udev/rules.d": "usr/lib/udev/rules.d",
}
"""Folders of `service install`, and the package's folders for the same files."""
COMPLETIONS = {
    "bash": f"bash-completion/completions/{NAME}",
    "zsh": f"zsh/vendor-completions/_{NAME}",
    "fish": f"fish/vendor_completions.d/{NAME}.fish",
}
_PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "-q")
_SAME_EVERYWHERE = {
    "LC_ALL": "C.UTF-8",
    "LANGUAGE": "",
    "TZ": "UTC",
    "COLUMNS": "80",
    "PYTHONHASHSEED": "0",
    "DPKG_DEB_THREADS_MAX": "1",
}
"""Environment of all programs, so that their output does not depend on the machine.

xz with several threads divides the data differently.
"""
_FOR_ANY = ("--python-version", "3.11", "--platform", "manylinux2014_x86_64")


def version() -> str:
    """Return Debian's version. Pre-releases such as 0.6.0rc1 sort before the release."""
    return re.sub(r"\.?(a|b|rc|dev)(\d+)$", r"~\1\2", __version__)


def source_time() -> int:
    """Return the time of all files in a package, in seconds since 1970. Exits if it is unknown."""
    if given := os.environ.get("SOURCE_DATE_EPOCH"):
        return int(given)
    command = ["git", "-C", str(PROJECT), "log", "-1", "--format=%ct"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        sys.exit(
            "make_deb.py: the time of the last commit is unknown: git is missing, or this is "
            "not a clone. Set it by hand: SOURCE_DATE_EPOCH=$(date +%s) make deb"
        )
    return int(done.stdout)


def download(folder: Path) -> list[Path]:
    """Download the wheels of vendored.txt."""
    command = [*_PIP, "download", "--no-deps", "--only-binary=:all:", "--require-hashes", *_FOR_ANY]
    subprocess.run([*command, "-d", folder, "-r", HERE / "vendored.txt"], check=True)
    return sorted(folder.iterdir())


def unpack(wheel: Path, folder: Path, keep: str = "") -> None:
    """Extract a wheel's modules and licences, without scripts, and of the objects only ``keep``."""
    with zipfile.ZipFile(wheel) as file:
        for name in file.namelist():
            is_object = name.endswith(".so") and Path(name).name != keep
            if ".data/" not in name and not is_object and not name.endswith(("/RECORD", "/WHEEL")):
                file.extract(name, folder)


def environment_at(seconds: int) -> dict[str, str]:
    """Return the environment of a program whose output has this time."""
    return os.environ | _SAME_EVERYWHERE | {"SOURCE_DATE_EPOCH": str(seconds)}


def output_of(*command: str) -> str:
    """Return the output of a program that uses these sources."""
    environment = environment_at(source_time()) | {"PYTHONPATH": str(PROJECT)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"make_deb.py: {' '.join(command)}: {done.stderr}")
    return done.stdout


def gateway(*words: str) -> str:
    """Return the output of a command of the gateway."""
    return output_of(sys.executable, "-m", "kontronik_can_gw", *words)


def put(path: Path, content: str | bytes, mode: int = 0o644) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    path.chmod(mode)


def compressed(text: str | bytes) -> bytes:
    """Return the same bytes as gzip -9n."""
    return gzip.compress(text.encode() if isinstance(text, str) else text, 9, mtime=0)


def put_service(tree: Path) -> None:
    """Write the files of `service install` for a program in /usr/bin."""
    for place, text in planned(f"/usr/bin/{NAME}"):
        folder = next(folder for folder in SERVICE if place.startswith(folder))
        put(tree / SERVICE[folder] / Path(place).relative_to(folder), text)
    for kind in ("network", "link"):
        text = (PLAIN / f"can.{kind}").read_text(encoding="utf-8")
        put(tree / f"usr/share/doc/{NAME}/examples/50-{NAME}-can0.{kind}", text)


def manual_page() -> str:
    """Return the manual page, which is generated from the options of all commands."""
    tool = str(Path(sys.executable).with_name("argparse-manpage"))
    words = ["--module", "kontronik_can_gw.cli", "--function", "make_parser", "--prog", NAME]
    words += ["--project-name", NAME, "--version", version(), "--manual-title", "User Commands"]
    words += ["--description", "gateway from KONTRONIK ESC telemetry to CAN, CANopen, DroneCAN"]
    return output_of(tool, *words)


def put_documents(tree: Path, seconds: int) -> None:
    """Write manual page, completions, copyright and changelog."""
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
    """Write all files that are the same for every machine, without the core's objects."""
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
    """Write the files in DEBIAN."""
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


def build(
    tree: Path,
    wheel: Path,
    libraries: Sequence[Path],
    architecture: str,
    seconds: int,
    folder: Path,
) -> Path:
    """Build the package of one architecture. This changes ``tree``, a result of ``make_tree``."""
    core = shared_object(MACHINES[architecture]).name
    modules = tree / "usr/lib" / NAME
    unpack(wheel, modules, core)
    about = {"name": NAME, "version": version(), "architecture": architecture}
    content = (modules / "kontronik_can_gw/native" / core).read_bytes()
    bill = bill_of_materials(about, (core, content), libraries, seconds)
    put(tree / f"usr/share/doc/{NAME}/{NAME}.cdx.json", bill)
    put_control(tree, architecture)
    for path in [tree, *tree.rglob("*")]:
        path.chmod(0o755 if path.is_dir() or path.stat().st_mode & 0o100 else 0o644)
        os.utime(path, (seconds, seconds))
    package = folder / f"{NAME}_{version()}_{architecture}.deb"
    put(package.with_suffix(".cdx.json"), bill)
    command = ["dpkg-deb", "--root-owner-group", "-Zxz", "--build", str(tree), str(package)]
    subprocess.run(command, env=environment_at(seconds), check=True, stdout=subprocess.DEVNULL)
    return package


def make(wheel: Path, libraries: Sequence[Path], folder: Path) -> list[Path]:
    """Build the packages of all architectures."""
    seconds, made = source_time(), []
    with tempfile.TemporaryDirectory(prefix="kcg-deb.") as scratch:
        common = Path(scratch, "common")
        make_tree(common, wheel, libraries, seconds)
        for architecture in MACHINES:
            tree = Path(scratch, architecture)
            shutil.copytree(common, tree)
            made.append(build(tree, wheel, libraries, architecture, seconds, folder))
    return made


def core_wheel(folder: Path) -> Path:
    """Build and return the wheel of `make wheels`, which checks and runs all its objects."""
    command = [sys.executable, str(PROJECT / "tests/native/wheels.py"), str(folder)]
    subprocess.run(command, env=environment_at(source_time()), check=True)
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
