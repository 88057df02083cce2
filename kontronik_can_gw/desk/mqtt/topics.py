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
    """The topics of one gateway. ``esc`` None: the gateway's own."""

    prefix: str
    gateway: str

    @property
    def base(self) -> str:
        return f"{self.prefix}/{self.gateway}"

    @property
    def online(self) -> str:
        return f"{self.base}/online"

    def available(self, esc: str | None) -> str:
        return f"{self.base}/available" if esc is None else f"{self.base}/{esc}/available"

    def state(self, esc: str | None) -> str:
        return f"{self.base}/state" if esc is None else f"{self.base}/{esc}/state"

    def discovery(self, prefix: str, esc: str | None) -> str:
        return f"{prefix}/device/{self.identifier(esc)}/config"

    def identifier(self, esc: str | None) -> str:
        """Home Assistant's identifier of a device, constant as long as gateway and ESC keep their names."""
        return f"kontronik_{self.gateway}" if esc is None else f"kontronik_{self.gateway}_{esc}"
