"""The values of an ESC, or of the gateway itself, as CAN frames show them. No I/O, no clock.

Values have the names of values.py, not of signals, so that any DBC works. A value that is not
available is None, never an old value.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

from kontronik_can_gw.desk.receiver.unpacker import Value
from kontronik_can_gw.desk.receiver.view import View
from kontronik_can_gw.esc.decoder import ErrorBit, Severity
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import EscSettings, LinkState
from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.esc.values import VALUES, Group
from kontronik_can_gw.signals import units

_WORDS = {"operating_errors": Group.LIVE, "selftest_errors": Group.INFO}
"""The error words, and the group in which each is available."""


class Flag(NamedTuple):
    """An alarm that is not an ErrorBit but has the same attributes."""

    text: str
    severity: Severity
    meaning: str
    remedy: str = ""
    is_summary: bool = False
    is_normal: bool = False


Alarm = ErrorBit | Flag


def alarms_of(flags: Iterable[Alarm]) -> list[Alarm]:
    """Return the alarms to show, errors first.

    Normal bits are left out, and summaries of other alarms in the result.
    """
    faults = [flag for flag in flags if not flag.is_normal]
    explained = {flag.severity for flag in faults if not flag.is_summary}
    found = []
    for severity in Severity:
        for flag in faults:
            is_redundant = flag.is_summary and severity in explained
            if flag.severity is severity and not is_redundant:
                found.append(flag)
    return found


class Member:
    """An ESC, or the gateway, for which ``settings`` and ``index`` are None."""

    def __init__(self, view: View, settings: EscSettings | None, index: int | None) -> None:
        self.view = view
        self.index = index
        self.name = ""
        protocol = None
        if settings is not None:
            self.name = settings.name
            protocol = settings.protocol
        self.protocol = protocol_named(protocol)
        self.columns: dict[str, int] = {}
        """Index of the first column in the layout of each value by name."""
        for at, column in enumerate(view.reader.columns):
            if column.esc == index:
                self.columns.setdefault(column.source, at)
        self.no_flags: dict[str, int] = {}
        """The columns of the values that are not flags."""
        self.of_group: dict[Group, list[int]] = {group: [] for group in Group}
        """The columns in ``no_flags`` of each group."""
        for name, at in self.columns.items():
            if name not in self.protocol.bits:
                self.no_flags[name] = at
                self.of_group[VALUES[name].group].append(at)
        self.factors = self._conversions()
        """Factor and offset of values whose signal has another unit than their source."""

    def _conversions(self) -> dict[str, tuple[float, float]]:
        factors = {}
        for name, at in self.columns.items():
            unit = VALUES[name].unit
            sent_unit = self.view.reader.columns[at].unit or unit
            conversion = units.conversion(sent_unit, unit)
            if conversion is None:
                continue
            factor, offset = conversion
            if factor != 1 or offset != 0:
                factors[name] = float(factor), float(offset)
        return factors

    def has(self, *sources: str) -> bool:
        """Return True if the DBC has a signal for one of the sources."""
        return any(source in self.columns for source in sources)

    def value(self, source: str) -> Value:
        """Return the value in the unit of its source."""
        at = self.columns.get(source)
        if at is None:
            return None
        return self.converted(source, self.view.values[at])

    def converted(self, source: str, value: Value) -> Value:
        """Return a signal's value in the unit of its source.

        None for infinity, which a float signal can contain.
        """
        if value is None or isinstance(value, str):
            return value
        if source in self.factors:
            factor, offset = self.factors[source]
            value = round(value * factor + offset, 9)
        if not math.isfinite(value):
            return None
        return value

    def number(self, source: str) -> float | None:
        """Return the value of a numeric source."""
        value = self.value(source)
        if isinstance(value, (int, float)):
            return value
        return None

    def text(self, source: str) -> str | None:
        """Return the text of an enumeration, even if the signal has no texts."""
        value = self.value(source)
        if not isinstance(value, (int, float)):
            return value
        number = int(value)
        return VALUES[source].names.get(number, str(number))

    def is_known(self, group: Group) -> bool:
        """Return True while a value of a group is available. Flags do not count."""
        return any(self.view.values[at] is not None for at in self.of_group[group])

    @property
    def link(self) -> str | None:
        """The link state's name. None if it is not available.

        The link state has its own message. After a gap that message is up to a cycle later than
        live values, so the link is reported as good while live values are available.
        """
        link = self.text("link_state")
        is_bad = link is not None and normalize(link) not in ("ok", "degraded")
        if is_bad and self.is_known(Group.LIVE):
            return VALUES["link_state"].names[LinkState.OK]
        return link

    @property
    def state(self) -> str | None:
        """The operating state's name, or its number if it has none."""
        value = self._first("operating_state", "operating_state_raw")
        if not isinstance(value, (int, float)):
            return value
        number = int(value)
        state = self.protocol.states.get(number)
        if state is None:
            return f"state {number}"
        return state.text

    @property
    def device(self) -> str | None:
        """The device's name as its maker writes it, or its number if it has none."""
        value = self._first("device", "device_raw")
        names = self.protocol.devices
        if isinstance(value, (int, float)):
            number = int(value)
            return names.get(number, f"device {number}")
        if value is None:
            return None
        for name in names.values():
            if normalize(name) == normalize(value):
                return name
        return value

    @property
    def firmware(self) -> str | None:
        """Main and sub version, for example "1.14". None if one of them is not available."""
        main = self.number("firmware_main")
        sub = self.number("firmware_sub")
        if main is None or sub is None:
            return None
        return f"{main:.0f}.{sub:.0f}"

    def flags(self, word: str) -> list[Alarm] | None:
        """Return the bits that are set in an error word. None while it is not available.

        The word may have a signal, or each of its bits may have one. A flag has no code
        for "not available", so the flags are valid while another value of their group is available.
        If the DBC has no other value of the group, only set bits prove that the flags are valid.
        """
        group = _WORDS[word]
        number = self._bits_of(word)
        has_other_values = bool(self.of_group[group])
        if number is None or (has_other_values and not self.is_known(group)):
            return None
        names = {int(bit): bit for bit in self.protocol.errors.get(word, ())}
        named = [bit for bit in names.values() if number >> bit & 1]
        unnamed = []
        for position in sorted({*range(32)} - names.keys()):
            if number >> position & 1:
                meaning = f"bit {position} of {word}, without a name"
                unnamed.append(Flag(f"bit{position}", Severity.WARNING, meaning))
        if not number and not has_other_values:
            return None
        return [*named, *unnamed]

    def _bits_of(self, word: str) -> int | None:
        """Return an error word, from its signal and the signals of its bits. None without any."""
        whole = self.number(word)
        number = int(whole or 0)
        is_available = whole is not None
        for bit in self.protocol.errors.get(word, ()):
            value = self.value(bit.text)
            is_available = is_available or value is not None
            if value == 1:
                number |= 1 << bit
        return number if is_available else None

    def _first(self, *sources: str) -> Value:
        """Return the first value that is available."""
        for source in sources:
            value = self.value(source)
            if value is not None:
                return value
        return None
