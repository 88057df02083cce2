"""One entry and one object of an EDS, after its checks."""

from dataclasses import dataclass

from kontronik_can_gw.canopen.data_types import ARRAY, RECORD
from kontronik_can_gw.canopen.eds_sections import spelling


@dataclass(frozen=True, slots=True)
class Entry:
    """One entry of the object dictionary, as the EDS describes it.

    ``access`` is ro, wo, rw, rwr, rww or const. ``default`` is an int, a float, or bytes for texts and domains; with ``relative`` the
    node-ID is still to be added to it.
    """

    index: int
    sub: int
    name: str
    data_type: int
    access: str
    mappable: bool
    low: int | None
    high: int | None
    default: int | float | bytes | None
    relative: bool


@dataclass
class EdsObject:
    """An object after its checks; its entries by sub-index."""

    index: int
    kind: int
    name: str
    subs: dict[int, Entry]

    def section(self, sub: int) -> str:
        """Where an entry is described."""
        return spelling(self.index, sub if self.kind in (ARRAY, RECORD) else None)
