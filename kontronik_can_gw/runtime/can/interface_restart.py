"""Asks systemd to restart a CAN interface. The gate to the bus decides when (gateway/gate.py).

The gateway has no privileges. It writes a file, and a path unit of systemd then starts a service
that sets the interface down and up (kontronik-can-gw-restart@.path and .service). The name of the
interface is that of the unit's instance. The content of the file does not matter.
"""

import contextlib
import os
from pathlib import Path

from kontronik_can_gw.runtime.files.disk import open_regular, reason_of
from kontronik_can_gw.runtime.system import folders

FOLDER = "restart"
"""Name of the folder of the requests, which has a file for each interface."""
RIGHTS = "Only gateways of root and of the service's user can request a restart"


def request_file(channel: str) -> Path:
    """Return the file whose change requests a restart of an interface."""
    return folders.runtime_folder(FOLDER) / channel


def request(channel: str) -> None:
    """Request a restart. Does nothing if the file cannot be written."""
    with contextlib.suppress(OSError):
        folders.make_runtime_folder(FOLDER)
        fd = open_regular(request_file(channel), os.O_WRONLY | os.O_CREAT)
        # systemd follows the closing, and programs that poll follow the time of the change
        with contextlib.closing(os.fdopen(fd, "wb")):
            os.utime(fd)


def remedy(channel: str) -> str:
    """Return what to do if the requests for an interface have no effect."""
    if not folders.is_of_service(FOLDER):
        return (
            f"{RIGHTS}: install the service with sudo kontronik-can-gw service install, "
            "or start the gateway as root."
        )
    path = request_file(channel)
    try:
        os.close(open_regular(path, os.O_RDONLY))
    except FileNotFoundError:
        pass
    except OSError as error:
        return f"{path}: {reason_of(error)}. Remove it."
    return f"Enable the unit: sudo systemctl enable --now kontronik-can-gw-restart@{channel}.path"
