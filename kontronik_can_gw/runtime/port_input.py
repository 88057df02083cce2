"""Notes about reading one port, and a check that the loop does read it."""

from typing import Protocol

from kontronik_can_gw.times import NEVER


class PortInput:
    """Notes that are made while a port is read.

    The loop in C has a structure with the same attributes (``native/turns.py``).
    """

    def __init__(self) -> None:
        self.empty_ns = 0
        """A time at which the port was empty."""
        self.undrained_ns = NEVER
        """If the last read left bytes in the port, a time before these arrived. Otherwise NEVER."""
        self.is_plain = False
        """True if a readable port only has to be read."""
        self.is_served = True
        """True if the port was read since this was set to False."""
        self.settings = bytearray()
        """The settings of the port."""
        self.is_restored = False
        """True if C has restored the settings since this was set to False."""


class WaitingPort(Protocol):
    """A port that can be asked whether something waits in it."""

    @property
    def waits_to_be_read(self) -> bool:
        """True if there is something to read."""


class StuckCheck:
    """Checks that a port is served."""

    def __init__(self, noted: PortInput) -> None:
        self._noted = noted
        noted.is_served = True
        self._has_waited = False

    def is_stuck(self, port: WaitingPort | None) -> bool:
        """Return True if bytes waited at this call and the last one, and none was read."""
        waits = port is not None and not self._noted.is_served and port.waits_to_be_read
        is_stuck = waits and self._has_waited
        self._noted.is_served = False
        self._has_waited = waits
        return is_stuck
