"""The data of a recorded flight, from which the page is made. Times are ns of the recording's clock."""

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from kontronik_can_gw.esc.decoder import EscProtocol

Number = int | float | None
Kind = Literal["error", "state", "link", "device"]


class Extreme(NamedTuple):
    """A value and the time of its first occurrence."""

    value: float
    time_ns: int


class Segment(NamedTuple):
    """A period in one operating state; ``state`` is its number."""

    begin_ns: int
    end_ns: int
    state: int


@dataclass(slots=True)
class Event:
    """An event of an ESC. ``end_ns`` None: it lasts until the end; equal to ``begin_ns``: it has no length."""

    kind: Kind
    esc: int
    begin_ns: int
    text: str
    severity: str = "status"
    remedy: str = ""
    end_ns: int | None = None
    note: str = ""
    """How it ended, where that is not obvious."""


@dataclass
class EscFlight:
    """What is known of one ESC. None: not in the recording."""

    name: str
    protocol: EscProtocol
    telemetry_ns: int = 0
    """Time with telemetry."""
    turning_ns: int | None = None
    """Time with the motor turning."""
    energy_drawn: float | None = None
    """Wh, the integral of positive power."""
    energy_returned: float | None = None
    """Wh, returned to the battery."""
    power_turning: float | None = None
    """W, mean while the motor turns."""
    counted: dict[str, float] = field(default_factory=dict)
    """By source: what a counter went up by."""
    charge_resets: int = 0
    maxima: dict[str, Extreme] = field(default_factory=dict)
    """By source."""
    minima: dict[str, Extreme] = field(default_factory=dict)
    cells: int | None = None
    rest_voltage: float | None = None
    """V of the battery before the first load."""
    load_voltage: Extreme | None = None
    """V of the battery, minimum under load."""
    gaps: int = 0
    longest_gap_ns: int = 0
    devices: list[str] = field(default_factory=list)
    """Every device seen, in words; usually one."""
    layout: str = ""
    """Of its frames."""
    segments: list[Segment] = field(default_factory=list)


@dataclass
class Flight:
    """Everything that a report shows. Times are on the clock of ``start_ns``."""

    origin_ns: int
    """The recording's first row: time 0."""
    start_ns: int
    end_ns: int
    rows: int
    escs: list[EscFlight]
    times: list[int]
    """Of the points of all lines."""
    lines: dict[tuple[int, str], list[Number]]
    """The points to draw, by ESC and source."""
    events: list[Event]
    left_out: int
    """Number of events that were only counted."""
    missing: list[str]
    """What the fields do not have, in words."""
    rows_in_bucket: int
    replayed: bool
