"""The packers against cantools and against an oracle that counts bits one by one, over thousands of random layouts."""

import math
import os
import random
from collections.abc import Sequence
from fractions import Fraction
from functools import cache
from typing import Any

import pytest
from cantools.database.can import Database
from packer_oracle import (
    KNOWN,
    UNITS,
    LayoutMaker,
    Msg,
    Sig,
    bindings,
    dbc_text,
    get,
    put,
    random_escs,
    random_gateway,
    read,
)

from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.dbc.settings import DbcSettings
from kontronik_can_gw.esc.kontronik.codec import Layout as WireLayout
from kontronik_can_gw.esc.kontronik.codec import encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.stream import EscStream
from kontronik_can_gw.esc.telemetry import MS, EscSettings, EscTelemetry
from kontronik_can_gw.esc.values import VALUES
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway_status import GatewayStatus
from kontronik_can_gw.signals.packer import compile_frame, compile_pack, float_of, ratio
from kontronik_can_gw.signals.plan import MessagePlan

ESCS = (
    EscSettings("left", pole_pairs=7, gear=Fraction(31, 4), timeout_ns=250 * MS),
    EscSettings("right", pole_pairs=1, gear=Fraction(1), cell_count=12, timeout_ns=100 * MS),
)
FILES = int(os.environ.get("PACKER_FILES", "110"))
MESSAGES = 30
"""Each file holds so many messages: 110 files are 3300 layouts."""
ROUNDS = 3


def compiled(
    messages: list[Msg], database: Database, escs: tuple[EscSettings, ...] = ESCS
) -> dict[str, MessagePlan]:
    layout = prepare(database, "random.dbc", escs, DbcSettings(bindings(messages)), fd_allowed=True)
    return {plan.name: plan for plan in layout.messages}


State = tuple[Sequence[EscTelemetry], GatewayStatus, int]


def check_frame(
    message: Msg, page: int | None, data: bytes, database: Database, state: State
) -> None:
    """One frame against the oracle, and against what cantools reads in it and would have sent itself."""
    escs, gateway, now = state
    expected_bytes = bytearray(message.length)
    raws: dict[str, Any] = {}
    physicals: dict[str, Any] = {}
    compared: list[tuple[Sig, bool]] = []
    for signal in message.page_of(page):
        raw = get(
            data, signal.start, signal.length, signal.little, signal.signed and not signal.is_float
        )
        about = f"{message.name} {signal.line} of {signal.source} page {page}: {raw}"
        put(expected_bytes, raw, signal.start, signal.length, signal.little)
        if signal.mux == "M":
            assert raw == (page or 0), about
            raws[signal.name] = physicals[signal.name] = raw
        elif signal.is_float:
            assert signal.float_is_right(raw, escs[signal.esc], gateway, now), about
            raws[signal.name] = number = float_of(raw, signal.length)
            physicals[signal.name] = number * float(signal.factor) + float(signal.offset)
        else:
            allowed = signal.allowed(escs[signal.esc], gateway, now)
            assert raw in allowed, f"{about}, not {allowed}"
            raws[signal.name] = raw
            physical, is_half = physical_for_cantools(signal, raw, state)
            physicals[signal.name] = float(physical) if physical.denominator != 1 else int(physical)
            compared.append((signal, is_half))
    assert bytes(expected_bytes) == data, f"{message.name}: bits outside its signals"
    theirs = database.get_message_by_name(message.name)
    decoded = theirs.decode(data, decode_choices=False, scaling=False)
    assert isinstance(decoded, dict)
    assert all(same(decoded[name], raw) for name, raw in raws.items()), message.name
    if any(isinstance(raw, float) and math.isnan(raw) for raw in raws.values()):
        return  # cantools does not encode NaN
    assert theirs.encode(raws, scaling=False, strict=False) == data, message.name
    encoded = theirs.encode(physicals, scaling=True, strict=False)
    for signal, is_half in compared:
        other = get(encoded, signal.start, signal.length, signal.little, signal.signed)
        if abs(raws[signal.name]) < SAFE:
            apart = abs(raws[signal.name] - other)
            assert apart <= is_half, (
                f"{message.name} {signal.line}: {raws[signal.name]}, cantools {other}"
            )


SAFE = 1 << 45
"""Up to here the doubles that cantools reckons with are exact enough."""


def physical_for_cantools(signal: Sig, raw: int, state: State) -> tuple[Fraction, bool]:
    """The true physical value where it was sent as such, else what stands in the frame; and whether it lies halfway."""
    escs, gateway, now = state
    factor, offset = Fraction(signal.factor), Fraction(signal.offset)
    if abs(raw) >= SAFE:
        return offset, False
    known = KNOWN[signal.source]
    true = None if known.names or known.rolls else signal.physical(escs[signal.esc], gateway, now)
    low, high = signal.limits
    if true is None or not low < raw < high or abs((true - offset) / factor - raw) > Fraction(1, 2):
        return raw * factor + offset, False
    exact = (true - offset) / factor
    return true, abs(abs(exact - math.floor(exact)) - Fraction(1, 2)) < Fraction(1, 10**6)


def same(a: Any, b: Any) -> bool:
    return bool(a == b) or (isinstance(b, float) and math.isnan(b) and math.isnan(a))


def test_a_ratio_beyond_a_double_is_infinite() -> None:
    assert ratio(-(10**400), 3) == float("-inf")
    assert ratio(10**400, 3) == float("inf")
    assert ratio(1, 4) == 0.25


@pytest.mark.parametrize("seed", range(FILES))
def test_every_random_layout_is_packed_as_the_oracle_and_cantools_say(seed: int) -> None:
    rng = random.Random(seed)
    maker = LayoutMaker(rng, ESCS)
    messages = [maker.message() for _ in range(MESSAGES)]
    text = dbc_text(messages)
    database = read(text)
    plans = compiled(messages, database)
    assert len(plans) == MESSAGES
    makers = {name: compile_frame(plan) for name, plan in plans.items()}
    for message in messages:
        plan = plans[message.name]
        assert (plan.can_id, plan.extended, plan.length) == (
            message.can_id,
            message.extended,
            message.length,
        )
        assert list(plan.pages) == message.pages
    for _ in range(ROUNDS):
        escs, now = random_escs(rng, ESCS, rng.randrange(10**15))
        gateway = random_gateway(rng, now)
        for message in messages:
            for place, page in enumerate(message.pages):
                frame = makers[message.name](escs, gateway, now, 0, place)
                plan = plans[message.name]
                assert frame == CanFrame(plan.can_id, frame.data, plan.extended, plan.fd, place)
                check_frame(message, page, frame.data, database, (escs, gateway, now))


def test_the_oracle_knows_every_source_and_no_other() -> None:
    assert set(KNOWN) == set(VALUES)


# --- each source alone, each unit alone ---------------------------------------------------------------------------------


@cache
def wide_signals() -> tuple[list[Msg], Database, dict[str, MessagePlan]]:
    """Every source in every unit it can have, in a double that loses nothing and in 64 signed bits."""
    messages: list[Msg] = []
    for source, known in KNOWN.items():
        for number, (unit, scale, shift) in enumerate(UNITS[known.unit]):
            for is_float in (False, True):
                if is_float and (known.rolls or known.names):
                    continue
                signed = not known.rolls
                signal = Sig(
                    "Value",
                    0,
                    64,
                    True,
                    signed,
                    is_float,
                    "1" if known.rolls or known.names else "0.01",
                )
                signal.unit, signal.conversion, signal.source = unit, (scale, shift), source
                signal.bind = source if known.gateway else f"left.{source}"
                messages.append(
                    Msg(f"{source}_{number}_{is_float:d}", len(messages) + 1, 8, [signal])
                )
    database = read(dbc_text(messages))
    return messages, database, compiled(messages, database)


@pytest.mark.parametrize("seed", range(8))
def test_every_source_is_right_in_every_unit(seed: int) -> None:
    messages, database, plans = wide_signals()
    rng = random.Random(seed)
    escs, now = random_escs(rng, ESCS, rng.randrange(10**15))
    gateway = random_gateway(rng, now)
    for message in messages:
        data = compile_pack(plans[message.name])(escs, gateway, now, 0, 0).to_bytes(8, "little")
        check_frame(message, None, data, database, (escs, gateway, now))


# --- floats ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("voltage", "sent"), [(9_999, 99.99), (10_000, 100), (10_001, math.nan)])
def test_a_float_outside_its_limits_is_sent_as_error(voltage: int, sent: float) -> None:
    signal = Sig("BatteryVoltage", 0, 64, signed=True, is_float=True, maximum="100", unit="V")
    message = Msg("EscPower", 1, 8, [signal])
    plan = compiled([message], read(dbc_text([message])), ESCS[:1])["EscPower"]
    esc = EscStream(ESCS[0], 0)
    list(esc.receive_each(encode(LiveData(battery_voltage=voltage), WireLayout.V4), 0, 0))
    assert same(float_of(compile_pack(plan)([esc], GatewayStatus(), 0, 0, 0), 64), sent)
