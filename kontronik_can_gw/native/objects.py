"""The shared objects of the core in C, which are stored next to its sources.

A truncated or damaged object would end the process that loads it, so it is checked before.
"""

import os
import sys
import zlib
from pathlib import Path

from kontronik_can_gw.entry_kinds import entries_header
from kontronik_can_gw.esc.kontronik.c_header import wire_header as wire_header

FOLDER = Path(__file__).parent
NOT_BUILT = FOLDER / "not_built.txt"
"""The reason why the installation made no object. hatch_build.py writes it."""
OPTIONS = ("-DKCG_DATA=64", "-DKCG_FLOATS=1", "-DKCG_SLOTS=1", "-DKCG_FOUND=512", "-DKCG_SLICES=8")
"""Options of the compiler: CAN FD, floats and slots.

KCG_FOUND is enough for the frames of KCG_MAX_READ bytes, which are 16 KiB (offline.h).
"""
_SEALED = 0x2144_DF1C
"""The CRC-32 of any data followed by their own CRC-32."""
_IN_32_BITS = {"x86_64": "i686", "aarch64": "armv7l", "armv8l": "armv7l"}


def shared_object(machine: str = "") -> Path:
    """Return the path of the object for a machine, whether it exists or not.

    Without ``machine`` it is the path for this process, which can be a 32-bit process on a 64-bit
    machine.
    """
    if not machine:
        machine = os.uname().machine
        if sys.maxsize < 1 << 32:
            machine = _IN_32_BITS.get(machine, machine)
    return FOLDER / f"core-{machine}.so"


def sources() -> list[Path]:
    """Return all C files and headers of the core except the generated ones."""
    return sorted(FOLDER.glob("*.[ch]"))


def generated_headers() -> dict[str, str]:
    """Return the text of each generated header by its name."""
    return {"wire.h": wire_header(), "entries.h": entries_header()}


def source_number() -> int:
    """Return a number of sources and options, which an object made of them carries."""
    texts = [*OPTIONS, *generated_headers().values()]
    found = zlib.crc32(" ".join(texts).encode())
    for source in sources():
        found = zlib.crc32(source.read_bytes(), found)
    return found & 0x7FFF_FFFF


def sealed(content: bytes) -> bytes:
    """Return an object with its CRC-32 at the end, which loaders ignore."""
    return content + zlib.crc32(content).to_bytes(4, "little")


def fault(path: Path) -> str:
    """Return in one line why an object cannot be loaded, or "" if it can be tried."""
    try:
        content = path.read_bytes()
        if zlib.crc32(content) != _SEALED:
            return f"{path.name}: truncated or damaged"
    except FileNotFoundError:
        return _not_built() or f"no {path.name} in this installation"
    except OSError as error:
        return f"{path.name}: {error}"
    try:
        with Path("/proc/self/exe").open("rb") as program:
            mine = _machine(program.read(20))
    except OSError as error:
        return f"the type of this machine cannot be read: {error}"
    return "" if _machine(content) == mine else f"{path.name}: built for another machine"


def _not_built() -> str:
    try:
        text = NOT_BUILT.read_text(encoding="utf-8", errors="replace")
        return " ".join(text.split())
    except OSError:
        return ""


def _machine(content: bytes) -> bytes:
    """Return word length, byte order and e_machine of an ELF header."""
    return content[4:6] + content[18:20]
