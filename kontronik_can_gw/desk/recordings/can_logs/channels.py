"""Channels of a log in another format: numbers from 1, or names as candump has them."""

import re

_LARGEST = 255
"""Largest number that every format can hold."""
_number_in = re.compile(r"(\d{1,3})$").search


class Channels:
    """Gives each channel a number or a name of its own, in the order in which they appear.

    can0 is 1, and the reverse. A number that is taken, or that the format cannot hold, is replaced
    by the lowest free one. ``own``: name of the gateway's own bus, which is number 1.
    """

    def __init__(self, own: str) -> None:
        self._own = own
        self._numbers: dict[str, int] = {}
        self._names: dict[str, str] = {}

    def number_of(self, channel: str) -> int:
        """The channel's number in formats that have numbers."""
        if channel not in self._numbers:
            taken = set(self._numbers.values())
            wanted = _natural_number(channel)
            if wanted in taken or not 1 <= wanted <= _LARGEST:
                wanted = next(n for n in range(1, len(taken) + 2) if n not in taken)
            self._numbers[channel] = wanted
        return self._numbers[channel]

    def name_of(self, channel: str) -> str:
        """The channel's name in formats that have names."""
        if channel not in self._names:
            name = channel or self._own
            if channel.isdigit():
                name = f"can{self.number_of(channel) - 1}"
            taken = set(self._names.values())
            if name in taken:
                name = next(f"can{n}" for n in range(len(taken) + 1) if f"can{n}" not in taken)
            self._names[channel] = name
        return self._names[channel]

    @property
    def changes(self) -> str:
        """The channels whose names changed, as "can0 is 1, can1 is 2"; empty for can0 alone."""
        given = self._names or self._numbers
        changed = {old: new for old, new in given.items() if old and old != str(new)}
        if [*changed] in (["can0"], ["1"]):
            return ""
        return ", ".join(f"{old} is {new}" for old, new in changed.items())


def _natural_number(channel: str) -> int:
    if not channel:
        return 1
    if channel.isdigit():
        return int(channel)
    found = _number_in(channel)
    return int(found[1]) + 1 if found else 0
