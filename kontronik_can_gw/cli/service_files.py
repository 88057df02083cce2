"""The files that ``service`` installs: content, place, and whether they were changed since.

The first line of each holds a checksum of the rest, which shows later changes.
"""

import hashlib
import os
import re
import shutil
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from kontronik_can_gw import __version__
from kontronik_can_gw.cli.common import say
from kontronik_can_gw.errors import RunError

NAME = "kontronik-can-gw"
CONFIGURATIONS = f"etc/{NAME}"
UNITS = "etc/systemd/system"
SYSUSERS = f"etc/sysusers.d/{NAME}.conf"
TMPFILES = f"etc/tmpfiles.d/{NAME}.conf"
NETWORK = "etc/systemd/network"
WANTS = f"{UNITS}/multi-user.target.wants"
EXAMPLE = "example"
COMPANIONS = {
    "mqtt": ("telemetry to MQTT", "paho", "paho-mqtt 2"),
    "metrics": ("statistics for Prometheus", "prometheus_client", "prometheus-client"),
}
"""Services that may be installed beside the gateway's, each with its template of this name: description, module, library needed."""
OBSOLETE = tuple(f"{UNITS}/{NAME}{end}.service.d/prometheus.conf" for end in ("", "@"))
"""Files that earlier versions installed; an install removes them."""
_HEAD = re.compile(rf'# Written by "{NAME} service install" \S+, checksum ([0-9a-f]{{64}})\.')
_PLACEHOLDER = re.compile(r"@[A-Z]+@")
_IN_HOME = "# The program itself is in a home folder.\nProtectHome=read-only"
_SERIAL_GROUPS = ("dialout", "uucp")
"""Groups that own serial ports, on Debian and on Arch."""


@dataclass(frozen=True)
class PlannedFile:
    """A file below the root, with its text."""

    path: str
    text: str

    def put(self, root: Path) -> str:
        """Write the file and return what was done; one that was changed by hand stays."""
        path = root / self.path
        found = read(path)
        if found == self.text:
            return "as it is"
        if found is not None and not is_ours(found):
            return "kept, it was changed by hand. Remove it to have it written anew"
        write(path, self.text)
        return "new" if found is None else "replaced"


@dataclass(frozen=True)
class Choices:
    """Parameters of the files."""

    executable: str
    home_visible: bool
    """True if the program is below a home folder."""
    group: str
    """Group that owns serial ports."""
    channel: str = "can0"
    bitrate: int | None = None
    """CAN interface; None: the network files are examples only."""
    companions: Collection[str] = ()


def unit(instance: str | None, companion: str = "") -> str:
    """Name of an instance's service, or of a ``companion`` of it; instance None: the plain one."""
    beside = f"-{companion}" if companion else ""
    return f"{NAME}{beside}.service" if instance is None else f"{NAME}{beside}@{instance}.service"


def network_files(channel: str) -> list[str]:
    """Paths of the files for systemd-networkd, below the root."""
    return [f"{NETWORK}/50-{NAME}-{channel}.{kind}" for kind in ("network", "link")]


def configuration(instance: str | None) -> str:
    """Path of the configuration below the root."""
    return f"{CONFIGURATIONS}/{instance or 'gateway'}.toml"


def planned(choices: Choices, root: Path) -> list[PlannedFile]:
    """All files in the order of writing. Active network files have no examples."""
    words = {
        "EXECUTABLE": choices.executable,
        "GROUP": choices.group,
        "HOME": _IN_HOME if choices.home_visible else "ProtectHome=yes",
    }
    files = [_made(SYSUSERS, "sysusers.conf", words), _made(TMPFILES, "tmpfiles.conf", {})]
    texts = {kind: f"KONTRONIK ESC {COMPANIONS[kind][0]}" for kind in choices.companions}
    for kind, text in {"": "KONTRONIK ESC telemetry to CAN", **texts}.items():
        plain = {"DESCRIPTION": text, "CONFIGURATION": "gateway", "FOLDER": NAME}
        template = {
            "DESCRIPTION": f"{text}, %i",
            "CONFIGURATION": "%i",
            "FOLDER": f"{NAME}-%i",
        }
        for instance, own in ((None, plain), ("", template)):
            path = f"{UNITS}/{unit(instance, kind)}"
            files.append(_made(path, f"{kind or 'gateway'}.service", words | own))
    files.append(_made(f"etc/udev/rules.d/70-{NAME}.rules", "udev.rules", {}))
    words = {"CHANNEL": choices.channel, "BITRATE": str(choices.bitrate or 500_000), "HOW": ""}
    for path in network_files(choices.channel):
        name = f"can.{path.rpartition('.')[2]}"
        if choices.bitrate is not None:
            files.append(_made(path, name, words))
        elif not (root / path).exists():
            how = f" An example: set it right, then take .{EXAMPLE} off its name."
            files.append(_made(f"{path}.{EXAMPLE}", name, words | {"HOW": how}))
    return files


def installed(root: Path) -> list[Path]:
    """Every existing file that an install may have written."""
    patterns = {
        file.path
        for bitrate in (None, 0)
        for file in planned(Choices("", False, "", "*", bitrate, COMPANIONS), root)
    }
    return sorted(path for pattern in {*patterns, *OBSOLETE} for path in root.glob(pattern))


def serial_group(root: Path) -> str:
    """Group that owns serial ports on this system."""
    text = read(root / "etc/group") or ""
    groups = {line.split(":")[0] for line in text.splitlines()}
    return next((group for group in _SERIAL_GROUPS if group in groups), _SERIAL_GROUPS[0])


def is_ours(text: str) -> bool:
    """True for a text that is unchanged since an install wrote it."""
    head, _, body = text.partition("\n")
    found = _HEAD.fullmatch(head)
    return found is not None and found[1] == _checksum(body)


@contextmanager
def _attempt(path: Path, what: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise RunError(f"{path}: cannot be {what}: {error.strerror}") from None


def read(path: Path) -> str | None:
    """The text of a file; None where it does not exist."""
    with _attempt(path, "read"):
        try:
            return path.read_text(encoding="utf-8", errors="replace")
        except FileNotFoundError:
            return None


def write(path: Path, text: str) -> None:
    """Write a world-readable file and its folders, atomically."""
    beside = path.with_name(f".{NAME}.{path.name}")
    with _attempt(path, "written"):
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o755)
        try:
            beside.unlink(missing_ok=True)
            with beside.open("x", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            beside.chmod(0o644)
            beside.replace(path)
        finally:
            beside.unlink(missing_ok=True)


def link(path: Path, target: str) -> None:
    """Make a symbolic link, in place of an older one."""
    with _attempt(path, "made"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        path.symlink_to(target)


def check_inside(root: Path, paths: Iterable[Path]) -> None:
    """RunError where a symbolic link leads out of the root, as one to /etc does: files would be written to this machine."""
    top = root.resolve()
    for path in paths:
        if not path.parent.resolve().is_relative_to(top):
            raise RunError(f"{path.parent}: leads out of {root}, to {path.parent.resolve()}")


def remove(path: Path) -> None:
    """Remove a file, a symbolic link or a folder, and print it."""
    with _attempt(path, "removed"):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    say(f"{path}: removed")


def remove_obsolete(root: Path) -> None:
    """Remove what earlier versions installed and this one does not, unless it was changed by hand."""
    for path in (root / place for place in OBSOLETE):
        if (text := read(path)) is not None and not is_ours(text):
            say(f"{path}: was changed by hand, kept; the gateway needs it no more")
        elif text is not None:
            remove(path)
            with suppress(OSError):  # it holds drop-ins of others
                path.parent.rmdir()


def put_aside(path: Path) -> Path:
    """Rename a file to .bak, replacing an older one."""
    with _attempt(path, "renamed"):
        return path.replace(path.with_name(path.name + ".bak"))


def _made(path: str, name: str, words: dict[str, str]) -> PlannedFile:
    template = Path(__file__).parent.parent / "service" / name
    text = template.read_text(encoding="utf-8")
    body = _PLACEHOLDER.sub(lambda found: words[found[0].strip("@")], text)
    head = f'# Written by "{NAME} service install" {__version__}, checksum {_checksum(body)}.'
    return PlannedFile(path, f"{head}\n{body}")


def _checksum(body: str) -> str:
    return hashlib.sha256(body.encode()).hexdigest()
