"""The receiver under test: a display that shows a value while it is fresh, and dashes otherwise. Put your own in its place."""

import time

import can
import cantools.database

STALE_S = 0.5


class Display:
    """The newest value of each signal on a bus, by the gateway's DBC."""

    def __init__(self, channel: str, dbc: str) -> None:
        self._database = cantools.database.load_file(dbc)
        self._bus = can.Bus(interface="socketcan", channel=channel)
        self._seen: dict[str, tuple[object, float]] = {}

    def shown(self, signal: str) -> object:
        """Value in the DBC's unit or text of its table; None where it is not available, or no frame of it came for 0.5 s."""
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
                    continue  # of somebody else
                for name, value in message.decode(frame.data).items():
                    self._seen[name] = value, time.monotonic()
        except can.CanError:
            return  # the interface is down; the socket is good again when it is up
