"""Builds one wheel with the C core for every machine with a cross compiler, and checks it.

    python tests/native/wheels.py [FOLDER]

No object may need a library or a version of one. If one does, the exit code is 1. tests/deb runs
the same objects on their machines.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from kontronik_can_gw.native.compile import CROSS_COMPILERS
from kontronik_can_gw.native.objects import shared_object

PROJECT = Path(__file__).resolve().parents[2]


def build(folder: Path) -> Path:
    """Build the wheel. Return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation"]
    environment = os.environ | {"KONTRONIK_WHEEL_FOR_ALL": "1"}
    with tempfile.TemporaryDirectory(prefix="kcg-wheel.") as made:
        subprocess.run([*command, "-w", made, str(PROJECT)], env=environment, check=True)
        (wheel,) = Path(made).iterdir()
        return Path(shutil.copy(wheel, folder))


def mistakes(wheel: Path) -> Iterator[str]:
    """Yield the problems of a wheel: needed libraries, and symbols that a C library may lack."""
    if not wheel.name.endswith("-py3-none-any.whl"):
        yield f"{wheel.name}: a wheel for one machine"
    with tempfile.TemporaryDirectory(prefix="kcg-wheel.") as made:
        shutil.unpack_archive(wheel, made, "zip")
        for machine in CROSS_COMPILERS:
            path = Path(made) / "kontronik_can_gw" / "native" / shared_object(machine).name
            if not path.exists():
                yield f"{path.name} is not there"
                continue
            command = ["readelf", "-dsW", str(path)]
            text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
            if "(NEEDED)" in text:
                yield f"{path.name}: needs a library"
            for name in set(re.findall(r" UND (\S+)", text)):
                is_internal = name.startswith("_") and name != "__errno_location"
                if "@" in name or is_internal:
                    yield f"{path.name}: needs {name}"


def main(folder: Path) -> int:
    wheel = build(folder)
    found = list(mistakes(wheel))
    print(wheel, *found, sep="\n")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1] if sys.argv[1:] else "dist")))
