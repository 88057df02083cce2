"""Every value that can be published: name, unit, type, where it comes from. DBC signals (and later CANopen objects) bind to these.

A source's value is ``expression`` in whole steps, ``per_unit`` steps to one ``unit``; it is Python text over ``esc`` (EscTelemetry),
``live`` (LiveData), ``info`` (InfoData), ``gateway`` (GatewayStatus) and ``now``, compiled into the packers at start.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from fractions import Fraction

from kontronik_can_gw.esc.kontronik.fields import DataType, InfoData, LiveData, rows
from kontronik_can_gw.esc.kontronik.states import (
    Device,
    ErrorBit,
    OperatingError,
    OperatingState,
    SelfTestError,
)
from kontronik_can_gw.esc.telemetry import MS, MW_NS_PER_WH, SECOND, EscSettings, LinkState


class Group(Enum):
    """When a source is available: with fresh live data, with info of the present device, or always."""

    LIVE = "live"
    INFO = "info"
    LINK = "link"
    GATEWAY = "gateway"


class GatewayState(IntEnum):
    STARTING = 0
    RUNNING = 1
    STOPPING = 2
    REPLAY = 3


class CanState(IntEnum):
    UNKNOWN = 0
    ERROR_ACTIVE = 1
    ERROR_WARNING = 2
    ERROR_PASSIVE = 3
    BUS_OFF = 4
    DOWN = 5


@dataclass(slots=True)
class GatewayStatus:
    """What the gateway knows of itself; the runtime writes the CAN side."""

    state: GatewayState = GatewayState.STARTING
    can_state: CanState = CanState.UNKNOWN
    esc_count: int = 0
    escs_ok: int = 0
    started_ns: int = 0
    sent_frames: int = 0
    replaced_frames: int = 0
    send_failures: int = 0
    received_frames: int = 0
    bus_off_count: int = 0
    dropped_frames: int = 0
    """Frames to be sent in order that were lost: too many waited, or the interface was down."""
    id_conflicts: int = 0
    """Frames of others with ids that only this gateway may send with."""


@dataclass(frozen=True)
class Source:
    """A publishable value. ``low``..``high`` in steps (None: no bound); ``names`` for an enumeration; ``bit`` for a flag of a word."""

    name: str
    unit: str
    group: Group
    expression: str
    per_unit: Fraction = Fraction(1)
    low: int | None = None
    high: int | None = None
    names: Mapping[int, str] = field(default_factory=dict)
    bit: int | None = None
    supplied: str | None = None
    """Python text: false where the device does not supply the value."""
    rolls: bool = False
    """A counter that starts again at 0 behind the greatest value the signal can hold."""
    whole: bool = True
    """False where the expression gives a float."""
    pace: Group | None = None
    """What the value changes with, where that is not its group."""


def _wire_sources(data: DataType, group: Group) -> list[Source]:
    found = []
    for index, (name, row) in enumerate(rows(data).items()):
        low, high = row.type_range
        expression = f"{group.value}[{index}]"
        supplied = f"esc.bec_current_supplied({expression})" if row.not_on else None
        found.append(
            Source(
                name,
                row.unit,
                group,
                expression,
                Fraction(row.per_unit),
                low,
                high,
                supplied=supplied,
            )
        )
    return found


def _flags(names: type[ErrorBit], group: Group, word: str) -> list[Source]:
    return [Source(bit.text, "", group, word, low=0, high=1, bit=int(bit)) for bit in names]


def _pascal(text: str) -> str:
    return "".join(part[:1].upper() + part[1:].lower() for part in text.split("_"))


def sources(settings: EscSettings) -> dict[str, Source]:
    """Every source of one ESC and of the gateway by name, with the ESC's pole pairs and gear worked in."""
    live, info, link, gateway = Group.LIVE, Group.INFO, Group.LINK, Group.GATEWAY
    speed = "live[0]"
    state = f"live[{LiveData._fields.index('operating_state')}]"
    errors = f"live[{LiveData._fields.index('operating_errors')}]"
    selftest = f"info[{InfoData._fields.index('selftest_errors')}]"
    u32 = (1 << 32) - 1
    listed = [
        *(s for s in _wire_sources(LiveData, live) if s.name != "operating_state"),
        Source(
            "operating_state",
            "",
            live,
            state,
            low=0,
            high=255,
            names={s: s.text for s in OperatingState},
        ),
        Source("operating_state_raw", "", live, state, low=0, high=255),
        *_flags(OperatingError, live, errors),
        *(
            s
            for s in _wire_sources(InfoData, info)
            if s.name not in ("device_and_variant", "firmware_word")
        ),
        Source(
            "device", "", info, "info.device", low=0, high=63, names={d: d.text for d in Device}
        ),
        Source("device_raw", "", info, "info.device", low=0, high=63),
        Source("variant", "", info, "info.variant", low=0, high=1023),
        Source("firmware_main", "", info, "info[1] >> 8", low=0, high=255),
        Source("firmware_sub", "", info, "info[1] & 255", low=0, high=255),
        *_flags(SelfTestError, info, selftest),
        Source("motor_speed", "1/min", live, speed, Fraction(settings.pole_pairs), 0, u32),
        Source("output_speed", "1/min", live, speed, settings.pole_pairs * settings.gear, 0, u32),
        Source(
            "battery_power",
            "W",
            live,
            "live[1] * live[2]",
            Fraction(1000),
            -0xFFFF * 0x8000,
            0xFFFF * 0x7FFF,
        ),
        Source(
            "mean_cell_voltage",
            "V",
            live,
            "live[1] / esc.cells",
            Fraction(100),
            supplied="esc.cells",
            whole=False,
        ),
        Source("energy_used", "Wh", link, "esc.energy", Fraction(MW_NS_PER_WH), 0, pace=live),
        Source("motor_run_time", "s", link, "esc.run_time", Fraction(SECOND), 0, pace=live),
        Source(
            "link_state",
            "",
            link,
            "esc.link",
            low=0,
            high=5,
            names={s: _pascal(s.name) for s in LinkState},
        ),
        Source(
            "layout",
            "",
            link,
            "esc.layout",
            low=0,
            high=2,
            names={0: "Unknown", 1: "V4", 2: "Legacy"},
        ),
        Source(
            "data_age", "ms", link, "esc.age_ms(now)", low=0, supplied="esc.live_ns is not None"
        ),
        Source(
            "frame_rate",
            "Hz",
            link,
            "esc.frame_rate",
            Fraction(10),
            0,
            supplied="esc.frame_rate is not None",
        ),
        *(
            Source(name, "", link, f"esc.{path}", low=0, rolls=True)
            for name, path in (
                ("losses", "losses"),
                ("crc_errors", "counters.crc_errors"),
                ("dropped_bytes", "counters.dropped_bytes"),
                ("live_frames", "counters.live"),
                ("info_frames", "counters.info"),
                ("received_bytes", "counters.bytes"),
                ("suspect_frames", "suspect_frames"),
            )
        ),
        Source(
            "gateway_state",
            "",
            gateway,
            "gateway.state",
            low=0,
            names={s: _pascal(s.name) for s in GatewayState},
        ),
        Source(
            "can_state",
            "",
            gateway,
            "gateway.can_state",
            low=0,
            names={s: _pascal(s.name) for s in CanState},
        ),
        Source("esc_count", "", gateway, "gateway.esc_count", low=0),
        Source("escs_ok", "", gateway, "gateway.escs_ok", low=0),
        Source("uptime", "s", gateway, f"(now - gateway.started_ns) // {MS}", Fraction(1000), 0),
        *(
            Source(name, "", gateway, f"gateway.{name}", low=0, rolls=True)
            for name in (
                *("sent_frames", "replaced_frames", "send_failures"),
                *("received_frames", "bus_off_count", "dropped_frames", "id_conflicts"),
            )
        ),
    ]
    return {source.name: source for source in listed}
