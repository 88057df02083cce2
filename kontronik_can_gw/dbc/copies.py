"""A message of a DBC as it is sent.

It is unchanged, or a copy for one of several ESCs, with the ESC's name as prefix and another id.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from kontronik_can_gw.frames import EXTENDED

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal


@dataclass(frozen=True)
class Copy:
    """A message with its id and names on the bus. All other data are in the file's message."""

    message: "Message"
    distance: int = 0
    """Added to the id of the file."""
    esc: int | None = None
    """Index of the ESC whose name it has. None for a message that is sent once."""
    prefix: str = ""

    @property
    def name(self) -> str:
        """The message's name on the bus. The prefix replaces a leading ``Esc``."""
        old = self.message.name
        stem = old.removeprefix("Esc")
        if self.prefix and stem[:1].isupper():
            return self.prefix + stem
        return self.prefix + old

    @property
    def frame_id(self) -> int:
        return self.message.frame_id + self.distance

    @property
    def key(self) -> int:
        """The id, with EXTENDED for 29 bits."""
        return self.frame_id | (EXTENDED if self.message.is_extended_frame else 0)

    def signals(self) -> Iterator[tuple["Signal", str]]:
        """Return the signals of the file and their names on the bus."""
        return ((signal, self.prefix + signal.name) for signal in self.message.signals)

    def bind_keys(self, signal: str) -> tuple[str, ...]:
        """Return the keys that a signal of the file may have in ``[dbc.bind]``.

        Names on the bus precede names in the file.
        """
        sent = self.prefix + signal
        return f"{self.name}.{sent}", sent, f"{self.message.name}.{signal}", signal
