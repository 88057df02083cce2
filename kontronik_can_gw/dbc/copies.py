"""A message of the file as it is sent: as it stands, or for one of several ESCs with its name in front and another id."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from kontronik_can_gw.frames import EXTENDED

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal


@dataclass(frozen=True)
class Copy:
    """A message under its id and names on the bus. It shares all else with the file's."""

    message: "Message"
    distance: int = 0
    """Added to the id."""
    esc: int | None = None
    """Index of the ESC whose name it has; None for a message that is sent once."""
    prefix: str = ""

    @property
    def name(self) -> str:
        """The prefix takes the place of a leading ``Esc``."""
        old = self.message.name
        stem = old.removeprefix("Esc")
        return self.prefix + (stem if self.prefix and stem[:1].isupper() else old)

    @property
    def frame_id(self) -> int:
        return self.message.frame_id + self.distance

    @property
    def key(self) -> int:
        """The id, with EXTENDED for 29 bits."""
        return self.frame_id | (EXTENDED if self.message.is_extended_frame else 0)

    def signals(self) -> Iterator[tuple["Signal", str]]:
        """Signals of the file and their names on the bus."""
        return ((signal, self.prefix + signal.name) for signal in self.message.signals)

    def bind_keys(self, signal: str) -> tuple[str, ...]:
        """What may name a signal of the file in ``[dbc.bind]``: names on the bus come before those in the file."""
        sent = self.prefix + signal
        return f"{self.name}.{sent}", sent, f"{self.message.name}.{signal}", signal
