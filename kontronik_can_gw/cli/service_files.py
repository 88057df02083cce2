"""The files of the service: those in the package's folder ``service``, with the path of the program in the units."""

import re
from collections.abc import Iterator
from pathlib import Path

NAME = "kontronik-can-gw"
PLAIN = Path(__file__).parents[1] / "service"
"""The files as they are."""
UNITS = "etc/systemd/system"
KINDS = ("", "-mqtt", "-metrics")
"""The gateway's service, and those that may stand by it."""
_PROGRAM = f"/usr/bin/{NAME}"
"""The program in the files."""


def planned(program: str) -> Iterator[tuple[str, str]]:
    """Path below the root and text of each file."""
    for kind in KINDS:
        text = _plain(f"{NAME}{kind}.service").replace(_PROGRAM, program)
        yield f"{UNITS}/{NAME}{kind}.service", text
        own = text.replace("/gateway.toml", "/%i.toml")  # what an instance has of its own
        own = re.sub(r"(?m)^(StateDirectory|RuntimeDirectory)=.*", r"\g<0>-%i", own)
        yield f"{UNITS}/{NAME}{kind}@.service", own
    yield f"etc/sysusers.d/{NAME}.conf", _plain("sysusers.conf")
    yield f"etc/tmpfiles.d/{NAME}.conf", _plain("tmpfiles.conf")
    yield f"etc/udev/rules.d/70-{NAME}.rules", _plain("udev.rules")


def _plain(name: str) -> str:
    return (PLAIN / name).read_text(encoding="utf-8")
