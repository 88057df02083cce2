"""The shared objects of the core in C beside its sources: which one is this process's, and whether it may be loaded at all.

A file that was cut off or damaged would end the process when it is loaded, so it is looked at before.
"""

import os
import sys
import zlib
from pathlib import Path

from kontronik_can_gw.esc.kontronik.c_header import wire_header as wire_header

FOLDER = Path(__file__).parent
NOT_BUILT = FOLDER / "not_built.txt"
"""Why the installation made no object; hatch_build.py writes it."""
OPTIONS = ("-DKCG_DATA=64", "-DKCG_FLOATS=1", "-DKCG_SLOTS=1", "-DKCG_FOUND=512", "-DKCG_SLICES=8")
"""What the objects are built with: CAN FD, floats and slots, for reads of 16 KiB."""
_SEALED = 0x2144_DF1C
"""CRC-32 of anything that its own CRC-32 follows."""
_IN_32_BITS = {"x86_64": "i686", "aarch64": "armv7l", "armv8l": "armv7l"}


def shared_object(machine: str = "") -> Path:
    """Where the one for a machine is, or would be; as a rule for this process, which may have 32 bits on a machine that has 64."""
    if not machine:
        machine = os.uname().machine
        if sys.maxsize < 1 << 32:
            machine = _IN_32_BITS.get(machine, machine)
    return FOLDER / f"core-{machine}.so"


def sources() -> list[Path]:
    """All C files of the core, with their headers except the generated wire.h."""
    return sorted(FOLDER.glob("*.[ch]"))


def source_number() -> int:
    """Return a number of sources, wire.h and options, which an object made of them carries."""
    found = zlib.crc32(" ".join((*OPTIONS, wire_header())).encode())
    for source in sources():
        found = zlib.crc32(source.read_bytes(), found)
    return found & 0x7FFF_FFFF


def sealed(content: bytes) -> bytes:
    """An object with its CRC-32 at the end, where no loader looks."""
    return content + zlib.crc32(content).to_bytes(4, "little")


def fault(path: Path) -> str:
    """Why an object cannot be loaded, in one line; empty where it may be tried."""
    try:
        content = path.read_bytes()
        if zlib.crc32(content) != _SEALED:
            return f"{path.name}: cut off or damaged"
    except FileNotFoundError:
        return _not_built() or f"no {path.name} in this installation"
    except OSError as error:
        return f"{path.name}: {error}"
    try:
        with Path("/proc/self/exe").open("rb") as program:
            mine = _machine(program.read(20))
    except OSError as error:
        return f"which machine this is cannot be read: {error}"
    return "" if _machine(content) == mine else f"{path.name}: built for another machine"


def _not_built() -> str:
    try:
        return " ".join(NOT_BUILT.read_text(encoding="utf-8", errors="replace").split())
    except OSError:
        return ""


def _machine(content: bytes) -> bytes:
    """Word length, byte order and e_machine of an ELF header."""
    return content[4:6] + content[18:20]
