"""The configured settings of a node.

The dictionary of a node, and the settings of its ESC (2100h), are made from them, from the EDS and
from the stored parameters.
"""

from dataclasses import dataclass, replace
from fractions import Fraction

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.dictionary import Dictionary
from kontronik_can_gw.canopen.eds import Eds
from kontronik_can_gw.canopen.storage import APPLICATION, Stored
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.times import MS

_SELF_START_OFF = 4
# Limits that also hold if the limits of the EDS are wider
_MIN_TIMEOUT_MS = 20
_MAX_TIMEOUT_MS = 60_000
_MAX_CELLS = 0xFF


@dataclass(frozen=True)
class NodeSettings:
    """The configured settings of a node."""

    node_id: int
    """1..127, or 255 for a node that waits for LSS."""
    serial: int = 0
    vendor_id: int | None = None
    """None: the vendor-ID of the EDS."""
    self_start: bool = False
    read_only: bool = False
    bitrate: int = 500_000
    segment_ns: int = 0
    """Time between the segments of a block upload."""
    version: str = ""
    device: int | None = None
    """Number of the expected device on the line. None: any device."""


def _entries(settings: EscSettings) -> dict[int, int]:
    """Return the settings of an ESC by their sub-indices of 2100h."""
    return {
        1: settings.pole_pairs,
        2: settings.gear.numerator,
        3: settings.gear.denominator,
        4: settings.timeout_ns // MS,
        7: settings.cell_count,
        8: settings.crc_error_threshold,
    }


def esc_settings(dictionary: Dictionary, base: EscSettings) -> EscSettings:
    """Return the settings in 2100h. ``base`` has the settings that the EDS does not contain."""
    held = {sub: dictionary.number(at.SETTINGS, sub, own) for sub, own in _entries(base).items()}
    return replace(
        base,
        pole_pairs=max(1, held[1]),
        gear=Fraction(held[2] or 1, held[3] or 1),
        timeout_ns=min(max(_MIN_TIMEOUT_MS, held[4]), _MAX_TIMEOUT_MS) * MS,
        cell_count=min(held[7], _MAX_CELLS),
        crc_error_threshold=held[8],
    )


def configured_settings(base: EscSettings) -> dict[int, int]:
    """Return the values that the configuration sets, by their sub-indices of 2100h."""
    standard = _entries(EscSettings())
    return {sub: given for sub, given in _entries(base).items() if given != standard[sub]}


def make_dictionary(
    eds: Eds, base: EscSettings, settings: NodeSettings, stored: Stored
) -> Dictionary:
    """Return the dictionary of a node before its first reset.

    The power-on values are those of the configuration. If it does not change a setting, the default
    of the EDS is used. The application parameters have their stored values.
    """
    dictionary = Dictionary(eds)
    power_on = {(at.SETTINGS, sub): given for sub, given in configured_settings(base).items()}
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
    dictionary.reset(APPLICATION, settings.node_id, stored.application)
    return dictionary
