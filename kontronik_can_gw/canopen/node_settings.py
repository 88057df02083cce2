"""The settings of a node, and how the object dictionary is made from them.

The dictionary comes from the EDS, the configuration and stored values. The settings of the ESC
(2100h) follow from it.
"""

from dataclasses import dataclass, replace
from fractions import Fraction

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.dictionary import Dictionary
from kontronik_can_gw.canopen.eds import Eds
from kontronik_can_gw.canopen.storage import APPLICATION, Stored
from kontronik_can_gw.esc.telemetry import (
    CELL_COUNTS,
    TIMEOUTS_MS,
    WRITTEN,
    EscSettings,
)
from kontronik_can_gw.times import MS

_SELF_START_OFF = 4


@dataclass(frozen=True)
class NodeSettings:
    """The settings of a node in the configuration."""

    node_id: int
    """1..127, or 255 for a node that waits for LSS."""
    serial: int = 0
    vendor_id: int | None = None
    """None for the vendor-ID of the EDS."""
    self_start: bool = False
    read_only: bool = False
    bitrate: int = 500_000
    segment_ns: int = 0
    """Minimum time between segments of a block upload."""
    version: str = ""
    device: int | None = None
    """The expected device number, or None for any device."""


def _entries(settings: EscSettings) -> dict[int, int]:
    """Return the settings of an ESC by sub-index of 2100h."""
    return {
        1: settings.pole_pairs,
        2: settings.gear.numerator,
        3: settings.gear.denominator,
        4: settings.timeout_ns // MS,
        7: settings.cell_count,
        8: settings.crc_error_threshold,
    }


def esc_settings(dictionary: Dictionary, base: EscSettings) -> EscSettings:
    """Return the settings of 2100h, with those of ``base`` for objects that the EDS lacks."""
    held = {}
    for sub, own in _entries(base).items():
        held[sub] = dictionary.number(at.SETTINGS, sub, own)
    # These limits hold whatever the EDS allows.
    shortest_ms, longest_ms = TIMEOUTS_MS
    fewest_pole_pairs, _ = WRITTEN["pole_pairs"]
    _, most_cells = CELL_COUNTS
    return replace(
        base,
        pole_pairs=max(fewest_pole_pairs, held[1]),
        gear=Fraction(held[2] or 1, held[3] or 1),
        timeout_ns=min(max(shortest_ms, held[4]), longest_ms) * MS,
        cell_count=min(held[7], most_cells),
        crc_error_threshold=held[8],
    )


def configured_settings(base: EscSettings) -> dict[int, int]:
    """Return the values that the configuration gives to sub-indices of 2100h."""
    standard = _entries(EscSettings())
    configured = _entries(base)
    return {sub: given for sub, given in configured.items() if given != standard[sub]}


@dataclass(frozen=True)
class NodeSetup:
    """Everything from which one node is made."""

    eds: Eds
    settings: NodeSettings
    stored: Stored
    base: EscSettings | None = None
    """The configured settings of the ESC. None if the ESC has them still."""

    def dictionary(self, esc: EscSettings) -> Dictionary:
        """Return the dictionary of the node before its first reset.

        ``esc`` are the ESC's settings, from which 2100h is made. Values of the configuration are
        power-on values, and stored values are current values. The EDS has the defaults of settings
        that the configuration does not change.
        """
        settings = self.settings
        dictionary = Dictionary(self.eds)
        power_on = {(at.SETTINGS, sub): given for sub, given in configured_settings(esc).items()}
        if settings.vendor_id is not None:
            power_on[0x1018, 1] = settings.vendor_id
        power_on[0x1018, 4] = settings.serial
        for (index, sub), given in power_on.items():
            variable = dictionary.get(index, sub)
            if variable is not None:
                variable.power_on = given
        startup = dictionary.get(0x1F80)
        if startup is not None and settings.self_start:
            startup.power_on = int(startup.power_on) & ~_SELF_START_OFF
        dictionary.read_only = settings.read_only
        dictionary.reset(APPLICATION, settings.node_id, self.stored.values)
        return dictionary
