"""118 DBCs of real cars (opendbc) with each of their nodes: nothing but plain refusals, and what is left is sent as cantools reads it.

A person's way is gone: signals with a unit of ours are bound by it, the others hold start values, and what is refused is left out by
``dbc.messages`` as the refusals say.
"""

import re
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import opendbc  # type: ignore[import-untyped]
import pytest
from cantools.database.can import Database, Message, Signal

from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.dbc.reader import load_database
from kontronik_can_gw.dbc.settings import DbcSettings
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc import values
from kontronik_can_gw.esc.kontronik.codec import Layout as WireLayout
from kontronik_can_gw.esc.kontronik.codec import encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import MS, EscSettings
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.signals.packer import compile_pack
from kontronik_can_gw.signals.plan import Layout
from kontronik_can_gw.signals.units import conversion, says_nothing

FOLDER = Path(opendbc.__file__).parent / "dbc"
FILES = sorted(FOLDER.rglob("*.dbc"))
SAMPLE = [
    "tesla_can",
    "rivian_primary_actuator",
    "mazda_2017",
    "gm_global_a_powertrain",
    "luxgen_s5_2015",
]
ESC = EscSettings("esc1", 7)
LIVE = LiveData(electrical_speed=21_000, battery_voltage=1234, battery_current=56, consumed_charge=78, pwm_input=1500, throttle=42,
                power_stage_temperature=33)  # fmt: skip
VALUES = {name: Fraction(value) for name, value in (
    ("motor_speed", 3000), ("battery_voltage", "12.34"), ("battery_current", "5.6"), ("consumed_charge", 78), ("pwm_input", 1500),
    ("throttle", 42), ("power_stage_temperature", 33))}  # fmt: skip


def by_unit(messages: list[Message]) -> Iterator[tuple[str, str, Signal]]:
    """Key, source and signal of what a unit gives a meaning."""
    for message in messages:
        for signal in message.signals:
            if (
                signal.length < 2
                or signal.is_multiplexer
                or signal.is_float
                or says_nothing(signal.unit or "")
            ):
                continue
            for name in VALUES:
                if conversion(values.VALUES[name].unit, signal.unit or "") is not None:
                    yield f"{message.name}.{signal.name}", name, signal
                    break


def as_people_do(
    database: Database, file: str, node: str
) -> tuple[Layout | None, dict[str, str], list[str]]:
    """What can be sent, how it is bound, and the refusals on the way."""
    ours = [message for message in database.messages if node in message.senders]
    bind: dict[str, str | float] = {key: name for key, name, _ in by_unit(ours)}
    settings = DbcSettings(bind, node, unbound="start_value")
    try:
        return (
            prepare(database, file, [ESC], settings, True)[1],
            {k: str(v) for k, v in bind.items()},
            [],
        )
    except UserError as error:
        refused = list(error.problems)
    bad = {found[1] for line in refused if (found := re.match(rf"{re.escape(file)}: (\w+)", line))}
    left = tuple(message.name for message in ours if message.name not in bad)
    if not left:
        return None, {}, refused
    kept = {key: str(name) for key, name in bind.items() if key.partition(".")[0] in left}
    settings = DbcSettings(dict(kept), node, unbound="start_value", messages=left)
    return prepare(database, file, [ESC], settings, True)[1], kept, refused


def check_line(line: str, file: str) -> None:
    """One line that names its place."""
    assert (file in line or line.startswith("dbc.")) and "\n" not in line and len(line) < 600


def check_file(file: Path) -> None:
    name = file.name
    try:
        database = load_database(file)
    except UserError as error:
        (line,) = error.problems
        check_line(line, name)
        return
    for node in sorted({sender for message in database.messages for sender in message.senders}):
        with_nothing_said = refusals(database, name, node)
        assert all(
            line.startswith((name, "dbc.")) and "\n" not in line and len(line) < 600
            for line in with_nothing_said
        )
        layout, bound, refused = as_people_do(database, name, node)
        assert all(line.startswith(name) and "no such source" not in line for line in refused)
        if layout is not None:
            check_frames(database, layout, bound)


def refusals(database: Database, file: str, node: str) -> tuple[str, ...]:
    try:
        prepare(database, file, [ESC], DbcSettings(node=node), True)
    except UserError as error:
        return error.problems
    return ()


def check_frames(database: Database, layout: Layout, bound: dict[str, str]) -> None:
    """Each value is the nearest step to the truth, or outside the signal's range; a start value is what the file says."""
    gateway = Gateway([ESC], layout, 0)
    gateway.receive_bytes(0, encode(LIVE, WireLayout.V4), 50 * MS, 50 * MS)
    for plan in layout.messages:
        # cantools' codec wants sorted signals, which our loading does not give it
        of = database.get_message_by_name(plan.name)
        message = Message(
            of.frame_id,
            of.name,
            of.length,
            of.signals,
            is_extended_frame=plan.extended,
            strict=False,
        )
        for page in plan.pages:
            bits = compile_pack(plan)(gateway.escs, gateway.status, 50 * MS, 0, page or 0)
            data = bits.to_bytes(plan.length, "little")
            read: dict[str, Any] = dict(
                message.decode_simple(data, decode_choices=False, scaling=False)
            )
            for signal in (signal for signal in message.signals if signal.name in read):
                raw, source = read[signal.name], bound.get(f"{plan.name}.{signal.name}")
                (planned,) = (
                    p for p in plan.signals if p.name == signal.name and p.page in (None, page)
                )
                if source is None:
                    start = signal.raw_initial
                    assert (
                        not planned.unbound
                        or raw == (start or 0)
                        or planned.not_available == planned.constant
                    )
                    continue
                factor, offset = conversion(values.VALUES[source].unit, signal.unit or "") or (
                    Fraction(0),
                    Fraction(0),
                )
                steps = (float(VALUES[source] * factor + offset) - float(signal.offset)) / float(
                    signal.scale
                )
                if planned.low + 1 < steps < planned.high - 1:
                    assert abs(float(raw) - steps) <= 0.5 + 1e-6, f"{plan.name}.{signal.name}"
                elif not planned.low - 1 <= steps <= planned.high + 1:
                    assert raw == planned.error


@pytest.mark.parametrize("name", SAMPLE)
def test_a_real_dbc_is_sent_or_refused_in_words(name: str) -> None:
    (file,) = [file for file in FILES if file.stem == name]
    check_file(file)


@pytest.mark.extended
@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_real_dbc_is_sent_or_refused_in_words(file: Path) -> None:
    check_file(file)


def test_a_diesel_of_vw_can_be_worked_with_by_the_keys_of_the_configuration() -> None:
    """250 refusals in 0.5.0."""
    database = load_database(FOLDER / "vw_mqb.dbc")
    settings = DbcSettings(
        {"MO_Drehzahl_01": "motor_speed", "Motor_12_CRC": 0, "MO_Mom_neg_verfuegbar": 1},
        "Motor_Diesel_MQB",
        messages=("Motor_12", "Motor_14"),
        unbound="start_value",
    )
    layout = prepare(database, "vw_mqb.dbc", [ESC], settings)[1]
    assert [plan.name for plan in layout.messages] == ["Motor_12", "Motor_14"]
    gateway = Gateway([ESC], layout, 0)
    gateway.receive_bytes(0, encode(LIVE, WireLayout.V4), 50 * MS, 50 * MS)
    data = compile_pack(layout.messages[0])(gateway.escs, gateway.status, 50 * MS, 9, 0).to_bytes(
        8, "little"
    )
    read = database.get_message_by_name("Motor_12").decode_simple(data, decode_choices=False)
    assert (read["MO_Drehzahl_01"], read["Motor_12_BZ"], read["MO_Mom_neg_verfuegbar"], read["Motor_12_CRC"]) == (
        3000, 9, 1, 0,
    )  # fmt: skip
