"""An ESC, or the gateway itself, as its frames show it on the bus. Pure.

Values are addressed by the names of values.py, not of signals, so any DBC works. A value that is not available is None, never an old one.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.dbc.view import View
from kontronik_can_gw.esc.decoder import ErrorBit, Severity
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import EscSettings, LinkState
from kontronik_can_gw.esc.values import VALUES, Group
from kontronik_can_gw.signals import units
from kontronik_can_gw.signals.unpacker import Value

_WORDS = {"operating_errors": Group.LIVE, "selftest_errors": Group.INFO}
_SEVERITIES = list(Severity)


class Flag(NamedTuple):
    """An alarm that is no bit with a name, shown as one."""

    text: str
    severity: Severity
    meaning: str
    remedy: str = ""
    is_summary: bool = False
    is_normal: bool = False


Alarm = ErrorBit | Flag


def alarms_of(flags: Iterable[Alarm]) -> list[Alarm]:
    """What to show, errors first: no normal bits, and no summary of bits that are shown anyway."""
    found = [flag for flag in flags if not flag.is_normal]
    shown = {flag.severity for flag in found if not flag.is_summary}
    found = [flag for flag in found if not flag.is_summary or flag.severity not in shown]
    return sorted(found, key=lambda flag: _SEVERITIES.index(flag.severity))


class Member:
    """The gateway (``settings`` and ``index`` None) or an ESC. ``columns``: of each of its values in the layout, the first."""

    def __init__(self, view: View, settings: EscSettings | None, index: int | None) -> None:
        self.view, self.index = view, index
        self.name = "" if settings is None else settings.name
        self.protocol = protocol_named(None if settings is None else settings.protocol)
        self.columns: dict[str, int] = {}
        for at, column in enumerate(view.reader.columns):
            if column.esc == index:
                self.columns.setdefault(column.source, at)
        self.no_flags = {n: at for n, at in self.columns.items() if n not in self.protocol.bits}
        """The columns of all that is no flag."""
        self.of_group = {
            group: [at for name, at in self.no_flags.items() if VALUES[name].group is group]
            for group in Group
        }
        """Those of each group."""
        self._bits = {
            word: {bit: self.columns.get(bit.text) for bit in self.protocol.errors.get(word, ())}
            for word in _WORDS
        }
        """The bits of each error word, and the columns of those that are signals of their own."""
        self.factors: dict[str, tuple[float, float]] = {}
        """Factor and offset of the values whose signal has another unit than their source."""
        for name, at in self.columns.items():
            unit = VALUES[name].unit
            factor, offset = units.conversion(view.reader.columns[at].unit or unit, unit) or (1, 0)
            if (factor, offset) != (1, 0):
                self.factors[name] = float(factor), float(offset)

    def has(self, *sources: str) -> bool:
        """True where the DBC has a signal for one of the sources."""
        return any(source in self.columns for source in sources)

    def value(self, source: str) -> Value:
        """The value in the unit of its source."""
        at = self.columns.get(source)
        return None if at is None else self.converted(source, self.view.values[at])

    def converted(self, source: str, value: Value) -> Value:
        """A signal's value in the unit of its source; infinity, which a float signal can hold, is none."""
        if value is None or isinstance(value, str):
            return value
        if source in self.factors:
            factor, offset = self.factors[source]
            value = round(value * factor + offset, 9)
        return value if math.isfinite(value) else None

    def number(self, source: str) -> float | None:
        """The value of a numeric source."""
        value = self.value(source)
        return value if isinstance(value, (int, float)) else None

    def text(self, source: str) -> str | None:
        """The text of a value of an enumeration, of which a signal has the number or the text."""
        value = self.value(source)
        if isinstance(value, (int, float)):
            return VALUES[source].names.get(int(value), str(int(value)))
        return value

    def is_known(self, group: Group) -> bool:
        """True while any value of a group is available, flags apart."""
        return any(self.view.values[at] is not None for at in self.of_group[group])

    @property
    def link(self) -> str | None:
        """The link state's name; None where it is not available.

        It has its own message, which comes up to a cycle later than values after a gap: while there are values the link is good.
        """
        link = self.text("link_state")
        is_old = link is not None and normalize(link) not in ("ok", "degraded")
        return (
            VALUES["link_state"].names[LinkState.OK]
            if is_old and self.is_known(Group.LIVE)
            else link
        )

    @property
    def state(self) -> str | None:
        """The operating state's name, or its number if it has none."""
        value = self._first("operating_state", "operating_state_raw")
        if isinstance(value, (int, float)):
            number, states = int(value), self.protocol.states
            return states[number].text if number in states else f"state {number}"
        return value

    @property
    def device(self) -> str | None:
        """The device's name as its maker writes it, or its number if it has none."""
        value, names = self._first("device", "device_raw"), self.protocol.devices
        if isinstance(value, (int, float)):
            return names.get(int(value), f"device {int(value)}")
        if value is None:
            return None
        alike = (name for name in names.values() if normalize(name) == normalize(value))
        return next(alike, value)

    @property
    def firmware(self) -> str | None:
        """Main and sub version, as "1.14"."""
        main, sub = self.number("firmware_main"), self.number("firmware_sub")
        return None if main is None or sub is None else f"{main:.0f}.{sub:.0f}"

    def flags(self, word: str) -> list[Alarm] | None:
        """The set bits of an error word; None while it is not available.

        Flags have no code for "not available": they count while another value of their group is known.
        """
        group, bits, values = _WORDS[word], self._bits[word], self.view.values
        has_others, whole = bool(self.of_group[group]), self.number(word)
        is_set = {bit: values[at] for bit, at in bits.items() if at is not None}
        if (has_others and not self.is_known(group)) or {whole, *is_set.values()} == {None}:
            return None
        number = int(whole or 0)
        found: list[Alarm] = [bit for bit in bits if number >> bit & 1 or is_set.get(bit) == 1]
        for bit in range(32) if number else ():
            if number >> bit & 1 and bit not in bits:
                meaning = f"bit {bit} of {word}, which has no name"
                found.append(Flag(f"bit{bit}", Severity.WARNING, meaning))
        return found if has_others else found or None

    def _first(self, *sources: str) -> Value:
        """The first value that is available."""
        return next((value for value in map(self.value, sources) if value is not None), None)
