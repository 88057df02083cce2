"""Compiles the core in C. At the installation hatch_build.py calls it; it imports nothing that is not in the standard library."""

import platform
import shutil
import subprocess
import zlib
from collections.abc import Sequence
from pathlib import Path

FOLDER = Path(__file__).parent
_LIMIT_S = 120
SOURCES = tuple(FOLDER / name for name in ("core.h", "core.c", "offline.h", "offline.c"))
FOR_LINUX = ("-DKCG_DATA=64", "-DKCG_FLOATS=1", "-DKCG_FOUND=512")
"""With CAN FD and floats, for reads of 16 KiB."""


def shared_object() -> Path:
    """Where the one for this machine is, or would be."""
    return FOLDER / f"core-{platform.machine()}.so"


def source_number() -> int:
    """A number of the sources, which an object made of them carries."""
    found = 0
    for source in SOURCES:
        found = zlib.crc32(source.read_bytes(), found)
    return found & 0x7FFF_FFFF


def compiler() -> str | None:
    """The machine's C compiler."""
    return shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


def compile_core(target: Path, options: Sequence[str] = ("-O2", *FOR_LINUX)) -> str | None:
    """Make the shared object; None, or why it could not be made, in one line."""
    program = compiler()
    if program is None:
        return "no C compiler"
    number = f"-DKCG_SOURCE={source_number()}"
    command = [
        program,
        "-std=c99",
        "-fwrapv",
        "-fPIC",
        "-shared",
        number,
        *options,
    ]
    part = target.with_name(f"{target.name}.part")
    try:
        done = subprocess.run(
            [*command, "-o", str(part), *(str(one) for one in SOURCES if one.suffix == ".c")],
            capture_output=True,
            text=True,
            check=False,
            timeout=_LIMIT_S,
        )
        if done.returncode:
            part.unlink(missing_ok=True)
            return f"{program}: {next(iter(done.stderr.strip().splitlines()), 'failed')}"
        part.replace(target)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{program}: {error}"
    return None
