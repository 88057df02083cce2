"""What is known of a recorded flight: what the page and the pictures are made of. Times are ns of the recording's clock."""

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from kontronik_can_gw.desk.report.decimate import Number
from kontronik_can_gw.desk.report.fit import Resistance

Kind = Literal["error", "state", "link", "device"]


class Extreme(NamedTuple):
    """A value and when it stood first."""

    value: float
    time_ns: int


@dataclass(slots=True)
class Event:
    """Something that began, and ended or was still so at the end (``end_ns`` None). ``esc`` None: of the gateway."""

    kind: Kind
    esc: int
    begin_ns: int
    end_ns: int | None
    name: str
    """As signals are bound to it, or a state's name."""
    text: str
    """In words."""
    severity: str = ""
    remedy: str = ""
    note: str = ""
    """How it ended, where that is not plain."""
    momentary: bool = False
    """It has no length."""


class Segment(NamedTuple):
    """A stretch of one operating state; ``state`` is its number."""

    begin_ns: int
    end_ns: int
    state: int


@dataclass
class Summary:
    """Numbers of one ESC. None: the recording does not tell."""

    telemetry_ns: int = 0
    """With telemetry."""
    turning_ns: int | None = None
    """With the motor turning."""
    energy_counter: float | None = None
    """Wh, by the source energy_used."""
    energy_drawn: float | None = None
    """Wh, the positive power integrated."""
    energy_returned: float | None = None
    """Wh, given back to the battery."""
    charge: float | None = None
    """mAh by the ESC's counter."""
    charge_resets: int = 0
    power_turning: float | None = None
    """W, mean while the motor turns."""
    extremes: dict[str, Extreme] = field(default_factory=dict)
    """By "max SOURCE" and "min SOURCE"."""
    cells: int | None = None
    rest_voltage: float | None = None
    """V of the battery before the first load."""
    load_voltage: Extreme | None = None
    """V of the battery, least under load."""
    resistance: Resistance | None = None
    losses: int | None = None
    crc_errors: int | None = None
    dropped_bytes: int | None = None
    gaps: int = 0
    longest_gap_ns: int = 0

    @property
    def energy(self) -> float | None:
        """Wh: the counter's, integrated where there is none."""
        return self.energy_drawn if self.energy_counter is None else self.energy_counter


@dataclass
class Facts:
    """What an ESC is, by its info frames: newest known."""

    device: str | None = None
    variant: int | None = None
    firmware: str | None = None
    layout: str | None = None
    devices: list[tuple[int, str]] = field(default_factory=list)
    """Each that there was, in words, and since when; one where none was changed."""


@dataclass
class Line:
    """A line of a plot."""

    esc: int
    quantity: int
    """Index among the plot's quantities that there are."""
    source: str
    values: list[Number]


@dataclass
class PlotData:
    """``plot``: index in PLOTS."""

    plot: int
    lines: list[Line]
    labels: list[str]
    """Of the quantities that there are; a line's ``quantity`` is an index of it."""


@dataclass
class Flight:
    """All that a report shows. Times count from ``start_ns``'s clock."""

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
    """Events that were only counted."""
    missing: list[str]
    """What the DBC does not have, in words."""
    rows_in_bucket: int
    replayed: bool = False
