"""The topics and messages that MQTT has from us; messages.py says what each topic holds."""

from dataclasses import dataclass
from typing import NamedTuple

ONLINE, OFFLINE = b"online", b"offline"


class Message(NamedTuple):
    """A message to publish. ``lasting``: retained, and published again after each reconnection."""

    topic: str
    payload: bytes
    lasting: bool = False
    retain: bool = False


@dataclass(frozen=True)
class Topics:
    """The topics of one gateway. ``esc`` empty: the gateway's own."""

    prefix: str
    gateway: str

    @property
    def base(self) -> str:
        return f"{self.prefix}/{self.gateway}"

    @property
    def online(self) -> str:
        return f"{self.base}/online"

    def available(self, esc: str = "") -> str:
        return f"{self.base}/{esc}/available" if esc else f"{self.base}/available"

    def state(self, esc: str = "") -> str:
        return f"{self.base}/{esc}/state" if esc else f"{self.base}/state"

    def discovery(self, prefix: str, esc: str = "") -> str:
        return f"{prefix}/device/{self.identifier(esc)}/config"

    def identifier(self, esc: str = "") -> str:
        """Home Assistant's identifier of a device, constant as long as gateway and ESC keep their names."""
        return f"kontronik_{self.gateway}_{esc}" if esc else f"kontronik_{self.gateway}"
