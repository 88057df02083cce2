"""What the configuration says of a node; how it, the EDS and stored values make the dictionary and the ESC's settings (2100h)."""

from dataclasses import dataclass, replace
from fractions import Fraction

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.dictionary import Dictionary
from kontronik_can_gw.canopen.eds import Eds
from kontronik_can_gw.canopen.storage import APPLICATION, Stored
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.times import MS

_SELF_START_OFF = 4
# whatever the limits of an EDS are
_MIN_TIMEOUT_MS, _MAX_TIMEOUT_MS = 20, 60_000
_MAX_CELLS = 0xFF


@dataclass(frozen=True)
class NodeSettings:
    """What the configuration says of a node.

    ``node_id``: 1..127, or 255 for a node that waits for LSS. ``vendor_id`` None: as the EDS says. ``segment_ns``: distance of the
    segments of a block upload. ``device``: number of the device that is expected on the line, None for any.
    """

    node_id: int
    serial: int = 0
    vendor_id: int | None = None
    self_start: bool = False
    read_only: bool = False
    bitrate: int = 500_000
    segment_ns: int = 0
    version: str = ""
    device: int | None = None


def _entries(settings: EscSettings) -> dict[int, int]:
    """Settings of an ESC as the sub-indices of 2100h."""
    return {
        1: settings.pole_pairs,
        2: settings.gear.numerator,
        3: settings.gear.denominator,
        4: settings.timeout_ns // MS,
        7: settings.cell_count,
        8: settings.crc_error_threshold,
    }


def esc_settings(dictionary: Dictionary, base: EscSettings) -> EscSettings:
    """The settings of 2100h; ``base`` where the EDS has no object for one."""
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
    """Sub-indices of 2100h that the configuration sets, and to what."""
    standard = _entries(EscSettings())
    return {sub: given for sub, given in _entries(base).items() if given != standard[sub]}


def make_dictionary(
    eds: Eds, base: EscSettings, settings: NodeSettings, stored: Stored
) -> Dictionary:
    """The dictionary of a node before its first reset, the configuration's values as power-on values and the stored ones in place.

    Where the configuration leaves a setting at its default, the EDS's default holds.
    """
    dictionary = Dictionary(eds)
    power_on = {(at.SETTINGS, sub): given for sub, given in configured_settings(base).items()}
    if settings.vendor_id is not None:
        power_on[0x1018, 1] = settings.vendor_id
    power_on[0x1018, 4] = settings.serial
    for (index, sub), given in power_on.items():
        if (variable := dictionary.get(index, sub)) is not None:
            variable.power_on = given
    if settings.self_start and (variable := dictionary.get(0x1F80)) is not None:
        variable.power_on = int(variable.power_on) & ~_SELF_START_OFF
    dictionary.read_only = settings.read_only
    dictionary.reset(APPLICATION, settings.node_id, stored.application)
    return dictionary


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

        ``esc`` are the ESC's settings, from which 2100h is made.
        """
        return make_dictionary(self.eds, esc, self.settings, self.stored)
