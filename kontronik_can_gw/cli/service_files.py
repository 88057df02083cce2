"""The files that ``service`` installs: content, place, and whether they were changed since.

The first line of each holds a checksum of the rest, which shows later changes.
"""

import contextlib
import hashlib
import os
import re
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
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
COMPANIONS = {"mqtt": "telemetry to MQTT", "metrics": "statistics for Prometheus"}
"""Services that may be installed beside the gateway's, each with its template of this name."""
OBSOLETE = tuple(f"{UNITS}/{NAME}{end}.service.d/prometheus.conf" for end in ("", "@"))
"""Files that earlier versions installed; an install removes them."""
_NETWORK_PREFIX = f"50-{NAME}-"
_HEAD = re.compile(rf'# Written by "{NAME} service install" \S+, checksum ([0-9a-f]{{64}})\.')
_PLACEHOLDER = re.compile(r"@[A-Z]+@")
_SERIAL_GROUPS = ("dialout", "uucp")
"""Groups that own serial ports, on Debian and on Arch."""


class State(Enum):
    """State of a file's place."""

    MISSING = "new"
    SAME = "as it is"
    OURS = "replaced: was written by another version or with other options"
    CHANGED = "replaced: was changed by hand, kept as .bak"


@dataclass(frozen=True)
class PlannedFile:
    """A file below the root, with its text."""

    path: str
    text: str

    def state(self, root: Path) -> State:
        """Compare with the present file. RunError where it cannot be read."""
        found = read(root / self.path)
        if found is None:
            return State.MISSING
        if found == self.text:
            return State.SAME
        return State.OURS if is_ours(found) else State.CHANGED


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
    mqtt: bool = False
    metrics: bool = False


def unit(instance: str | None) -> str:
    """Name of an instance's service; None: the plain one."""
    return f"{NAME}.service" if instance is None else f"{NAME}@{instance}.service"


def companion(kind: str, instance: str | None) -> str:
    """Name of the service ("mqtt", "metrics") beside an instance's; None: beside the plain one."""
    return f"{NAME}-{kind}.service" if instance is None else f"{NAME}-{kind}@{instance}.service"


def configuration(instance: str | None) -> str:
    """Path of the configuration below the root."""
    return f"{CONFIGURATIONS}/{instance or 'gateway'}.toml"


def planned(choices: Choices, root: Path) -> list[PlannedFile]:
    """All files in the order of writing. Active network files have no examples."""
    common = {
        "EXECUTABLE": choices.executable,
        "GROUP": choices.group,
        "HOME": _home(choices.home_visible),
    }
    plain = common | {
        "DESCRIPTION": "KONTRONIK ESC telemetry to CAN",
        "CONFIGURATION": "gateway",
        "FOLDER": NAME,
    }
    template = common | {
        "DESCRIPTION": "KONTRONIK ESC telemetry to CAN, %i",
        "CONFIGURATION": "%i",
        "FOLDER": f"{NAME}-%i",
    }
    files = [
        _made(SYSUSERS, "sysusers.conf", common),
        _made(TMPFILES, "tmpfiles.conf", {}),
        _made(f"{UNITS}/{NAME}.service", "gateway.service", plain),
        _made(f"{UNITS}/{NAME}@.service", "gateway.service", template),
        _made(f"etc/udev/rules.d/70-{NAME}.rules", "udev.rules", {}),
    ]
    chosen = {"mqtt": choices.mqtt, "metrics": choices.metrics}
    for kind in (kind for kind in COMPANIONS if chosen[kind]):
        text = f"KONTRONIK ESC {COMPANIONS[kind]}"
        for end, words, name in (("", plain, text), ("@", template, f"{text}, %i")):
            path = f"{UNITS}/{NAME}-{kind}{end}.service"
            files.append(_made(path, f"{kind}.service", words | {"DESCRIPTION": name}))
    for kind in ("network", "link"):
        path = f"{NETWORK}/{_NETWORK_PREFIX}{choices.channel}.{kind}"
        words = {"CHANNEL": choices.channel, "BITRATE": str(choices.bitrate or 500_000), "HOW": ""}
        if choices.bitrate is not None:
            files.append(_made(path, f"can.{kind}", words))
        elif not (root / path).exists():
            words["HOW"] = f" An example: set it right, then take .{EXAMPLE} off its name."
            files.append(_made(f"{path}.{EXAMPLE}", f"can.{kind}", words))
    return files


def installed(root: Path) -> list[Path]:
    """Every existing file that an install may have written."""
    patterns = (
        SYSUSERS,
        TMPFILES,
        f"{UNITS}/{NAME}.service",
        f"{UNITS}/{NAME}@.service",
        *OBSOLETE,
        *(f"{UNITS}/{NAME}-{kind}{end}.service" for kind in COMPANIONS for end in ("", "@")),
        f"etc/udev/rules.d/70-{NAME}.rules",
        *(
            f"{NETWORK}/{_NETWORK_PREFIX}*.{kind}{end}"
            for kind in ("network", "link")
            for end in ("", f".{EXAMPLE}")
        ),
    )
    return [path for pattern in patterns for path in sorted(root.glob(pattern))]


def serial_group(root: Path) -> str:
    """Group that owns serial ports on this system."""
    text = read(root / "etc/group") or ""
    groups = {line.split(":")[0] for line in text.splitlines()}
    return next((group for group in _SERIAL_GROUPS if group in groups), _SERIAL_GROUPS[0])


def template(name: str) -> str:
    """A template shipped with the package."""
    return (Path(__file__).parent.parent / "service" / name).read_text(encoding="utf-8")


def is_ours(text: str) -> bool:
    """True for a text that is unchanged since an install wrote it."""
    head, _, body = text.partition("\n")
    found = _HEAD.fullmatch(head)
    return found is not None and found[1] == _checksum(body)


def read(path: Path) -> str | None:
    """The text of a file; None where it does not exist."""
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except FileNotFoundError:
        return None
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror}") from None


def write(path: Path, text: str) -> None:
    """Write a world-readable file and its folders, atomically."""
    beside: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o755)
        with tempfile.NamedTemporaryFile(
            "w", dir=path.parent, prefix=f".{NAME}.", delete=False, encoding="utf-8"
        ) as file:
            beside = Path(file.name)
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        beside.chmod(0o644)
        beside.replace(path)
    except OSError as error:
        if beside is not None:
            with contextlib.suppress(OSError):
                beside.unlink()
        raise RunError(f"{path}: cannot be written: {error.strerror}") from None


def check_inside(root: Path, paths: Iterable[Path]) -> None:
    """RunError where a symbolic link leads out of the root, as one to /etc does: files would be written to this machine."""
    top = root.resolve()
    for path in paths:
        if not path.parent.resolve().is_relative_to(top):
            raise RunError(f"{path.parent}: leads out of {root}, to {path.parent.resolve()}")


def remove(path: Path) -> None:
    """Remove a file or a symbolic link and print it. RunError on failure."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise RunError(f"{path}: cannot be removed: {error.strerror}") from None
    say(f"{path}: removed")


def remove_obsolete(root: Path) -> None:
    """Remove what earlier versions installed and this one does not, unless it was changed by hand."""
    for path in (root / place for place in OBSOLETE):
        if is_ours(read(path) or ""):
            remove(path)
            with contextlib.suppress(OSError):  # it holds drop-ins of others
                path.parent.rmdir()


def put_aside(path: Path) -> Path:
    """Rename a file to .bak, replacing an older one."""
    kept = path.with_name(path.name + ".bak")
    try:
        path.replace(kept)
    except OSError as error:
        raise RunError(f"{path}: cannot be renamed: {error.strerror}") from None
    return kept


def _home(visible: bool) -> str:
    if visible:
        return "# The program itself is in a home folder.\nProtectHome=read-only"
    return "ProtectHome=yes"


def _made(path: str, name: str, words: dict[str, str]) -> PlannedFile:
    body = _PLACEHOLDER.sub(lambda found: words[found[0].strip("@")], template(name))
    return PlannedFile(
        path,
        f'# Written by "{NAME} service install" {__version__}, checksum {_checksum(body)}.\n{body}',
    )


def _checksum(body: str) -> str:
    return hashlib.sha256(body.encode()).hexdigest()
