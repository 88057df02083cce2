"""One wheel with the core in C for every machine that there is a cross compiler for, and a look at it: make wheels.

    python tests/native/wheels.py [FOLDER]

Each object must need no library and no version of one. Exits with 1 if one does. That they run on their machines is tried with the Debian
packages, which have the same ones (tests/deb).
"""

import os
import re
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

from kontronik_can_gw.native.compile import CROSS_COMPILERS
from kontronik_can_gw.native.objects import shared_object

PROJECT = Path(__file__).resolve().parents[2]


def build(folder: Path) -> Path:
    """The wheel."""
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation"]
    environment = os.environ | {"KONTRONIK_WHEEL_FOR_ALL": "1"}
    with tempfile.TemporaryDirectory(prefix="kcg-wheel.") as made:
        command += ["-w", made, str(PROJECT)]
        subprocess.run(command, env=environment, check=True)
        (wheel,) = Path(made).iterdir()
        folder.mkdir(parents=True, exist_ok=True)
        (folder / wheel.name).write_bytes(wheel.read_bytes())
    return folder / wheel.name


def mistakes(wheel: Path) -> Iterator[str]:
    """What is wrong with a wheel and its objects."""
    if not wheel.name.endswith("-py3-none-any.whl"):
        yield f"{wheel.name}: a wheel for one machine"
    with tempfile.TemporaryDirectory(prefix="kcg-wheel.") as made:
        with zipfile.ZipFile(wheel) as file:
            file.extractall(made)
        native = Path(made) / "kontronik_can_gw" / "native"
        for machine in CROSS_COMPILERS:
            path = native / shared_object(machine).name
            if not path.exists():
                yield f"{path.name} is not there"
                continue
            yield from needs(path)


def needs(path: Path) -> Iterator[str]:
    """Libraries, and what not every C library has."""
    found = subprocess.run(["readelf", "-dsW", path], capture_output=True, text=True, check=True)
    if library := re.search(r"\(NEEDED\).*", found.stdout):
        yield f"{path.name}: {library[0]}"
    for name in set(re.findall(r" UND (\S+)", found.stdout)):
        if "@" in name or (name.startswith("_") and name != "__errno_location"):
            yield f"{path.name}: needs {name}"


def main(folder: Path) -> int:
    wheel = build(folder)
    found = list(mistakes(wheel))
    print(wheel, *found, sep="\n")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1] if sys.argv[1:] else "dist")))
