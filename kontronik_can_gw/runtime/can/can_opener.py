"""Opens and closes a python-can interface in a thread.

A driver may take seconds (slcan sleeps for two), and the loop must not wait for it. ``_work`` runs
in the worker's thread, everything else in the loop's thread. The threads share the results, and
``_is_closed``, which only the loop writes.
"""

import contextlib
from collections.abc import Callable

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.runtime.can.can_port import CanPort
from kontronik_can_gw.runtime.can.open_can import open_can
from kontronik_can_gw.runtime.system.worker import Handover, Worker

_AT_ONCE = ("socketcan", "virtual")
"""Interfaces that open without delay: SocketCAN, and python-can's bus within the process."""
_END_S = 0.15
"""Longest time that ``close`` waits for a driver. The process must end within 0.3 s."""
_NO_THREAD = (
    "CAN {0.interface} {0.channel}: cannot be opened, because the system cannot start a thread."
)


class CanOpener:
    """Opens and closes the interface of a gateway.

    ``esc_at`` returns the name of the ESC to which a path leads, or None. The port of an ESC is
    never opened.

    1. ``open`` returns an open port, or None if the thread opens the interface. In this case
       ``fileno`` becomes readable when the thread is ready, and ``take`` returns the result.
    2. ``close_port`` closes a port. The thread closes and opens in the order of the calls.
    3. After ``close``, a port that is still being opened is closed as soon as it is open, and
       ``close_port`` closes at once.
    """

    def __init__(self, config: CanConfig, esc_at: Callable[[str], str | None]) -> None:
        self._config = config
        self._esc_at = esc_at
        self._results: Handover[CanPort | RunError] = Handover()
        self._worker: Worker[CanPort | None] = Worker("can-opener", self._work)
        self._is_at_once = config.interface in _AT_ONCE
        self._is_closed = False

    def fileno(self) -> int:
        return self._results.fileno()

    def open(self) -> CanPort | None:
        """Return the open interface, or let the thread open it and return None.

        Raises RunError if it is known at once that the interface cannot be opened.
        """
        config = self._config
        esc = self._esc_at(config.channel)
        if esc is not None:
            raise RunError(
                f"can.channel: {config.channel} is the port of {esc}, and nothing may be sent to "
                "an ESC. Name a CAN interface."
            )
        if self._is_at_once:
            try:
                return open_can(config)
            except OSError as error:  # the interface was removed since it was checked
                reason = error.strerror or error
                raise RunError(f"CAN interface {config.channel}: {reason}.") from None
        if not (self._worker.start() and self._worker.put(None)):
            raise RunError(_NO_THREAD.format(config))
        return None

    def close_port(self, port: CanPort) -> None:
        """Close a port. Does not wait for a driver of python-can."""
        if self._is_at_once or not self._worker.put(port):
            port.close()

    def take(self) -> CanPort | RunError | None:
        """Return the result of ``open``: a port, or the reason of the failure.

        None if the thread is not ready yet.
        """
        found = self._results.take(1)
        return found[0] if found else None

    def close(self) -> None:
        """End the thread. Waits at most _END_S for a slow driver, which then ends later."""
        self._is_closed = True
        self._worker.stop(_END_S)
        for left in self._results.take():
            _discard(left)
        self._results.close()

    def _work(self, items: list[CanPort | None]) -> None:
        for port in items:
            if port is not None:
                with contextlib.suppress(Exception):  # drivers raise exceptions of any kind
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
        except Exception as error:  # drivers raise exceptions of any kind; the loop tries again
            return RunError(f"CAN {config.interface} {config.channel}: cannot be opened: {error}")


def _discard(result: CanPort | RunError) -> None:
    if isinstance(result, CanPort):
        result.close()
