"""Compiles the core in C: hatch_build.py at the installation, ``python -m kontronik_can_gw.native.compile`` after an edit."""

import contextlib
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from kontronik_can_gw.native.objects import OPTIONS, sealed, shared_object, source_number, sources

_LIMIT_S = 120
_OPTIMISED = ("-O2", *OPTIONS)
CROSS_COMPILERS = {
    "x86_64": "x86_64-linux-gnu-gcc",
    "aarch64": "aarch64-linux-gnu-gcc",
    "armv7l": "arm-linux-gnueabihf-gcc",
}
"""By machine; Debian's gcc, gcc-aarch64-linux-gnu and gcc-arm-linux-gnueabihf."""
OF_NO_LIBRARY = (
    *_OPTIMISED,
    "-s",
    "-nostdlib",
    "-U_FORTIFY_SOURCE",
    "-U_TIME_BITS",
    "-U_FILE_OFFSET_BITS",
    "-fno-stack-protector",
    "-lgcc",
)
"""Linked with nothing: the process that loads it has a libc, of whichever kind and version (of 32 bits, with its oldest time_t)."""


def compiler() -> str | None:
    """The machine's C compiler."""
    return shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


def compile_core(
    target: Path, options: Sequence[str] = _OPTIMISED, program: str | None = None
) -> str | None:
    """Make the shared object; None, or why it could not be made, in one line. ``program``: the compiler, else the machine's."""
    program = program or compiler()
    if program is None:
        return "there was no C compiler at the installation"
    named = f"at the installation {program} failed"
    part = target.with_name(f"{target.name}.part")
    command = [program, "-std=c99", "-fwrapv", "-fPIC", "-shared", "-o", str(part)]
    command += [f"-DKCG_SOURCE={source_number()}"]
    command += [str(source) for source in sources() if source.suffix == ".c"]
    try:
        done = subprocess.run(
            [*command, *options],
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
            timeout=_LIMIT_S,
            env=os.environ | {"LC_ALL": "C"},
        )
        if done.returncode:
            lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
            return f"{named}: {next((line for line in lines if 'error' in line), lines[0])}"
        part.write_bytes(sealed(part.read_bytes()))
        part.replace(target)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{named}: {error}"
    finally:
        with contextlib.suppress(
            OSError
        ):  # of a file system that is read-only even where it is not there
            part.unlink()
    return None


if __name__ == "__main__":
    sys.exit(compile_core(shared_object()))
