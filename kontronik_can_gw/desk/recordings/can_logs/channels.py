"""Converts the channels of a log for another format: numbers from 1, or names as in candump."""

import re

_LARGEST = 255
"""Largest number that is possible in every format."""
_number_in = re.compile(r"(\d{1,3})$").search


class Channels:
    """Gives each channel a distinct number or name, in the order in which channels appear.

    can0 becomes 1, and 1 becomes can0. A number that is taken, or too large for the format, is
    replaced by the lowest free number. ``own`` is the name of the gateway's own bus, whose number
    is 1.
    """

    def __init__(self, own: str) -> None:
        self._own = own
        self._numbers: dict[str, int] = {}
        """The given numbers by channel."""
        self._names: dict[str, str] = {}
        """The given names by channel."""

    def number_of(self, channel: str) -> int:
        """Return the channel's number, for formats with numbers."""
        if channel not in self._numbers:
            taken = self._numbers.values()
            number = _natural_number(channel)
            if number in taken or not 1 <= number <= _LARGEST:
                number = 1
                while number in taken:
                    number += 1
            self._numbers[channel] = number
        return self._numbers[channel]

    def name_of(self, channel: str) -> str:
        """Return the channel's name, for formats with names."""
        if channel not in self._names:
            name = channel or self._own
            if channel.isdigit():
                name = f"can{self.number_of(channel) - 1}"
            taken = self._names.values()
            if name in taken:
                number = 0
                while f"can{number}" in taken:
                    number += 1
                name = f"can{number}"
            self._names[channel] = name
        return self._names[channel]

    @property
    def changes(self) -> str:
        """The changed channels, for example "can0 is 1, can1 is 2". Empty for can0 alone."""
        given = self._names or self._numbers
        changed = {old: new for old, new in given.items() if old and old != str(new)}
        if list(changed) in (["can0"], ["1"]):
            return ""
        return ", ".join(f"{old} is {new}" for old, new in changed.items())


def _natural_number(channel: str) -> int:
    if not channel:
        return 1
    if channel.isdigit():
        return int(channel)
    found = _number_in(channel)
    if found is None:
        return 0
    return int(found[1]) + 1
