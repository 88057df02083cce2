"""The state of one ESC: newest data, derived values, freshness, link.

core/esc_stream.py, or its twin in C, computes this state from bytes and time. ``now`` is a whole
number of nanoseconds of one monotonic clock.
"""

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from enum import IntEnum
from fractions import Fraction
from typing import Any, Self

from kontronik_can_gw.esc.decoder import Counters, Data, EscProtocol
from kontronik_can_gw.esc.protocols import PROTOCOLS
from kontronik_can_gw.times import MS, SECOND

INFO_TIMEOUT_NS = 10 * SECOND
"""Info data older than this is not available.

An ESC sends an info frame every second, or every five seconds if it sends at 20 Hz.
"""
MAX_COUNT = 1 << 48
"""Limit of a counter. At 1 Mbit/s it takes more than a human life."""
MAX_ENERGY = 1 << 55
"""Limit of an energy in mW s. At 100 kW it takes more than ten years."""


class LinkState(IntEnum):
    """State of one UART."""

    NEVER_SEEN = 0
    """There was no live frame yet, and no byte since the port was opened."""
    SEARCHING = 1
    """Bytes were received, but no live frame."""
    OK = 2
    DEGRADED = 3
    """Live data is fresh, but too many bytes or frames are bad."""
    LOST = 4
    """Live data is older than the timeout."""
    PORT_ERROR = 5
    """The serial port is not open."""


class Event:
    """Bits that report the changes made by a call.

    They are plain integers because an IntFlag would take a third of the time of a frame.
    """

    NONE = 0
    LIVE = 1
    INFO = 2
    LINK = 4
    SECOND = 8
    """A second has passed: counters and rates were updated."""
    STATE = 16
    """The operating errors or the device changed, or became known."""
    ALL = 31
    """All events of an ESC."""
    QUIET = 32
    """Quiet mode of the gateway began or ended. It is reported for ESC 0."""


POLE_PAIRS = (1, 100)
CELL_COUNTS = (0, 0xFF)
TIMEOUTS_MS = (20, 60_000)
"""Smallest and greatest setting of an ESC, in a configuration and for use."""
WRITTEN: Mapping[str, tuple[int, int]] = {
    "pole_pairs": (1, 0xFFFF),
    "gear": (1, 10**12),
    "cell_count": CELL_COUNTS,
    "timeout_ns": (MS, MS << 16),
    "crc_error_threshold": (0, 0xFFFF_FFFF),
}
"""Limits of settings in captures: of the objects to which a CANopen master writes them (2100h).

The limits of a gear are those of its numerator and denominator.
"""


@dataclass(frozen=True)
class EscSettings:
    """The user's settings of one ESC and its drive train."""

    name: str = "esc"
    pole_pairs: int = 1
    gear: Fraction = Fraction(1)
    """Revolutions of the motor per revolution of the output shaft."""
    cell_count: int = 0
    """0: the number that the ESC reports is used."""
    timeout_ns: int = 250 * MS
    """Live data older than this is not available (``TIMEOUTS_MS``)."""
    crc_error_threshold: int = 5
    """A link with this many CRC errors within a second is DEGRADED."""
    protocol: str = PROTOCOLS[0].name
    """Name of the ESC's protocol."""


class EscTelemetry:
    """The state of one ESC, as packers, nodes and the status document read it."""

    protocol: EscProtocol
    settings: EscSettings
    live: Data | None = None
    """The newest measurements. None unless they are fresh."""
    info: Data | None = None
    """Newest info data of the device now on the line. None unless it is fresh."""
    last_live: Data | None = None
    """The newest measurements, fresh or not, in the layout now on the line."""
    last_info: Data | None = None
    """Newest info data, fresh or not, in the layout now on the line."""
    device: int | None = None
    """Number of the device in ``last_info``."""
    link: LinkState = LinkState.NEVER_SEEN
    layout: int = 0
    """Number of the frame layout, counted from 1 as in EscProtocol.layouts. 0: unknown."""
    cells: int
    """Number of battery cells. 0: unknown."""
    pole_pairs: int
    shaft_divisor: int
    """Pole pairs times the numerator of the gear."""
    gear_denominator: int
    frame_rate: int | None = 0
    """Live frames in the last full second, in 0.1 Hz. 0 without fresh live data.

    None in the first second after the link came up.
    """
    losses: int = 0
    """How often ``live`` became None: it was too old, or the port was lost."""
    suspect_frames: int = 0
    """Live frames with an impossible value outside their checksum."""
    late_frames: int = 0
    """Frames that were already older than their timeout when they were complete."""
    energy_mw_ns: int = 0
    """Energy drawn from the battery. Recovered energy is not subtracted."""
    run_time_ns: int = 0
    """Time during which the motor turned."""
    live_ns: int | None = None
    """Arrival of the newest live frame's last byte, from which ages are computed.

    None before the first live frame.
    """
    last_info_ns: int | None = None
    """The same time of the newest info frame."""
    live_bound_ns: int = 0
    """Earliest possible arrival of the newest live frame's last byte. Timeouts count from it."""
    info_bound_ns: int | None = None
    """The same time of the newest info frame. None unless ``info`` is fresh."""
    line_errors: int = 0
    """Parity, framing and overrun errors. The owner of the port writes this number."""
    base: Counters
    """Counters when statistics were last reset."""
    base_losses: int = 0
    base_line_errors: int = 0

    @property
    def counters(self) -> Counters:
        """Counters of the whole stream. Do not change them."""
        raise NotImplementedError

    def frozen(self) -> Self:
        """Return a copy that never changes, so that any thread may read it."""
        raise NotImplementedError

    @property
    def window(self) -> list[int]:
        """The current second of rate and quality: its beginning, then counters at its beginning.

        The counters are live frames, dropped bytes, bytes and CRC errors. The last two numbers are
        the frame rate (-1: unknown) and the mean time between live frames in ns.
        """
        raise NotImplementedError

    def set_window(self, window: Sequence[int]) -> None:
        """Replace the current second of rate and quality."""
        raise NotImplementedError

    def set_counters(self, counters: Any) -> None:
        """Replace the counters of the stream. They must fit the bytes that are held."""
        raise NotImplementedError

    @property
    def held_bytes(self) -> int:
        """Number of bytes that are held because they may be part of a frame."""
        raise NotImplementedError

    def stream_state(self) -> dict[str, Any]:
        """Return the counters, which a replay cannot compute if it begins later in the stream."""
        counters: Any = self.counters
        return {
            "counters": list(astuple(counters)),
            "held": self.held_bytes,
            "window": self.window,
        }

    def adopt_stream_state(
        self,
        counters: Sequence[int],
        held: int,
        window: Sequence[int],
    ) -> None:
        """Continue with the counters of ``stream_state``.

        The rate is only adopted if live data is fresh. The decoder keeps the bytes that it holds,
        so ``counters.bytes`` differs from the given number if it does not hold the same bytes.
        """
        own: Any = self.counters
        given = type(own)(*counters)
        self.set_counters(replace(given, bytes=given.bytes - held + self.held_bytes))
        if self.up:
            self.set_window(window)

    def apply(self, settings: EscSettings) -> None:
        """Replace the settings."""
        self.settings = settings
        self.pole_pairs = settings.pole_pairs
        self.shaft_divisor = settings.pole_pairs * settings.gear.numerator
        self.gear_denominator = settings.gear.denominator

    @property
    def live_until_ns(self) -> int:
        """Time until which the newest live frame is fresh."""
        return self.live_bound_ns + self.settings.timeout_ns

    @property
    def up(self) -> bool:
        """True while live data is fresh."""
        return self.live is not None

    def supplies(self, not_on: frozenset[int], raw: int) -> bool:
        """Return False if the value ``raw`` must be shown as not available.

        That is the case if the last known device is in ``not_on``, the devices that do not supply
        the value. It is also the case for 0 without fresh info data, because the device might be
        one of them.
        """
        if self.info is None and raw == 0:
            return False
        return self.device is None or self.device not in not_on

    @property
    def last_cells(self) -> int:
        """Number of battery cells. 0: unknown.

        While telemetry is lost, the number in the last info data is used.
        """
        if self.cells or self.live is not None or self.last_info is None:
            return self.cells
        return self.protocol.value("cell_count", self.last_info) or 0

    def age_ms(self, now: int) -> int | None:
        """Return the age of the newest live frame. None before the first."""
        if self.live_ns is None:
            return None
        return max(0, now - self.live_ns) // MS

    def reset_statistics(self) -> None:
        """Count from 0 again where counters are shown relative to ``base``.

        The stream's own counters continue.
        """
        self.base = self.counters.copy()
        self.base_losses = self.losses
        self.base_line_errors = self.line_errors
