"""A participant of the CAN bus that only listens: it never sends, claims nothing, and comes back by itself.

It has an interface of its own beside whatever else uses it (a gateway, for one), with receive filters for the ids that were asked for.
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
"""How often an interface that does not work is tried again, and one that works is checked."""
_MAX_AT_ONCE = 4096
_BUS_OFF = "CAN interface {name}: is bus-off: look at bit rate, wiring and termination. Start it again: {command}"


class BusListener:
    """An open interface, received from only.

    ``keys``: ids, with EXTENDED for 29 bits. Raises RunError where the interface cannot be opened now, unless ``patient``, UserError where
    python-can does not know it; later troubles only show in ``problem``. There is no ``fileno``: the descriptor changes with each opening.
    """

    def __init__(self, config: CanConfig, keys: frozenset[int], patient: bool = False) -> None:
        self.problem = ""
        """One line with the remedy while the interface does not work; empty while it does."""
        self.lost_frames = 0
        """How often frames were lost because they came faster than they were read."""
        self._config = config
        self._keys = keys
        self._port: CanPort | None = None
        self._check_at = 0.0
        # what python-can says of an interface that went away is said by ``problem``, with the remedy
        logging.getLogger("can").addHandler(logging.NullHandler())
        try:
            self._open()
        except RunError as error:
            if not patient:
                raise
            self.problem = error.problems[0]

    def receive(self, timeout_s: float) -> list[CanFrame]:
        """The frames that have come, oldest first; waits for the first one, at most ``timeout_s``. Never raises."""
        end = time.monotonic() + timeout_s
        while True:
            now = time.monotonic()
            if now >= self._check_at:
                self._check_at = now + RETRY_S
                self._check()
            if frames := self._take():
                return frames
            now = time.monotonic()
            if now >= end:
                return []
            self._wait(min(end, max(now, self._check_at)) - now)

    def close(self) -> None:
        """May be called again."""
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
        """Whether the interface works; open it anew where it does not."""
        config = self._config
        fault = fault_of(config.channel) if config.interface == "socketcan" else 0
        if self._port is not None and (fault or self._port.gone):
            self.close()
        if self._port is None:
            try:
                self._open()
            except UserError as error:
                self.problem = error.problems[0]
        else:
            is_off = self._port.state is CanState.BUS_OFF and config.interface == "socketcan"
            self.problem = ""
            if is_off:
                command = restart(config.channel, "type can restart-ms 100")
                self.problem = _BUS_OFF.format(name=config.channel, command=command)

    def _take(self) -> list[CanFrame]:
        if self._port is None:
            return []
        frames = [frame for frame, _ in self._port.receive(_MAX_AT_ONCE)]
        self.lost_frames += self._port.overruns
        self._port.overruns = 0
        if self._port.gone:
            self.close()
            self.problem = f"CAN interface {self._config.channel}: went away. Trying again."
        elif frames:
            self.problem = ""
            if self._port.state in (CanState.BUS_OFF, CanState.DOWN):
                self._port.state = CanState.ERROR_ACTIVE  # what comes says that it works again
        return frames

    def _wait(self, seconds: float) -> None:
        fd = None if self._port is None else self._port.fileno()
        if fd is None:
            time.sleep(max(0.0, seconds))
            return
        poll = select.poll()
        poll.register(fd, select.POLLIN)
        poll.poll(max(0.0, seconds) * 1000)
