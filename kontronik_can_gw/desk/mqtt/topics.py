"""The topics of one gateway."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Topics:
    """The topics of one gateway. An empty ``esc`` stands for the gateway itself."""

    prefix: str
    gateway: str

    def of(self, *levels: str) -> str:
        """Return a topic of this gateway. Empty levels are left out."""
        path = (self.prefix, self.gateway, *levels)
        return "/".join(filter(None, path))

    def discovery(self, prefix: str, esc: str = "") -> str:
        """Return the topic of a device's discovery below Home Assistant's ``prefix``."""
        return f"{prefix}/device/{self.identifier(esc)}/config"

    def identifier(self, esc: str = "") -> str:
        """Return Home Assistant's identifier of a device. It depends on the two names only."""
        words = ("kontronik", self.gateway, esc)
        return "_".join(filter(None, words))
