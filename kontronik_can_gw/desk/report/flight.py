"""The data of a recorded flight, from which the page is made. Times are ns of the recording's clock."""

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from kontronik_can_gw.desk.report.decimate import Number
from kontronik_can_gw.desk.report.fit import Resistance

Kind = Literal["error", "state", "link", "device"]


class Extreme(NamedTuple):
    """A value and the time of its first occurrence."""

    value: float
    time_ns: int


@dataclass(slots=True)
class Event:
    """An event with its duration; ``end_ns`` None: it lasts until the end. ``esc`` None: of the gateway."""

    kind: Kind
    esc: int
    begin_ns: int
    end_ns: int | None
    name: str
    """Name of the source, or of the state."""
    text: str
    """In words."""
    severity: str = ""
    remedy: str = ""
    note: str = ""
    """How it ended, where that is not obvious."""
    momentary: bool = False
    """True for an event without duration."""


class Segment(NamedTuple):
    """A period in one operating state; ``state`` is its number."""

    begin_ns: int
    end_ns: int
    state: int


@dataclass
class Summary:
    """Numbers of one ESC. None: not in the recording."""

    telemetry_ns: int = 0
    """With telemetry."""
    turning_ns: int | None = None
    """Time with the motor turning."""
    energy_counter: float | None = None
    """Wh, by the source energy_used."""
    energy_drawn: float | None = None
    """Wh, the integral of positive power."""
    energy_returned: float | None = None
    """Wh, returned to the battery."""
    charge: float | None = None
    """mAh, from the ESC's counter."""
    charge_resets: int = 0
    power_turning: float | None = None
    """W, mean while the motor turns."""
    extremes: dict[str, Extreme] = field(default_factory=dict)
    """By "max SOURCE" and "min SOURCE"."""
    cells: int | None = None
    rest_voltage: float | None = None
    """V of the battery before the first load."""
    load_voltage: Extreme | None = None
    """V of the battery, minimum under load."""
    resistance: Resistance | None = None
    losses: int | None = None
    crc_errors: int | None = None
    dropped_bytes: int | None = None
    gaps: int = 0
    longest_gap_ns: int = 0

    @property
    def energy(self) -> float | None:
        """Wh, from the counter; integrated where there is none."""
        return self.energy_drawn if self.energy_counter is None else self.energy_counter


@dataclass
class Facts:
    """Device data of an ESC from its info frames, the newest."""

    device: str | None = None
    variant: int | None = None
    firmware: str | None = None
    layout: str | None = None
    devices: list[tuple[int, str]] = field(default_factory=list)
    """Every device seen, in words, and since when; usually one."""


@dataclass
class Line:
    """A line of a plot."""

    esc: int
    quantity: int
    """Index in the plot's available quantities."""
    source: str
    values: list[Number]


@dataclass
class PlotData:
    """``plot``: index in PLOTS."""

    plot: int
    lines: list[Line]
    labels: list[str]
    """Titles of the available quantities; a line's ``quantity`` is an index of them."""


@dataclass
class Flight:
    """Everything that a report shows. Times are on the clock of ``start_ns``."""

    origin_ns: int
    """The recording's first row: time 0."""
    start_ns: int
    end_ns: int
    rows: int
    names: list[str]
    summaries: list[Summary]
    facts: list[Facts]
    times: list[int]
    plots: list[PlotData]
    segments: list[list[Segment]]
    events: list[Event]
    left_out: dict[Kind, int]
    """Numbers of events that were only counted."""
    missing: list[str]
    """Values that the DBC does not have, in words."""
    rows_in_bucket: int
    replayed: bool = False
