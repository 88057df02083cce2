"""A network for masters of the canopen package, without threads: the answers are there when a request has been sent."""

from collections.abc import Callable, Iterable

import canopen

Exchange = Callable[[int, bytes, bool], Iterable[tuple[int, bytes]]]


class Wire(canopen.Network):
    """``exchange``: what the other end says to a frame (COB-ID, data, remote), each with its COB-ID."""

    def __init__(self, exchange: Exchange) -> None:
        super().__init__()
        self._exchange = exchange

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        for cob_id, answer in self._exchange(can_id, bytes(data), remote):
            self.notify(cob_id, bytearray(answer), 0.0)
