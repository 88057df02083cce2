"""The DBCs of real cars in opendbc, each with each of its nodes.

All refusals are plain lines, and the remaining messages are sent as cantools reads them. The test
does the same as a user: it binds signals by their unit, sends start values in all others, and
leaves out the refused messages with ``dbc.messages``, as the refusals advise.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from cantools.database.can import Database, Message, Signal
from dbc_bench import gateway_with, packed

from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.dbc.reader import load_database
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc import values
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.signals.plan import MessageLayout, SignalPlan
from kontronik_can_gw.signals.units import conversion, says_nothing

pytestmark = pytest.mark.promise("dbc-as-it-is")

opendbc = pytest.importorskip(
    "opendbc", reason="opendbc refuses Python 3.13: run it by an older one"
)
FILES = sorted((Path(opendbc.__file__).parent / "dbc").rglob("*.dbc"))
SAMPLE = (
    "tesla_can",
    "rivian_primary_actuator",
    "mazda_2017",
    "gm_global_a_powertrain",
    "luxgen_s5_2015",
)
LIVE = LiveData(
    electrical_speed=21_000,
    battery_voltage=1234,
    battery_current=56,
    consumed_charge=78,
    pwm_input=1500,
    throttle=42,
    power_stage_temperature=33,
)
VALUES = {
    "motor_speed": Fraction(3000),
    "battery_voltage": Fraction("12.34"),
    "battery_current": Fraction("5.6"),
    "consumed_charge": Fraction(78),
    "pwm_input": Fraction(1500),
    "throttle": Fraction(42),
    "power_stage_temperature": Fraction(33),
}
"""The values of ``LIVE`` in their units."""
ESCS = (EscSettings("esc1", 7),)


def source_of(signal: Signal) -> str | None:
    """Return the name of the value to which the unit of a signal fits. None if there is none."""
    unit = signal.unit or ""
    if signal.length < 2 or signal.is_multiplexer or signal.is_float or says_nothing(unit):
        return None
    fitting = (name for name in VALUES if conversion(values.VALUES[name].unit, unit) is not None)
    return next(fitting, None)


def by_unit(messages: Iterable[Message]) -> dict[str, str]:
    """Return the bindings of the signals whose unit fits to a value."""
    found = {}
    for message in messages:
        for signal in message.signals:
            source = source_of(signal)
            if source is not None:
                found[f"{message.name}.{signal.name}"] = source
    return found


def prepared(
    database: Database, file: str, settings: DbcConfig
) -> tuple[MessageLayout | None, list[str]]:
    """Return the layout of a gateway and no lines, or the lines of the refusal."""
    try:
        return prepare(database, file, ESCS, settings, True), []
    except UserError as error:
        for line in error.problems:
            assert line.startswith((file, "dbc."))
            assert "\n" not in line
            assert len(line) < 600
        return None, list(error.problems)


def accepted(file: Path) -> Iterator[tuple[Database, MessageLayout, DbcConfig]]:
    """Yield database, layout and settings for each node of a DBC, if one of its messages is sent.

    The assertions check the refusals.
    """
    name = file.name
    try:
        database = load_database(file)
    except UserError as error:
        (line,) = error.problems
        assert name in line
        assert "\n" not in line
        assert len(line) < 600
        return
    nodes: set[str] = set()
    for message in database.messages:
        nodes |= set(message.senders)
    for node in sorted(nodes):
        prepared(database, name, DbcConfig(node=node))
        ours = [message for message in database.messages if node in message.senders]
        settings = DbcConfig(node=node, unbound="start_value", bind=by_unit(ours))
        layout, refused = prepared(database, name, settings)
        assert all("no such source" not in line for line in refused)
        if refused:
            places = [re.match(rf"{re.escape(name)}: (\w+)", line) for line in refused]
            bad = {found[1] for found in places if found}
            left = [message for message in ours if message.name not in bad]
            if not left:
                continue
            chosen = tuple(message.name for message in left)
            settings = replace(settings, bind=by_unit(left), messages=chosen)
            layout, refused = prepared(database, name, settings)
        assert layout is not None, refused
        yield database, layout, settings


def check_file(file: Path) -> None:
    for database, layout, settings in accepted(file):
        check_frames(database, layout, settings.bind)


def check_frames(
    database: Database, layout: MessageLayout, bound: Mapping[str, str | float]
) -> None:
    """Assert that each value is the nearest step, and that start values are as in the file.

    A value may be wrong only if it is outside the range of the signal.
    """
    gateway = gateway_with(layout, LIVE)
    for plan in layout.messages:
        of = database.get_message_by_name(plan.name)
        # the codec of cantools needs sorted signals, and our reader does not sort them
        message = Message(
            plan.can_id,
            of.name,
            of.length,
            of.signals,
            is_extended_frame=plan.extended,
            strict=False,
        )
        for page in plan.pages:
            data = packed(plan, gateway, page=page)
            read = message.decode_simple(data, decode_choices=False, scaling=False)
            planned = {s.name: s for s in plan.signals if s.page in (None, page)}
            for signal in message.signals:
                if signal.name not in read:
                    continue
                source = bound.get(f"{plan.name}.{signal.name}")
                check_signal(signal, planned[signal.name], source, read[signal.name])


def check_signal(
    signal: Signal,
    planned: SignalPlan,
    source: str | float | None,
    raw: Any,
) -> None:
    if not isinstance(source, str):
        if planned.is_unbound and planned.not_available != planned.constant:
            assert raw == (signal.raw_initial or 0)
        return
    converted = conversion(values.VALUES[source].unit, signal.unit or "")
    assert converted is not None
    value = float(VALUES[source] * converted[0] + converted[1])
    steps = (value - float(signal.offset)) / float(signal.scale)
    if planned.low + 1 < steps < planned.high - 1:
        assert abs(float(raw) - steps) <= 0.5 + 1e-6, signal.name
    elif not planned.low - 1 <= steps <= planned.high + 1:
        assert raw == planned.error


@pytest.mark.parametrize("file", [f for f in FILES if f.stem in SAMPLE], ids=lambda file: file.stem)
def test_real_dbc_is_sent_or_refused_with_reasons(file: Path) -> None:
    check_file(file)


@pytest.mark.extended
@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_real_dbc_is_sent_or_refused_with_reasons(file: Path) -> None:
    check_file(file)
