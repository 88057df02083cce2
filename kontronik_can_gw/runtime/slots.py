"""Transmit slots: one for each CAN id (and multiplexer page), the newest value wins, nothing piles up."""

from collections.abc import Callable

from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.runtime.can_port import Sent


class Slots:
    """Frames that wait to be sent, in the order in which their ids began to wait."""

    def __init__(self) -> None:
        self._frames: dict[tuple[int, bool, int], CanFrame] = {}
        self.replaced = 0
        """Frames that were overtaken by a newer one of their id."""

    def __len__(self) -> int:
        return len(self._frames)

    def put(self, frame: CanFrame) -> None:
        """Let a frame wait, in place of an older one of its id."""
        key = (frame.can_id, frame.extended, frame.page)
        if key in self._frames:
            self.replaced += 1
        self._frames[key] = frame

    def flush(self, send: Callable[[CanFrame], Sent]) -> tuple[int, Sent]:
        """Send until nothing waits or the interface does not take more. Returns how many went and the last answer."""
        count = 0
        for key in list(self._frames):
            answer = send(self._frames[key])
            if answer is not Sent.OK:
                return count, answer
            del self._frames[key]
            count += 1
        return count, Sent.OK

    def clear(self) -> None:
        """Drop what waits: it is old by the time it could go."""
        self.replaced += len(self._frames)
        self._frames.clear()
