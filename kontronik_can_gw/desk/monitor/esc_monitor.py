"""One ESC as it is seen on the bus: values, operating state, errors, link, extremes. Pure.

Values are addressed by the names of sources (values.py), not of signals, so any DBC works, and units are those of the sources. A value
that is not available is None, never an old one.
"""

import math
import re
from collections.abc import Collection, Iterable, Mapping
from typing import Any, NamedTuple

from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.dbc.view import View
from kontronik_can_gw.desk.monitor.quantities import QUANTITIES, Track
from kontronik_can_gw.esc.decoder import Severity
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import EscSettings, LinkState
from kontronik_can_gw.esc.values import VALUES, Group
from kontronik_can_gw.gateway_status import CanState, GatewayState
from kontronik_can_gw.signals import units
from kontronik_can_gw.signals.unpacker import Value

_WORKING = ("ok", "degraded")
_BELIEVED = 2
_SEVERITIES = list(Severity)


class Active(NamedTuple):
    """A bit that an ESC has set."""

    name: str
    severity: Severity
    meaning: str
    remedy: str = ""


def words(text: str) -> str:
    """A name as people write it: ``SpoolUpFromStill`` -> ``spool up from still``, ``RpmControl`` -> ``RPM control``."""
    parts = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W_]", text)
    return " ".join(
        part if len(part) > 1 and part.isupper() else part.lower() for part in parts
    ).replace("rpm", "RPM")


class EscMonitor:
    """One ESC as seen on the bus. All values are those of the last ``Monitor.advance``."""

    def __init__(self, settings: EscSettings, index: int, view: View) -> None:
        self.name = settings.name
        self.tracks = {quantity.source: Track() for quantity in QUANTITIES}
        self._settings = settings
        self._protocol = protocol_named(settings.protocol)
        self._view = view
        columns = [(name, view.reader.column_of(name, index)) for name in VALUES]
        self.columns = {name: column for name, column in columns if column is not None}
        """Column of each source that the DBC has."""
        self._factors = {
            name: _to_source(view.reader.columns[column].unit, VALUES[name].unit)
            for name, column in self.columns.items()
        }
        self._bits = self._protocol.bits
        flags = set(self._bits)
        self._plain = {
            group: [
                column
                for name, column in self.columns.items()
                if VALUES[name].group is group and name not in flags
            ]
            for group in (Group.LIVE, Group.INFO)
        }
        self.units = {
            name: VALUES[name].unit
            for name in self.columns
            if name not in {*flags, "operating_errors", "selftest_errors"}
        }
        """Unit of each source in the DBC, in the order of the sources, except flags and words of flags."""
        link = self.columns.get("link_state", -1)
        self._link_part = next(
            (p.first for p in view.reader.parts if p.first <= link < p.first + p.count), None
        )
        self._link_reports = 0
        """Number of link state messages since the first values after a gap."""

    def has(self, *sources: str) -> bool:
        """True where the DBC has a signal for one of the sources."""
        return any(source in self.columns for source in sources)

    def value(self, source: str) -> Value:
        """The value in the source's unit; None where it is not available."""
        column = self.columns.get(source)
        return None if column is None else self.converted(source, self._view.values[column])

    def converted(self, source: str, value: Value) -> Value:
        """A signal's value in the unit of its source; infinity, which a float signal can hold, is none."""
        if value is None or isinstance(value, str):
            return value
        if (factor := self._factors[source]) is not None:
            value = round(value * factor[0] + factor[1], 9)
        return value if math.isfinite(value) else None

    def number(self, source: str) -> float | None:
        """The value of a numeric source. The cell voltage is computed if the DBC has none and the number of cells is known."""
        value = self.value(source)
        if value is None and source == "mean_cell_voltage":
            cells = self._settings.cell_count or self.number("cell_count")
            voltage = self.value("battery_voltage")
            if cells and isinstance(voltage, (int, float)):
                value = voltage / cells
        return value if isinstance(value, (int, float)) else None

    @property
    def is_fresh(self) -> bool:
        """True while any measured value is available."""
        return any(self._view.values[column] is not None for column in self._plain[Group.LIVE])

    @property
    def state(self) -> str | None:
        """The operating state's name, or its number if it has none; None where it is not available."""
        value = self._first("operating_state", "operating_state_raw")
        if isinstance(value, (int, float)):
            number, states = int(value), self._protocol.states
            return states[number].text if number in states else f"state {number}"
        return value

    @property
    def link(self) -> str | None:
        """The link state's name; None where it is not available.

        It has its own message, which comes up to a cycle later than the first values after a gap and may have been sent before them:
        until its second reception the values show that the link is good.
        """
        link = state_name(LinkState, self.value("link_state"))
        if link is None or normalize(link) in _WORKING:
            return link
        is_believed = self._link_reports >= _BELIEVED or not self.is_fresh
        return link if is_believed else state_name(LinkState, LinkState.OK)

    def note(self, firsts: Collection[int], was_fresh: bool) -> None:
        """Take note of a frame with the parts that begin at these columns."""
        if not was_fresh and self.is_fresh:
            self._link_reports = 0
        elif self._link_part is not None and self._link_part in firsts:
            self._link_reports += 1

    @property
    def device(self) -> str:
        """Device, variant and firmware; empty where not available."""
        value = self._first("device", "device_raw")
        if isinstance(value, (int, float)):
            value = self._protocol.devices.get(int(value), f"device {int(value)}")
        if value is None:
            return ""
        key = normalize(value)
        text = next(
            (each for each in self._protocol.devices.values() if normalize(each) == key), value
        )
        variant, main, sub = map(self.number, ("variant", "firmware_main", "firmware_sub"))
        if variant is not None:
            text += f" {variant:.0f}"
        return text if main is None or sub is None else f"{text}, firmware {main:.0f}.{sub:.0f}"

    @property
    def active(self) -> list[Active]:
        """The bits that are set, errors first. A flag counts only while another value of its frame is available."""
        found = [
            *self._active("operating_errors", Group.LIVE),
            *self._active("selftest_errors", Group.INFO),
        ]
        return sorted(found, key=lambda active: _SEVERITIES.index(active.severity))

    @property
    def alarms(self) -> list[Active]:
        """The active bits to show: without those that are no alarm, and without a summary of bits that are shown anyway."""
        normal = {bit.text for bit in self._bits.values() if bit.is_normal}
        summaries = {bit.text for bit in self._bits.values() if bit.is_summary}
        alarms = [active for active in self.active if active.name not in normal]
        plain = {active.severity for active in alarms if active.name not in summaries}
        return [
            active
            for active in alarms
            if active.name not in summaries or active.severity not in plain
        ]

    def document(self) -> dict[str, Any]:
        """Everything as JSON; None for what is not available."""
        active = self.active
        names = {
            severity: [each.name for each in active if each.severity is severity]
            for severity in Severity
        }
        return {
            "name": self.name,
            "link": self.link,
            "state": self.state,
            "device": self.device or None,
            "errors": names[Severity.ERROR],
            "warnings": names[Severity.WARNING],
            "status": names[Severity.STATUS],
            "values": {name: self.value(name) for name in self.units},
        }

    def _first(self, *sources: str) -> Value:
        """The first value that is available."""
        return next((value for value in map(self.value, sources) if value is not None), None)

    def _active(self, word_source: str, group: Group) -> Iterable[Active]:
        plain = self._plain[group]
        if plain and all(self._view.values[column] is None for column in plain):
            return
        word = int(self.number(word_source) or 0)
        bits = self._protocol.errors.get(word_source, ())
        for bit in bits:
            if word >> int(bit) & 1 or self.value(bit.text) == 1:
                yield Active(bit.text, bit.severity, bit.meaning, bit.remedy)
        named = {int(bit) for bit in bits}
        for number in range(32):
            if word >> number & 1 and number not in named:
                meaning = f"bit {number} of {word_source}, which has no name"
                yield Active(f"bit{number}", Severity.WARNING, meaning)


def _to_source(unit: str, source_unit: str) -> tuple[float, float] | None:
    """Factor and offset from a signal's unit to that of its source; None where the units are equal."""
    factor, offset = units.conversion(unit or source_unit, source_unit) or (1, 0)
    return None if (factor, offset) == (1, 0) else (float(factor), float(offset))


def state_name(
    kind: type[LinkState] | type[GatewayState] | type[CanState], value: Value
) -> str | None:
    """A state's name, where a signal has its number or its name."""
    if not isinstance(value, (int, float)):
        return value
    names: Mapping[int, str] = {
        int(member): member.name.title().replace("_", "") for member in kind
    }
    return names.get(int(value), str(int(value)))
