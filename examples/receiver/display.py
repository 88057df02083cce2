"""The receiver under test: a display that shows a value while it is fresh, and dashes otherwise.

Replace it by your own receiver.
"""

import time

import can
import cantools.database

STALE_S = 0.5


class Display:
    """The newest value of each signal on a bus, decoded with the gateway's DBC."""

    def __init__(self, channel: str, dbc: str) -> None:
        self._database = cantools.database.load_file(dbc)
        self._bus = can.Bus(interface="socketcan", channel=channel)
        self._seen: dict[str, tuple[object, float]] = {}

    def shown(self, signal: str) -> object:
        """Return a value in the DBC's unit, or a text of its value table.

        None: the value is not available, or no frame with it arrived for 0.5 s.
        """
        self._receive()
        value, seen_s = self._seen.get(signal, (None, 0.0))
        if str(value) in ("NotAvailable", "Error") or time.monotonic() - seen_s > STALE_S:
            return None
        return value

    def close(self) -> None:
        self._bus.shutdown()

    def _receive(self) -> None:
        try:
            while (frame := self._bus.recv(timeout=0)) is not None:
                try:
                    message = self._database.get_message_by_frame_id(frame.arbitration_id)
                except KeyError:
                    continue  # a frame of another device
                for name, value in message.decode(frame.data).items():
                    self._seen[name] = (value, time.monotonic())
        except can.CanError:
            return  # The interface is down. The socket works again when it is up.
