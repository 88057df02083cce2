"""One ESC as the monitor shows it: values in the units of their sources, alarms, link, extremes. Pure."""

import math
import re
from typing import Any

from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.dbc.view import View
from kontronik_can_gw.desk.member import Flag, Member
from kontronik_can_gw.desk.monitor.quantities import QUANTITIES, Track
from kontronik_can_gw.esc.decoder import Severity
from kontronik_can_gw.esc.telemetry import EscSettings, LinkState
from kontronik_can_gw.esc.values import VALUES, Group
from kontronik_can_gw.signals import units
from kontronik_can_gw.signals.unpacker import Value

_WORKING = ("ok", "degraded")
_SEVERITIES = list(Severity)


def words(text: str) -> str:
    """A name as people write it: ``SpoolUpFromStill`` -> ``spool up from still``, ``RpmControl`` -> ``RPM control``."""
    parts = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W_]", text)
    return " ".join(
        part if len(part) > 1 and part.isupper() else part.lower() for part in parts
    ).replace("rpm", "RPM")


class EscMonitor(Member):
    """One ESC as seen on the bus. All values are those of the last ``Monitor.advance``."""

    def __init__(self, settings: EscSettings, index: int, view: View) -> None:
        super().__init__(view, settings, index)
        self.tracks = {quantity.source: Track() for quantity in QUANTITIES}
        self._cells = settings.cell_count
        self._factors = {
            name: _to_source(view.reader.columns[column].unit, VALUES[name].unit)
            for name, column in self.columns.items()
        }
        flags = {*self.protocol.bits, *self.protocol.errors}
        self.units = {
            name: value.unit
            for name, value in VALUES.items()
            if name in self.columns and name not in flags
        }
        """Unit of each source in the DBC, in the order of the sources, except flags and words of flags."""

    def value(self, source: str) -> Value:
        """The value in the source's unit; None where it is not available."""
        return self.converted(source, super().value(source))

    def converted(self, source: str, value: Value) -> Value:
        """A signal's value in the unit of its source; infinity, which a float signal can hold, is none."""
        if value is None or isinstance(value, str):
            return value
        if (factor := self._factors[source]) is not None:
            value = round(value * factor[0] + factor[1], 9)
        return value if math.isfinite(value) else None

    def number(self, source: str) -> float | None:
        """The value of a numeric source. The cell voltage is computed if the DBC has none and the number of cells is known."""
        value = super().number(source)
        if value is None and source == "mean_cell_voltage":
            cells = self._cells or self.number("cell_count")
            voltage = self.number("battery_voltage")
            if cells and voltage is not None:
                return voltage / cells
        return value

    @property
    def is_fresh(self) -> bool:
        """True while any measured value is available."""
        return self.is_known(Group.LIVE)

    @property
    def link(self) -> str | None:
        """The link state's name; None where it is not available.

        It has its own message, which comes up to a cycle later than values after a gap: while there are values the link is good.
        """
        link = self.text("link_state")
        is_old = link is not None and self.is_fresh and normalize(link) not in _WORKING
        return VALUES["link_state"].names[LinkState.OK] if is_old else link

    @property
    def device_text(self) -> str:
        """Device, variant and firmware; empty where not available."""
        if self.device is None:
            return ""
        variant = self.number("variant")
        text = self.device if variant is None else f"{self.device} {variant:.0f}"
        return text if self.firmware is None else f"{text}, firmware {self.firmware}"

    @property
    def active(self) -> list[Flag]:
        """The bits that are set, errors first."""
        found = [flag for word in self.protocol.errors for flag in self.flags(word) or ()]
        return sorted(found, key=lambda flag: _SEVERITIES.index(flag.severity))

    @property
    def alarms(self) -> list[Flag]:
        """The active bits to show: without those that are no alarm, and without a summary of bits that are shown anyway."""
        alarms = [flag for flag in self.active if not flag.is_normal]
        shown = {flag.severity for flag in alarms if not flag.is_summary}
        return [flag for flag in alarms if not flag.is_summary or flag.severity not in shown]

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
            "device": self.device_text or None,
            "errors": names[Severity.ERROR],
            "warnings": names[Severity.WARNING],
            "status": names[Severity.STATUS],
            "values": {name: self.value(name) for name in self.units},
        }


def _to_source(unit: str, source_unit: str) -> tuple[float, float] | None:
    """Factor and offset from a signal's unit to that of its source; None where the units are equal."""
    factor, offset = units.conversion(unit or source_unit, source_unit) or (1, 0)
    return None if (factor, offset) == (1, 0) else (float(factor), float(offset))
