"""Opens and closes a python-can interface in a thread: a driver may take seconds (slcan sleeps for two), and the loop must not wait.

``_work`` runs in the worker's thread, everything else in the loop's. They share the results, and ``_is_closed``, which only the loop
writes.
"""

import contextlib
from collections.abc import Callable

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.runtime.can.can_port import CanPort
from kontronik_can_gw.runtime.can.open_can import open_can
from kontronik_can_gw.runtime.system.worker import Handover, Worker

_AT_ONCE = ("socketcan", "virtual")
"""Interfaces that wait for nothing when they are opened: SocketCAN, and python-can's bus within the process."""
_END_S = 0.15
"""How long ``close`` waits for a driver that opens or closes: the process must end within 0.3 s."""
_NO_THREAD = "CAN {0.interface} {0.channel}: the system gives no thread to open it."


class CanOpener:
    """Opens and closes the interface of a gateway. ``esc_at`` names the ESC that a path leads to: it is never opened.

    1. ``open`` returns an open port, or None if the interface is being opened by the thread. Then ``fileno`` becomes readable when that
       is done, and ``take`` returns the result.
    2. ``close_port`` closes a port. The thread closes and opens in the order of the calls.
    3. After ``close`` a port that is still being opened is closed as soon as it is open, and ``close_port`` closes at once.
    """

    def __init__(
        self, config: CanConfig, esc_at: Callable[[str], str | None] = lambda _path: None
    ) -> None:
        self._config = config
        self._esc_at = esc_at
        self._results: Handover[CanPort | RunError] = Handover()
        self._worker: Worker[CanPort | None] = Worker("can-opener", self._work)
        self._is_at_once = config.interface in _AT_ONCE
        self._is_closed = False

    def fileno(self) -> int:
        return self._results.fileno()

    def open(self) -> CanPort | None:
        """Open the interface, or start to. RunError if it cannot be opened, as far as that is known at once."""
        config = self._config
        if (esc := self._esc_at(config.channel)) is not None:  # whatever its name is now
            raise RunError(
                f"can.channel {config.channel} is the port of {esc}: nothing may be sent to an ESC."
            )
        if self._is_at_once:
            try:
                return open_can(config)
            except OSError as error:  # it went away a moment ago
                reason = error.strerror or error
                raise RunError(f"CAN interface {config.channel}: {reason}.") from None
        if not (self._worker.start() and self._worker.put(None)):
            raise RunError(_NO_THREAD.format(config))
        return None

    def close_port(self, port: CanPort) -> None:
        """Close a port; a driver's without waiting for it."""
        if self._is_at_once or not self._worker.put(port):
            port.close()

    def take(self) -> CanPort | RunError | None:
        """The result of ``open``: a port, or the reason why there is none. None if it is not known yet."""
        found = self._results.take(1)
        return found[0] if found else None

    def close(self) -> None:
        """End the thread. A driver that takes longer is left alone."""
        self._is_closed = True
        self._worker.stop(_END_S)
        for left in self._results.take():
            _discard(left)
        self._results.close()

    def _work(self, items: list[CanPort | None]) -> None:
        for port in items:
            if port is not None:
                with contextlib.suppress(Exception):  # whatever a driver raises: the next is served
                    port.close()
            elif not self._is_closed:
                result = self._open()
                if self._is_closed:
                    _discard(result)
                else:
                    self._results.put(result)

    def _open(self) -> CanPort | RunError:
        config = self._config
        try:
            return open_can(config)
        except RunError as error:
            return error
        except Exception as error:  # whatever a driver raises: the loop tries again
            return RunError(f"CAN {config.interface} {config.channel}: cannot be opened: {error}")


def _discard(result: CanPort | RunError) -> None:
    if isinstance(result, CanPort):
        result.close()
