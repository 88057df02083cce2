"""What is the machine's own: serial numbers for its nodes, the folder for its parameters."""

import contextlib
import os
from importlib import import_module
from pathlib import Path

_IDENTITIES = ("/etc/machine-id", "/var/lib/dbus/machine-id", "/proc/device-tree/serial-number")
_NAME = "kontronik-can-gw"


def machine_identity(root: Path = Path("/")) -> bytes:
    """What identifies this board: the system's id and the board's serial number (copied memory cards share the former).

    Empty where the system has neither.
    """
    found = b""
    for name in _IDENTITIES:
        try:
            found += (root / name.lstrip("/")).read_bytes().strip(b"\0\n ") + b"\0"
        except OSError:
            continue
    return found


def identity_digest(root: Path = Path("/")) -> bytes:
    """A digest of the identity, which may be shown; empty without one."""
    identity = machine_identity(root)
    if not identity:
        return b""
    return _sha256(identity + _NAME.encode())


def serial_number(number: int, name: str, identity: bytes) -> int:
    """1018h:4 of the ESC with this number (1 ...) and name: always the same on this board, different on others.

    0 without an identity.
    """
    if not identity:
        return 0
    digest = _sha256(identity + f"{_NAME} {number} {name}".encode())
    return int.from_bytes(digest[:4], "big") or 1


def _sha256(data: bytes) -> bytes:
    """The digest, by the interpreter's own code where it has that: hashlib loads OpenSSL, 4 MB and 4 ms."""
    for name in ("_sha2", "_sha256", "hashlib"):  # from Python 3.12 on, before, always
        with contextlib.suppress(ImportError):
            digest: bytes = import_module(name).sha256(data).digest()
            return digest
    raise AssertionError("no hashlib")


def state_folder() -> Path:
    """Where parameters are kept if the configuration does not say: what systemd gives the service, or the user's."""
    if given := os.environ.get("STATE_DIRECTORY"):
        return Path(given.split(":")[0])
    if os.geteuid() == 0:
        return Path("/var/lib") / _NAME
    home = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(home) / _NAME
