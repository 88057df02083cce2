"""Receives from a CAN bus without sending, for the monitor and similar commands.

A BusListener opens the interface for itself, with receive filters for the requested ids. Other
programs, for example a gateway, may use the same interface at the same time. It takes no locks,
and it opens the interface again after a failure.
"""

import logging
import select
import time

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.runtime.can.can_port import CanPort
from kontronik_can_gw.runtime.can.link_commands import restart
from kontronik_can_gw.runtime.can.open_can import open_can
from kontronik_can_gw.runtime.can.socketcan_port import fault_of
from kontronik_can_gw.status import CanState

RETRY_S = 0.5
"""Interval between attempts to open a faulty interface, and between checks of an open one."""
_MAX_AT_ONCE = 4096
_BUS_OFF = (
    "CAN interface {name}: is bus-off. Check bit rate, wiring and termination, then restart it: "
    "{command}"
)


class BusListener:
    """An open interface from which frames are only received.

    ``keys`` are the ids to receive; 29-bit ids have the flag EXTENDED. Raises UserError if
    python-can does not have the interface. Raises RunError if the interface cannot be opened now,
    except with ``patient``. Later faults are reported only in ``problem``. There is no ``fileno``,
    because the descriptor changes each time the interface is opened.
    """

    def __init__(self, config: CanConfig, keys: frozenset[int], patient: bool = False) -> None:
        self.problem = ""
        """One line with the fault of the interface and its remedy. Empty while it works."""
        self._config = config
        self._keys = keys
        self._port: CanPort | None = None
        self._check_at = 0.0
        # ``problem`` replaces python-can's log of a lost interface, because it has the remedy too.
        logging.getLogger("can").addHandler(logging.NullHandler())
        try:
            self._open()
        except RunError as error:
            if not patient:
                raise
            self.problem = error.problems[0]

    def receive(self, timeout_s: float) -> list[CanFrame]:
        """Return the received frames, oldest first. Never raises.

        Waits at most ``timeout_s`` for the first frame.
        """
        end = time.monotonic() + timeout_s
        while True:
            now = time.monotonic()
            if now >= self._check_at:
                self._check_at = now + RETRY_S
                self._check()
            frames = self._take()
            if frames:
                return frames
            now = time.monotonic()
            if now >= end:
                return []
            self._wait(min(end, max(now, self._check_at)) - now)

    def close(self) -> None:
        """Close the interface. A second call changes nothing."""
        if self._port is not None:
            self._port.close()
            self._port = None

    def _open(self) -> None:
        port = open_can(self._config)
        try:
            port.set_receive_ids(self._keys)
        except BaseException:
            port.close()
            raise
        self._port = port
        self.problem = ""

    def _check(self) -> None:
        """Update ``problem``, and open the interface again if it was lost."""
        config = self._config
        is_socketcan = config.interface == "socketcan"
        has_fault = is_socketcan and fault_of(config.channel) != 0
        if self._port is not None and (has_fault or self._port.is_gone):
            self.close()
        if self._port is None:
            try:
                self._open()
            except UserError as error:
                self.problem = error.problems[0]
        else:
            self.problem = ""
            if is_socketcan and self._port.state is CanState.BUS_OFF:
                command = restart(config.channel, "type can restart-ms 100")
                self.problem = _BUS_OFF.format(name=config.channel, command=command)

    def _take(self) -> list[CanFrame]:
        if self._port is None:
            return []
        frames = [frame for frame, _ in self._port.receive(_MAX_AT_ONCE)]
        if self._port.is_gone:
            self.close()
            self.problem = f"CAN interface {self._config.channel}: was lost. Trying again."
        elif frames:
            self.problem = ""
            if self._port.state in (CanState.BUS_OFF, CanState.DOWN):
                # A received frame proves that the interface works again.
                self._port.state = CanState.ERROR_ACTIVE
        return frames

    def _wait(self, seconds: float) -> None:
        fd = None if self._port is None else self._port.fileno()
        if fd is None:
            time.sleep(max(0.0, seconds))
            return
        poll = select.poll()
        poll.register(fd, select.POLLIN)
        poll.poll(max(0.0, seconds) * 1000)
