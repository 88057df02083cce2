"""The shipped EDS as text, also with changed keys or further objects, as EDS editors write it."""

import re
import subprocess
import sys
from pathlib import Path

from kontronik_can_gw.config.keys import shipped

SHIPPED = shipped("eds/kontronik_esc.eds").read_bytes().decode("ascii")


def with_key(source: str, section: str, key: str, value: str) -> str:
    """Return the text with a key set to this value. A missing key is added."""
    start = source.index(f"[{section}]")
    end = source.find("\r\n[", start)
    part = source[start : end if end >= 0 else None]
    changed = re.sub(rf"(?m)^{key}=.*?\r$", lambda _: f"{key}={value}\r", part)
    if changed == part and f"{key}={value}\r" not in part:
        changed = part.rstrip() + f"\r\n{key}={value}\r\n"
    return source.replace(part, changed)


def variable(
    data_type: int,
    access: str = "rw",
    name: str = "Test object",
    **keys: object,
) -> str:
    """Return the content of the section of a VAR."""
    values = {
        "ParameterName": name,
        "ObjectType": "0x7",
        "DataType": f"0x{data_type:04X}",
        "AccessType": access,
        **keys,
    }
    return "".join(f"{key}={value}\r\n" for key, value in values.items())


def with_object(source: str, index: int, content: str) -> str:
    """Return the text with a further manufacturer object, whose section has this content."""
    found = re.search(r"\[ManufacturerObjects\]\r\nSupportedObjects=(\d+)", source)
    assert found is not None
    count = int(found[1])
    source = with_key(source, "ManufacturerObjects", "SupportedObjects", str(count + 1))
    source = with_key(source, "ManufacturerObjects", str(count + 1), f"0x{index:04X}")
    return f"{source.rstrip()}\r\n\r\n[{index:04X}]\r\n{content}\r\n"


def dcfchk(file: Path, node_id: int) -> str:
    """Return the findings of dcf-tools' checker of CiA 306, or "".

    Without a node-ID the checker does not accept $NODEID.
    """
    program = "from dcf.cli import main; main()"
    command = [sys.executable, "-c", program, "-p", "-n", str(node_id), str(file)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (run.returncode == 0) == (not run.stderr)
    return run.stderr
