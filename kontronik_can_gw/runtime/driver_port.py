"""A CAN interface of python-can's drivers, received from by a thread (bus_reader.py)."""

import contextlib
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from kontronik_can_gw.frames import EXTENDED, CanFrame
from kontronik_can_gw.gateway_status import CanState
from kontronik_can_gw.runtime.bus_reader import QUEUE_LENGTH, BusReader
from kontronik_can_gw.runtime.can_port import (
    MAX_EXTENDED_ID,
    MAX_STANDARD_ID,
    CanPort,
    Received,
)
from kontronik_can_gw.transmit_queue import Sent

if TYPE_CHECKING:
    import can


class DriverPort(CanPort):
    """A bus of python-can. A thread reads it as soon as there is an id to receive."""

    reports_full = False

    def __init__(self, bus: "can.BusABC") -> None:
        super().__init__()
        self._bus = bus
        self._reader: BusReader | None = None

    def fileno(self) -> int | None:
        return None if self._reader is None else self._reader.fileno()

    def discard(self) -> None:
        self._receive(QUEUE_LENGTH)
        self._known_drops = self._drops()

    def close(self) -> None:
        if self._reader is not None:
            self._reader.close()  # before the driver is shut down: few of them bear both at once
        with contextlib.suppress(Exception):
            # an interface that is gone may fail in its own ways; nothing is left to do
            self._bus.shutdown()

    def _filter(self) -> None:
        if self._reader is None and not self._ids:
            return
        self._filter_bus()
        if self._reader is None:
            self._reader = BusReader(self._bus, self._ids)
        self._reader.ids = self._ids

    def _filter_bus(self) -> None:
        """Ask the driver for our ids; one that cannot filter is left to the thread."""
        filters: can.typechecking.CanFilters = [
            {"can_id": each & ~EXTENDED, "can_mask": MAX_EXTENDED_ID, "extended": True}
            if each & EXTENDED
            else {"can_id": each, "can_mask": MAX_STANDARD_ID, "extended": False}
            for each in sorted(self._ids)
        ]
        for wanted in (filters, None):
            with contextlib.suppress(Exception):  # each driver fails in its own way
                self._bus.set_filters(wanted)
                return
        self.gone = True

    def _receive(self, limit: int) -> Received:
        if self._reader is None:
            return []
        frames: Received = [*self._reader.take(limit)]
        self.drained = len(frames) < limit
        if self._has_failed():
            self.state = CanState.DOWN
        self._note_drops()
        return frames

    def _has_failed(self) -> bool:
        self.gone = self.gone or (self._reader is not None and self._reader.failed)
        return self.gone

    def _drops(self) -> int:
        return 0 if self._reader is None else self._reader.dropped

    def _send_each(
        self, frames: Sequence[CanFrame], clock: Callable[[], int], latest: int
    ) -> tuple[int, Sent]:
        if self._has_failed():
            return 0, Sent.GONE
        for count, frame in enumerate(frames):
            if clock() > latest:
                return count, Sent.LATE
            answer = self._send_message(frame)
            if answer is not Sent.OK:
                return count, answer
        return len(frames), Sent.OK

    def _send_message(self, frame: CanFrame) -> Sent:
        import can

        message = can.Message(
            arbitration_id=frame.can_id,
            data=frame.data,
            is_extended_id=frame.extended,
            is_remote_frame=frame.remote,
            is_fd=frame.fd,
            bitrate_switch=frame.fd,
        )
        try:
            self._bus.send(message, timeout=0)
        except can.CanError:
            return Sent.BUSY
        except Exception:
            # what a driver lets out when its adapter has gone: OSError, termios.error ...
            return Sent.GONE
        return Sent.OK
