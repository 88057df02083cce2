"""Compiles the core in C.

hatch_build.py does it at the installation, before the package is installed and with the standard
library only. After an edit of the C sources or of esc/kontronik/fields.py run
``python -m kontronik_can_gw.native.compile``.
"""

import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from kontronik_can_gw.native.objects import (
    OPTIONS,
    generated_headers,
    sealed,
    shared_object,
    source_number,
    sources,
)

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
"""Options that link no library, so that the object suits every C library and version.

The process that loads it has a libc. On 32-bit machines the object uses its oldest time_t.
"""


def compiler() -> str | None:
    """Return the path of the machine's C compiler, or None."""
    return shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


def compile_core(
    target: Path,
    options: Sequence[str] = _OPTIMISED,
    program: str | None = None,
) -> str | None:
    """Make the shared object. Return None, or in one line why it could not be made.

    ``program`` is the compiler. Without it the machine's compiler is used.
    """
    program = program or compiler()
    if program is None:
        return "no C compiler was found during installation"
    named = f"{program} failed during installation"
    part = target.with_name(f"{target.name}.part")
    try:
        done = _run(program, options, part)
        if done.returncode:
            lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
            first_error = next((line for line in lines if "error" in line), lines[0])
            return f"{named}: {first_error}"
        part.write_bytes(sealed(part.read_bytes()))
        part.replace(target)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{named}: {error}"
    finally:
        with contextlib.suppress(OSError):  # a read-only file system, even without the file
            part.unlink()
    return None


def _run(
    program: str,
    options: Sequence[str],
    target: Path,
) -> subprocess.CompletedProcess[str]:
    """Run the compiler with the generated headers in a folder of their own."""
    with tempfile.TemporaryDirectory(prefix="kcg-wire.") as folder:
        for name, text in generated_headers().items():
            (Path(folder) / name).write_text(text, encoding="ascii")
        command = [program, "-std=c99", "-fwrapv", "-fPIC", "-shared", "-o", str(target)]
        command += ["-I", folder, f"-DKCG_SOURCE={source_number()}"]
        command += [str(source) for source in sources() if source.suffix == ".c"]
        return subprocess.run(
            [*command, *options],
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
            timeout=_LIMIT_S,
            env=os.environ | {"LC_ALL": "C"},
        )


if __name__ == "__main__":
    sys.exit(compile_core(shared_object()))
