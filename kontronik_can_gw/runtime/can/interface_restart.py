"""Asks systemd to restart a CAN interface from which no frame leaves.

The gateway has no privileges. It writes a file, and a path unit of systemd then starts a service
that sets the interface down and up (kontronik-can-gw-restart@.path and .service). The name of the
interface is that of the unit's instance. The content of the file does not matter.
"""

import contextlib
import os
from collections.abc import Callable
from pathlib import Path

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.files.disk import open_regular, reason_of
from kontronik_can_gw.runtime.system import folders
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.times import NEVER, SECOND

FOLDER = "restart"
"""Name of the folder of the requests, which has a file for each interface."""
RIGHTS = "Only gateways of root and of the service's user can request a restart"
MAX_PAUSE_NS = 10 * SECOND
ANSWER_NS = 2 * SECOND
"""An interface that goes down within this time after a request is restarted because of it."""


def request_file(channel: str) -> Path:
    """Return the file whose change requests a restart of an interface."""
    return folders.runtime_folder(FOLDER) / channel


def request(channel: str) -> None:
    """Request a restart. Does nothing if the file cannot be written."""
    with contextlib.suppress(OSError):
        folders.make_runtime_folder(FOLDER)
        # closing a file that was opened for writing is a change for systemd
        os.close(open_regular(request_file(channel), os.O_WRONLY | os.O_CREAT))


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


class InterfaceRestart:
    """Requests restarts of one interface.

    1. The first request of an outage follows ``can.restart_after_s`` after its begin.
    2. If no frame leaves after a restart, the pause until the next request doubles, up to
       MAX_PAUSE_NS. It also doubles, from ANSWER_NS, if no restart follows a request.
    3. A restart is counted when the interface has gone down after a request.
    """

    def __init__(
        self,
        config: CanConfig,
        gateway: Gateway,
        conditions: FaultLog,
        ask: Callable[[str], None] = request,
    ) -> None:
        self.condition = f"CAN {config.channel}: restart"
        self._channel = config.channel
        self._after_ns = 0
        if config.interface == "socketcan":
            self._after_ns = round(config.restart_after_s * SECOND)
        self._gateway = gateway
        self._status = gateway.status
        self._conditions = conditions
        self._ask = ask
        self._pause_ns = self._after_ns
        """Pause before the next request."""
        self._requested_ns = -NEVER
        """Time of the last request."""
        self._is_pending = False
        """True if neither a restart nor ANSWER_NS has followed the last request."""
        self._restarts = 0
        """Number of restarts since a frame has left the interface."""

    def follow(self, outage_since: int | None, now: int) -> None:
        """Request a restart if it is due. The interface must be up.

        ``outage_since`` is a time since which no frame has left. None without an outage.
        """
        if not self._after_ns:
            return
        if outage_since is None:
            if not self._gateway.is_held:
                self._end(now)
            return
        if self._is_pending and now - self._requested_ns > ANSWER_NS:
            self._is_pending = False
            self._double(max(self._pause_ns, ANSWER_NS))
            text = f"CAN {self._channel}: the interface was not restarted. {remedy(self._channel)}"
            self._conditions.begin(self.condition, text, now)
        if self._is_pending or now - max(outage_since, self._requested_ns) < self._pause_ns:
            return
        self._requested_ns = now
        self._is_pending = True
        self._ask(self._channel)

    def went_down(self, now: int) -> None:
        """Follow an interface that was set down. Counts it if a restart was requested."""
        if not self._is_pending or now - self._requested_ns > ANSWER_NS:
            return
        self._is_pending = False
        self._double(self._pause_ns)
        self._status.can_restarts += 1
        self._restarts += 1
        if self._restarts == 1:
            text = f"CAN {self._channel}: no frame left it, so it is restarted"
            self._conditions.event(f"{self.condition}s", text, now)
        self._conditions.forget(self.condition)

    def _double(self, pause_ns: int) -> None:
        self._pause_ns = min(2 * pause_ns, max(MAX_PAUSE_NS, self._after_ns))

    def _end(self, now: int) -> None:
        """Follow a frame that has left the interface."""
        if self._restarts:
            count = "one restart" if self._restarts == 1 else f"{self._restarts} restarts"
            text = f"CAN {self._channel}: works again after {count}"
            self._conditions.event(f"{self.condition}s", text, now)
        self._restarts = 0
        self._requested_ns = -NEVER
        self._is_pending = False
        self._pause_ns = self._after_ns
        self._conditions.forget(self.condition)
