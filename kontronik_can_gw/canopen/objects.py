"""Which objects show what: index and sub-index to a source, in which steps. What is not here is plain storage or a service's own object.

The objects' types, names, limits and PDO defaults are in the EDS; the sources' values, units and ranges in ``sources``.
"""

import re
from dataclasses import dataclass, replace
from fractions import Fraction

from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData, rows
from kontronik_can_gw.esc.telemetry import MS, EscSettings
from kontronik_can_gw.esc.values import Group, Source, sources
from kontronik_can_gw.signals.packer import scaled_text

U8, U16, U32 = 0xFF, 0xFFFF, 0xFFFFFFFF
LIVE, DERIVED, INFO, EXTREMES, LINK, GATEWAY = 0x2000, 0x2001, 0x2010, 0x2011, 0x2020, 0x2021
UNITS = 0x2002
SETTINGS, NODE_ID, RESET_STATISTICS = 0x2100, 0x2101, 0x2102
ERROR_CODE, VELOCITY, DC_LINK_VOLTAGE = 0x603F, 0x606C, 0x6079
_CELLS = "(esc.cells or (esc.last_info.cell_count if esc.live is None and esc.last_info is not None else 0))"
"""Number of cells; while telemetry is lost that of the last value."""


@dataclass(frozen=True)
class Bound:
    """A source as an object shows it: ``steps`` steps to one of the source's units.

    ``status``: a change of it is news by itself (errors, state, link); a PDO that carries it is sent on that change.
    """

    source: Source
    steps: Fraction
    status: bool = False

    @property
    def slope(self) -> Fraction:
        """Steps of the object for one of the source."""
        return self.steps / self.source.per_unit


def bindings(settings: EscSettings) -> dict[tuple[int, int], Bound]:
    """(index, sub-index) to source, with the ESC's pole pairs and gear worked in."""
    known = sources(settings)
    found: dict[tuple[int, int], Bound] = {}

    def bind(index: int, sub: int, source: Source, steps: int = 1, status: bool = False) -> None:
        found[index, sub] = Bound(_kept(source), Fraction(steps), status)

    for sub, (name, row) in enumerate(rows(LiveData).items(), 1):
        raw = known["operating_state_raw"] if name == "operating_state" else known[name]
        bind(LIVE, sub, raw, row.per_unit, status=name in ("operating_errors", "operating_state"))
    derived = (
        ("motor_speed", 1),
        ("output_speed", 1),
        ("battery_power", 10),
        ("energy_used", 10),
        ("mean_cell_voltage", 1000),
        ("motor_run_time", 1),
    )
    for sub, (name, steps) in enumerate(derived, 1):
        source = replace(known[name], rolls=name in ("energy_used", "motor_run_time"))
        if name == "mean_cell_voltage":
            source = replace(
                source, expression=source.expression.replace("esc.cells", _CELLS), supplied=_CELLS
            )
        bind(DERIVED, sub, source, steps)
    firmware = Source("firmware", "", Group.INFO, "info[1]", low=0, high=U16)
    for sub, source in enumerate(
        (
            known["device_raw"],
            known["variant"],
            firmware,
            known["selftest_errors"],
            known["cell_count"],
        ),
        1,
    ):
        bind(INFO, sub, source)
    extremes = list(rows(InfoData).items())[InfoData._fields.index("max_electrical_speed") :]
    for sub, (name, row) in enumerate(extremes, 1):
        bind(EXTREMES, sub, known[name], row.per_unit)
    status = "esc.link | (esc.info is not None) << 7 | (gateway.state == 3) << 6"
    bind(LINK, 1, Source("link_status", "", Group.LINK, status, low=0, high=U8), status=True)
    for sub, source in enumerate(
        (
            _counter("live_counter", "esc.counters.live", Group.LIVE),
            _age("data_age", "esc.live_ns"),
            _age("info_age", "esc.last_info_ns"),
            _counter("live_frames", "esc.counters.live - esc.base.live"),
            _counter("info_frames", "esc.counters.info - esc.base.info"),
            _counter("crc_errors", "esc.counters.crc_errors - esc.base.crc_errors"),
            _counter("line_errors", "esc.line_errors - esc.base_line_errors"),
            _counter("dropped_bytes", "esc.counters.dropped_bytes - esc.base.dropped_bytes"),
            _counter("losses", "esc.losses - esc.base_losses"),
        ),
        2,
    ):
        bind(LINK, sub, source)
    bind(LINK, 0x0B, known["frame_rate"], 10)
    bind(GATEWAY, 1, known["uptime"])
    bind(GATEWAY, 2, known["can_state"])
    for sub, name in enumerate(
        ("sent_frames", "received_frames", "send_failures", "bus_off_count", "replaced_frames"), 3
    ):
        bind(GATEWAY, sub, known[name])
    bind(GATEWAY, 8, known["esc_count"])
    bind(GATEWAY, 9, known["escs_ok"])
    bind(VELOCITY, 0, known["motor_speed"])
    bind(DC_LINK_VOLTAGE, 0, known["battery_voltage"], 1000)
    return found


def _kept(source: Source) -> Source:
    """Information of the ESC keeps its value while telemetry is lost; bit 7 of the link status tells that it is not fresh."""
    if source.group is not Group.INFO:
        return source
    supplied = "esc.last_info is not None"
    if source.supplied is not None:
        supplied += f" and {_of_last_info(source.supplied)}"
    expression = _of_last_info(source.expression)
    return replace(
        source, group=Group.LINK, expression=expression, supplied=supplied, pace=Group.INFO
    )


def _of_last_info(expression: str) -> str:
    return re.sub(r"\binfo\b", "esc.last_info", expression)


def _counter(name: str, expression: str, pace: Group | None = None) -> Source:
    return Source(name, "", Group.LINK, expression, low=0, rolls=True, pace=pace)


def _age(name: str, stamp: str) -> Source:
    """In milliseconds; FFFEh: that old or older, FFFFh: nothing has come yet."""
    expression = f"{U16} if {stamp} is None else min(max(0, now - {stamp}) // {MS}, {U16 - 1})"
    return Source(name, "ms", Group.LINK, expression, low=0, high=U16)


def reader_text(bound: Bound, high: int) -> str:
    """Python text of a function ``read(esc, live, gateway, now)``: the object's value, None where it is not supplied."""
    source = bound.source
    value = scaled_text(source.expression, bound.slope, Fraction(0), source.whole)
    lines = ["def read(esc, live, gateway, now):"]
    if source.supplied is not None:
        lines += [f"    if not ({source.supplied}):", "        return None"]
    lines.append(f"    return ({value}) % {high + 1}" if source.rolls else f"    return {value}")
    return "\n".join(lines) + "\n"
