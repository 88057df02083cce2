"""Folders for files that are used only while a gateway runs: its locks and its status.

The folder is the first one that this user may use:

1. ``/run/kontronik-can-gw``, shared with the service. Root and the service's user use it. The
   environment variable ``KONTRONIK_RUN`` replaces ``/run``, so that tests never meet a service.
2. ``kontronik-can-gw`` in ``$XDG_RUNTIME_DIR``, or in ``/run/user/UID`` of a login session.
3. ``/tmp/kontronik-can-gw-UID``, if there is no session (cron, a container, ``su``). This user must
   own it, because every user can create names in ``/tmp``.
"""

import contextlib
import os
import stat
import zlib
from pathlib import Path

NAME = "kontronik-can-gw"
RUN = Path(os.environ.get("KONTRONIK_RUN", "/run"))
TEMPORARY = Path("/tmp")  # noqa: S108  the folder in it is checked, see _is_own
STATUS_FILE = "status.json"
"""Name of a service's status file in its runtime folder."""


def runtime_folder(purpose: str) -> Path:
    """Return this user's folder for a purpose, ``lock`` or ``status``. It may not exist yet."""
    shared = RUN / NAME / purpose
    existing = shared if shared.exists() else shared.parent
    if os.geteuid() == 0 or os.access(existing, os.W_OK):
        return shared
    *sessions, last = _own_folders()
    for folder in sessions:
        if os.access(folder.parent, os.W_OK):
            return folder / purpose
    return last / purpose


def is_of_service(purpose: str) -> bool:
    """Return True if ``runtime_folder`` is shared with the service, and units watch it."""
    return runtime_folder(purpose) == RUN / NAME / purpose


def make_runtime_folder(purpose: str) -> Path:
    """Create the folder of ``runtime_folder`` if it is missing. OSError if it cannot be used."""
    folder = runtime_folder(purpose)
    if folder.parent.parent == TEMPORARY:
        with contextlib.suppress(FileExistsError):
            folder.parent.mkdir(mode=0o700)
        if not _is_own(folder.parent):
            raise OSError(0, f"{folder.parent} belongs to another user or is not a folder")
    folder.mkdir(mode=0o755, parents=True, exist_ok=True)
    if folder.is_symlink():
        raise OSError(0, f"{folder} is a symbolic link. Remove it")
    return folder


def status_name(configuration: Path) -> str:
    """Return the name of the status file of a gateway with this configuration."""
    path = os.fsencode(os.path.realpath(configuration))
    return f"{zlib.crc32(path):08X}.json"


def status_folders() -> list[Path]:
    """Return the folders in which gateways of the system and of this user publish their status.

    Root also gets the folders of the login sessions of all users.
    """
    folders = [RUN / NAME, *filter(_is_own, _own_folders())]
    if os.geteuid() == 0:
        folders += sorted((RUN / "user").glob(f"*/{NAME}"))
    return [folder / "status" for folder in folders]


def _own_folders() -> list[Path]:
    """Return the candidates for this user's folder, best first. They may not exist."""
    uid = os.geteuid()
    given = os.environ.get("XDG_RUNTIME_DIR")
    folders = []
    if given:
        folders.append(Path(given) / NAME)
    folders.append(RUN / "user" / str(uid) / NAME)
    folders.append(TEMPORARY / f"{NAME}-{uid}")
    return folders


def _is_own(folder: Path) -> bool:
    """Return True for an existing folder of this user in which no other user may write."""
    try:
        status = folder.lstat()
    except OSError:
        return False
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid():
        return False
    others_may_write = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return not others_may_write
