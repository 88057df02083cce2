"""A network without threads for masters of the canopen package. Answers arrive immediately."""

from collections.abc import Callable, Iterable

import canopen
from dialogue import Bench

Exchange = Callable[[int, bytes, bool], Iterable[tuple[int, bytes]]]


class Wire(canopen.Network):
    """A network whose other end is the function ``exchange``.

    ``exchange`` gets COB-ID, data and the remote flag of a frame. It returns COB-ID and data of
    each answer.
    """

    def __init__(self, exchange: Exchange) -> None:
        super().__init__()
        self._exchange = exchange

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        for cob_id, answer in self._exchange(can_id, bytes(data), remote):
            self.notify(cob_id, bytearray(answer), 0.0)


def wire_to(bench: Bench) -> Wire:
    """Return a network with all nodes of a bench."""

    def exchange(
        cob_id: int,
        data: bytes,
        remote: bool,
    ) -> list[tuple[int, bytes]]:
        bench.put(cob_id, data, remote=remote)
        bench.answer_saves()
        return [(frame.can_id, frame.data) for frame in bench.take()]

    return Wire(exchange)
