"""Random DBCs as users scale their signals: units, factors of many digits, gears and pole pairs."""

import random
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

from packer_oracle import random_info, random_live

from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.core.python_core import PythonCore
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.dbc.reader import parse_database
from kontronik_can_gw.desk.export_c import exported
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.native.core import NativeCore
from kontronik_can_gw.native.rows import NotInCore
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.times import MS

UNITS = {
    "electrical_speed": ("1/min", "rpm", "rad/s", "deg/s", "rps", "krpm"),
    "motor_speed": ("1/min", "rpm", "rad/s", "deg/s", "rps", "krpm"),
    "output_speed": ("1/min", "rpm", "rad/s", "deg/s", "rps", "krpm"),
    "battery_voltage": ("V", "mV"),
    "battery_current": ("A", "mA"),
    "battery_power": ("W", "kW", "hp", "PS"),
    "mean_cell_voltage": ("V", "mV"),
    "fet_temperature": ("degC", "K", "degF"),
    "energy_used": ("Wh", "kWh", "J", "kJ"),
    "motor_run_time": ("s", "min", "h", "ms"),
    "data_age": ("ms", "s"),
}
SPEEDS = ("electrical_speed", "motor_speed", "output_speed")
SUMS = ("energy_used", "motor_run_time", "data_age")
SOURCES = [name for name in UNITS for _ in range(1 if name in SUMS else 2)]
"""Measurements are in a DBC twice as often as sums over time."""
USUAL = ("0.0039215686", "0.3333333333", "0.0174532925", "6.1035E-05", "0.1", "0.01", "1", "0.5")


def factor(chance: random.Random, digits: int) -> str:
    """Return a factor of up to ten digits, or of ``digits`` if there are more."""
    if digits > 10:
        return f"{chance.uniform(0.001, 4):.{digits}g}"
    if chance.random() < 0.5:
        return chance.choice(USUAL)
    number = chance.randint(1, 10 ** chance.randint(1, digits) - 1)
    return f"{number / 10 ** chance.randint(0, 10):.{digits}g}"


def signals(chance: random.Random, digits: int) -> Iterator[tuple[str, str]]:
    """Yield source and line of the signals of a message of 64 bytes."""
    for number in range(chance.randint(1, 4)):
        source = chance.choice(SOURCES)
        unit = chance.choice(UNITS[source])
        if digits > 10 and number == 0:
            source, unit = chance.choice(SPEEDS), "rad/s"
        length = chance.choice((8, 10, 12, 16, 16, 16, 20, 24, 32))
        sign = chance.choice("+-")
        scale = factor(chance, digits)
        offset = chance.choice(("0", "0", "0", "-40", "0.5"))
        name = f"S{number}"
        line = f' SG_ {name} : {64 * number}|{length}@1{sign} ({scale},{offset}) [0|0] "{unit}" X'
        yield source, line


def scaled(seed: int, digits: int) -> tuple[list[EscSettings], MessageLayout]:
    """Return a random ESC and a layout that the gateway accepts."""
    chance = random.Random(seed)
    gears = [Fraction(1), Fraction(str(chance.randint(1, 2000) / 100)), Fraction("9.81818")]
    gears.append(Fraction(chance.randint(1, 120), chance.randint(1, 40)))
    escs = [EscSettings("esc1", chance.choice((1, 2, 5, 7, 10, 14, 21)), chance.choice(gears))]
    while True:
        lines = []
        bind: dict[str, str | float] = {}
        for source, line in signals(chance, digits):
            bind[line.split()[1]] = source
            lines.append(line)
        text = 'VERSION ""\nBU_: G X\nBO_ 256 M: 64 G\n' + "\n".join(lines) + "\n"
        database = parse_database(text.encode(), "scaled.dbc")
        try:
            return escs, prepare(database, "s.dbc", escs, DbcConfig(bind=bind), is_fd_allowed=True)
        except UserError:
            continue


def run(library: Any, seed: int, digits: int, frames: int = 40) -> str:
    """Compare both cores, and export. Return why the core in C cannot run, or ""."""
    escs, layout = scaled(seed, digits)
    chance = random.Random(seed)
    try:
        native = NativeCore(library, CoreSettings(escs, layout), 0)
        exported(CoreSettings(escs, layout), "licence")
    except NotInCore as error:
        return str(error)
    python = PythonCore(CoreSettings(escs, layout), 0)
    for number in range(frames):
        now = (number + 1) * 10 * MS
        reading = random_info(chance) if number % 8 == 1 else random_live(chance)
        data = encode(reading, WireLayout.V4)
        found = []
        for core in (python, native):
            core.receive(0, data, now, now)
            core.advance(now)
            found.append(core.take(now))
        assert found[0] == found[1], (seed, digits, number)
    return ""
