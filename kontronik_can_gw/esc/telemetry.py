"""The state of one ESC: newest data, derived values, freshness, link. What makes it of bytes and time is in stream.py, or in C.

``now`` is integer nanoseconds of one monotonic clock. What this object shows as ``live`` or ``info`` is fresh; what is not fresh,
or not known of the device now on the line, is None.
"""

from dataclasses import dataclass
from enum import IntEnum
from fractions import Fraction
from typing import Self

from kontronik_can_gw.esc.decoder import Counters, Data, EscProtocol
from kontronik_can_gw.esc.protocols import PROTOCOLS

MS = 1_000_000
SECOND = 1000 * MS
INFO_TIMEOUT_NS = 10 * SECOND
"""Info frames come about every second (every five where the ESC sends at 20 Hz); without any for so long, info is not available."""


class LinkState(IntEnum):
    """State of one UART."""

    NEVER_SEEN = 0
    SEARCHING = 1
    OK = 2
    DEGRADED = 3
    LOST = 4
    PORT_ERROR = 5


class Event:
    """What a call changed: bits of a plain int, because an IntFlag would be a third of the cost of a frame."""

    NONE = 0
    LIVE = 1
    INFO = 2
    LINK = 4
    SECOND = 8
    """A second is over: counters and rates are as new as they are to be had."""
    STATE = 16
    """The operating errors or the device are others than in the live data or information before, or there was none."""
    ALL = 31


@dataclass(frozen=True)
class EscSettings:
    """What a person knows of one ESC and its drive train.

    ``gear``: motor revolutions per output revolution. ``cell_count`` 0: as the ESC reports. ``timeout_ns`` (20 ms to 60 s):
    live data older than this is not available. ``crc_error_threshold``: CRC errors in a second that make a link DEGRADED.
    """

    name: str = "esc"
    pole_pairs: int = 1
    gear: Fraction = Fraction(1)
    cell_count: int = 0
    timeout_ns: int = 250 * MS
    crc_error_threshold: int = 5
    protocol: str = PROTOCOLS[0].name
    """Name of the ESC's protocol."""


class EscTelemetry:
    """What is known of one ESC, for all that read it: the packers, nodes, the status document.

    ``live``, ``info`` (data of a reading, None where not available), ``link``, ``layout`` (0 unknown, else as the protocol lists them),
    ``cells`` (0 unknown), ``pole_pairs``, ``output_divisor`` / ``gear_denominator`` (pole pairs x gear), ``frame_rate`` (live frames of
    the last full second in 0.1 Hz, None before it), ``losses``, ``energy_mw_ns`` (drawn from the battery),
    ``run_time_ns`` (the motor turned), ``live_ns`` and ``last_info_ns`` (time of the newest live and
    info frame's last byte, as ages are shown, None before the first). ``live_bound_ns`` and ``info_bound_ns`` are the earliest that
    byte can have come, for time-outs. ``last_live`` and ``last_info`` are the newest ever, fresh or not, of the layout now on the line,
    ``device`` is the number in the latter; ``line_errors`` (parity, framing, overrun) is written by who owns the port.
    """

    protocol: EscProtocol
    settings: EscSettings
    live: Data | None = None
    info: Data | None = None
    last_live: Data | None = None
    last_info: Data | None = None
    device: int | None = None
    link: LinkState = LinkState.NEVER_SEEN
    layout: int = 0
    cells: int
    pole_pairs: int
    output_divisor: int
    gear_denominator: int
    frame_rate: int | None = 0
    losses: int = 0
    suspect_frames: int = 0
    late_frames: int = 0
    energy_mw_ns: int = 0
    run_time_ns: int = 0
    live_ns: int | None = None
    last_info_ns: int | None = None
    live_bound_ns: int = 0
    info_bound_ns: int | None = None
    line_errors: int = 0
    base: Counters
    base_losses: int = 0
    base_line_errors: int = 0

    @property
    def counters(self) -> Counters:
        """Counters of the whole stream so far."""
        raise NotImplementedError

    def frozen(self) -> Self:
        """What is known now, as a copy that nobody changes: any thread may read it."""
        raise NotImplementedError

    def apply(self, settings: EscSettings) -> None:
        """Other settings from now on."""
        self.settings = settings
        self.pole_pairs = settings.pole_pairs
        self.output_divisor = settings.pole_pairs * settings.gear.numerator
        self.gear_denominator = settings.gear.denominator

    @property
    def up(self) -> bool:
        """True while live telemetry is fresh."""
        return self.live is not None

    def supplies(self, not_on: frozenset[int], raw: int) -> bool:
        """False for a value that the device (the last known one) does not have, and at 0 as long as the device is not known."""
        device = self.device
        return (self.info is not None or raw != 0) and (device is None or device not in not_on)

    @property
    def last_cells(self) -> int:
        """Number of cells, 0: unknown. While telemetry is lost that of the last value."""
        if self.cells or self.live is not None or self.last_info is None:
            return self.cells
        return self.protocol.value("cell_count", self.last_info) or 0

    def age_ms(self, now: int) -> int | None:
        """Age of the newest live frame, None before the first."""
        return None if self.live_ns is None else max(0, now - self.live_ns) // MS

    def reset_statistics(self) -> None:
        """Let the counters that are shown relative to ``base`` begin anew; the stream's own go on."""
        self.base = self.counters.copy()
        self.base_losses, self.base_line_errors = self.losses, self.line_errors
