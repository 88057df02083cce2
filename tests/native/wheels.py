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
#include <stdlib.h>
#include "core.h"

/* Runs the shared object for a moment: an ESC without messages is given a damaged and an undamaged frame. */
int main(int argc, char **argv)
{
    (void)argc;
    void *object = dlopen(argv[1], RTLD_NOW);
    if (!object)
        return fprintf(stderr, "%s\n", dlerror()), 1;
#define FUNCTION(result, name, ...) result (*name)(__VA_ARGS__) = (result (*)(__VA_ARGS__))dlsym(object, "kcg_" #name)
    FUNCTION(uint32_t, sizes, uint32_t);
    FUNCTION(uint32_t, crc32, uint32_t, const uint8_t *, size_t);
    FUNCTION(size_t, size, const kcg_plan *);
    FUNCTION(kcg *, init, void *, const kcg_plan *, const kcg_settings *, int64_t);
    FUNCTION(int, receive, kcg *, int, const uint8_t *, size_t, int64_t, int64_t);
    static const uint16_t none[2];
    static const kcg_plan plan = {.esc_of = none, .listener = none, .first_listener = none, .escs = 1};
    static const kcg_settings settings = {.timeout = 250000000, .crc_errors = 5, .poles = 1, .gear_numerator = 1, .gear_denominator = 1};
    uint8_t frame[80] = "KODLdamaged.............................KODL";
    kcg *g = init(malloc(size(&plan)), &plan, &settings, 0);
    uint32_t crc = crc32(0, frame + 40, 36);
    for (int i = 0; i < 4; i++)
        frame[76 + i] = (uint8_t)(crc >> 8 * i);
    receive(g, 0, frame, sizeof frame, 20000000, 10000000);
    printf("%u %08x %u %u %u %d\n", sizes(0), crc32(0, (const uint8_t *)"123456789", 9), (unsigned)g->esc[0].count[KCG_N_LIVE_V4],
           (unsigned)g->esc[0].count[KCG_N_CRC_ERRORS], g->esc[0].has_live, (int)(sizes(5) == sizeof(kcg_esc)));
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
            if (told := ran(path, machine)) != (wanted := f"{source_number()} cbf43926 1 1 1 1"):
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
