"""A network for masters of the canopen package, without threads: the answers are there when a request has been sent."""

from collections.abc import Callable, Iterable

import canopen
from dialogue import Bench

Exchange = Callable[[int, bytes, bool], Iterable[tuple[int, bytes]]]


class Wire(canopen.Network):
    """``exchange``: what the other end says to a frame (COB-ID, data, remote), each with its COB-ID."""

    def __init__(self, exchange: Exchange) -> None:
        super().__init__()
        self._exchange = exchange

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        for cob_id, answer in self._exchange(can_id, bytes(data), remote):
            self.notify(cob_id, bytearray(answer), 0.0)


def wire_to(bench: Bench) -> Wire:
    """A network on which all nodes of a bench are."""

    def exchange(cob_id: int, data: bytes, remote: bool) -> list[tuple[int, bytes]]:
        bench.put(cob_id, data, remote=remote)
        bench.answer_saves()
        return [(frame.can_id, frame.data) for frame in bench.take()]

    return Wire(exchange)
