"""One wheel with the core in C for every machine that there is a cross compiler for, and a look at it: make wheels.

    python tests/native/wheels.py [FOLDER]

Each object must need no library and no version of one, and run beside its machine's C library, under qemu-user. Exits with 1 if one does
not.
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
from kontronik_can_gw.native.objects import OPTIONS, shared_object, source_number

PROJECT = Path(__file__).resolve().parents[2]
EMULATORS = {
    "x86_64": "qemu-x86_64 -L /usr/x86_64-linux-gnu",
    "aarch64": "qemu-aarch64 -L /usr/aarch64-linux-gnu",
    "armv7l": "qemu-arm -cpu cortex-a8 -L /usr/arm-linux-gnueabihf",
}
_LOADER = r"""
#include <dlfcn.h>
#include <stdint.h>
#include <stdio.h>
#include "core.h"

int main(int argc, char **argv)
{
    void *object = dlopen(argv[argc - 1], RTLD_NOW);
    if (!object)
        return fprintf(stderr, "%s\n", dlerror()), 1;
    uint32_t (*sizes)(uint32_t) = (uint32_t (*)(uint32_t))dlsym(object, "kcg_sizes");
    printf("%u %d\n", sizes(0), (int)(sizes(5) == sizeof(kcg_esc)));
    return 0;
}
"""


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
            if (told := ran(path, machine)) != (wanted := f"{source_number()} 1"):
                yield f"{path.name}: {told!r} in place of {wanted!r}"


def needs(path: Path) -> Iterator[str]:
    """Libraries, and what not every C library has."""
    found = subprocess.run(["readelf", "-dsW", path], capture_output=True, text=True, check=True)
    if library := re.search(r"\(NEEDED\).*", found.stdout):
        yield f"{path.name}: {library[0]}"
    for name in set(re.findall(r" UND (\S+)", found.stdout)):
        if "@" in name or (name.startswith("_") and name != "__errno_location"):
            yield f"{path.name}: needs {name}"


def ran(path: Path, machine: str) -> str:
    """What the loader says of an object."""
    source, loader = path.with_suffix(".c"), path.with_suffix("")
    source.write_text(_LOADER, encoding="utf-8")
    command = [CROSS_COMPILERS[machine], "-std=c99", *OPTIONS, f"-I{path.parent}", str(source)]
    command += ["-o", str(loader), "-ldl"]
    subprocess.run(command, check=True)
    command = [*EMULATORS[machine].split(), str(loader), str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout.strip() or done.stderr.strip() or f"ended with {done.returncode}"


def main(folder: Path) -> int:
    wheel = build(folder)
    found = list(mistakes(wheel))
    print(wheel, *found, sep="\n")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1] if sys.argv[1:] else "dist")))
