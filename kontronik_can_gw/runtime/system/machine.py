"""Derives values from the machine: the nodes' serial numbers, and the folder for parameters."""

import contextlib
import os
from importlib import import_module
from pathlib import Path

_IDENTITIES = ("/etc/machine-id", "/var/lib/dbus/machine-id", "/proc/device-tree/serial-number")
_NAME = "kontronik-can-gw"


def machine_identity(root: Path = Path("/")) -> bytes:
    """Return bytes that identify this board: the system's id and the board's serial number.

    Boards with copied memory cards have the same system id. Empty if the system has neither.
    """
    found = b""
    for name in _IDENTITIES:
        try:
            found += (root / name.lstrip("/")).read_bytes().strip(b"\0\n ") + b"\0"
        except OSError:
            continue
    return found


def identity_digest(root: Path = Path("/")) -> bytes:
    """Return a digest of the identity, which is not secret. Empty without an identity."""
    identity = machine_identity(root)
    if not identity:
        return b""
    return _sha256(identity + _NAME.encode())


def serial_number(number: int, name: str, identity: bytes) -> int:
    """Return the serial number (1018h:04) of the ESC with this number, from 1, and name.

    It is always the same on one board, and differs between boards. 0 without an identity.
    """
    if not identity:
        return 0
    digest = _sha256(identity + f"{_NAME} {number} {name}".encode())
    return int.from_bytes(digest[:4], "big") or 1


def _sha256(data: bytes) -> bytes:
    """Return the digest, computed by the interpreter's own module if there is one.

    hashlib would load OpenSSL, which takes 4 MB and 4 ms.
    """
    # Python 3.12 and later have _sha2, earlier versions _sha256, and all versions have hashlib.
    for name in ("_sha2", "_sha256", "hashlib"):
        with contextlib.suppress(ImportError):
            digest: bytes = import_module(name).sha256(data).digest()
            return digest
    raise AssertionError("no hashlib")


def state_folder() -> Path:
    """Return the folder for parameters if the configuration names none.

    It is the folder that systemd gives to the service, or a folder of the user.
    """
    given = os.environ.get("STATE_DIRECTORY")
    if given:
        return Path(given.split(":")[0])
    if os.geteuid() == 0:
        return Path("/var/lib") / _NAME
    home = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(home) / _NAME
