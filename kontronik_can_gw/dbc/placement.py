"""Where signals lie in a message: their bits, and those that overlap."""

from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING

from kontronik_can_gw.signals.plan import Piece

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal


def _bits(signal: "Signal") -> list[int]:
    """The signal's bits from its least significant one, each as byte * 8 + bit in byte."""
    if signal.byte_order == "little_endian":
        return list(range(signal.start, signal.start + signal.length))
    # big-endian: start is the most significant bit, downward within a byte, then the next byte
    bits, at = [], signal.start
    for _ in range(signal.length):
        bits.append(at)
        at = at + 15 if at % 8 == 0 else at - 1
    return bits[::-1]


def pieces(signal: "Signal") -> tuple[Piece, ...]:
    """The signal as runs of adjacent bits."""
    found: list[Piece] = []
    for shift, at in enumerate(_bits(signal)):
        last = found[-1] if found else None
        if last and at == last.at + last.width:
            found[-1] = last._replace(width=last.width + 1)
        else:
            found.append(Piece(shift, 1, at))
    return tuple(found)


def placement_problems(message: "Message", where: str) -> Iterator[str]:
    """Signals outside the message, and signals that overlap on a page."""
    room = message.length * 8
    used: Counter[int | None] = Counter()
    """Bit mask of the used bits, for each page."""
    placed: list[tuple[str, int, set[int | None]]] = []
    every = {None, *(page for s in message.signals for page in s.multiplexer_ids or ())}
    for signal in message.signals:
        mask = sum(1 << bit for bit in _bits(signal)) if signal.length <= room else 1 << room
        if mask.bit_length() > room:
            yield (
                f"{where}.{signal.name}: lies outside the message's {message.length} bytes. "
                "Move or shorten it."
            )
            continue
        pages: set[int | None] = set(signal.multiplexer_ids or every)
        left = mask if any(used[page] & mask for page in pages) else 0
        for other, others_mask, others_pages in placed if left else ():
            if others_mask & left and others_pages & pages and other != signal.name:
                yield f"{where}.{signal.name}: overlaps {other}. Move one of them."
                left &= ~others_mask
        for page in pages:
            used[page] |= mask
        placed.append((signal.name, mask, pages))
