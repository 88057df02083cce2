"""The files that ``service`` installs: copies of those in the package's folder ``service``, with the path of the program in the units."""

import itertools
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

from kontronik_can_gw.cli.common import say

NAME = "kontronik-can-gw"
PLAIN = Path(__file__).parents[1] / "service"
"""The files as they are."""
UNITS = "etc/systemd/system"
CONFIGURATIONS = f"etc/{NAME}"
COMPANIONS = {"mqtt": "paho", "metrics": "prometheus_client"}
"""Services that may stand by the gateway's, and the module that each needs."""
_PROGRAM = f"/usr/bin/{NAME}"
"""The program in the files."""
_ANY_PROGRAM = r"(?m)^ExecStart=\S*", "ExecStart="
NETWORK = f"etc/systemd/network/50-{NAME}-*"
"""0.5.0's set-up of a CAN interface, which goes on working and stays."""
OBSOLETE = (
    *(f"{UNITS}/{NAME}{end}.service.d/prometheus.conf" for end in ("", "@")),
    f"{UNITS}/{NAME}*@.service.d/instance.conf",
    f"{NETWORK}.example",
)
"""What earlier versions installed."""


def unit(instance: str | None, companion: str = "") -> str:
    """Name of an instance's service, or of a ``companion`` of it; instance None: the plain one."""
    beside = f"-{companion}" if companion else ""
    return f"{NAME}{beside}{'' if instance is None else f'@{instance}'}.service"


def planned(program: str, companions: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Path below the root and text of each file."""
    for kind in ("", *companions):
        text = _plain(unit(None, kind)).replace(_PROGRAM, program)
        yield f"{UNITS}/{unit(None, kind)}", text
        own = text.replace("/gateway.toml", "/%i.toml")  # what an instance has of its own
        own = re.sub(r"(?m)^(StateDirectory|RuntimeDirectory)=.*", r"\g<0>-%i", own)
        yield f"{UNITS}/{unit('', kind)}", own
    yield f"etc/sysusers.d/{NAME}.conf", _plain("sysusers.conf")
    yield f"etc/tmpfiles.d/{NAME}.conf", _plain("tmpfiles.conf")
    yield f"etc/udev/rules.d/70-{NAME}.rules", _plain("udev.rules")


def _plain(name: str) -> str:
    return (PLAIN / name).read_text(encoding="utf-8")


def put(path: Path, text: str) -> None:
    """Write a file that all may read; another one of that name is kept beside it, and named."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o755)
    done = "new"
    if path.exists() or path.is_symlink():
        if path.is_file() and path.read_text(encoding="utf-8", errors="replace") == text:
            return
        kept = _set_aside(path)
        done = f"replaced, the one before is {kept}"
        if path.suffix == ".rules":  # 0.5.0's asked for names of ports in it
            done += f". Your lines are in {kept}: put them into 71-esc.rules"
    path.write_text(text, encoding="utf-8")
    path.chmod(0o644)
    say(f"{path}: {done}")


def take_away(path: Path, text: str) -> None:
    """Remove a file whose text ``planned`` gives, with any program; keep another one aside, and name it."""
    found = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else text
    if re.sub(*_ANY_PROGRAM, found) == re.sub(*_ANY_PROGRAM, text):
        remove(path)
    else:
        say(f"{path}: was changed, kept as {_set_aside(path)}")


def _set_aside(path: Path) -> str:
    """Rename a file to the first free name of .bak, .bak2 and so on; the name."""
    names = (f"{path.name}.bak{number if number > 1 else ''}" for number in itertools.count(1))
    name = next(name for name in names if not os.path.lexists(path.with_name(name)))
    path.rename(path.with_name(name))
    return name


def remove(path: Path) -> None:
    """Remove a file, a symbolic link or a folder, and print it."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    elif path.exists() or path.is_symlink():
        path.unlink()
    else:
        return
    say(f"{path}: removed")
