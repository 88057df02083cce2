"""The unpackers agree with cantools in random layouts, and values expire in a listener."""

import math
import random
from fractions import Fraction
from typing import Any

import pytest
from dbc_bench import compiled
from packer_oracle import LayoutMaker, Msg, Sig, bindings, bit_places, dbc_text, get, put, read
from test_packer_against_cantools import ESCS, MESSAGES

from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.desk.receiver.unpacker import SignalReader
from kontronik_can_gw.desk.receiver.view import View
from kontronik_can_gw.desk.recordings.layouts import layout_of_dbc
from kontronik_can_gw.frames import EXTENDED
from kontronik_can_gw.signals.plan import SignalPlan
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("packing")


def wanted(plan: SignalPlan, raw: Any, bits: int) -> Any:
    """Return the value for the raw number that cantools decodes."""
    codes = (plan.not_available, plan.error)
    if plan.is_float:
        if bits in codes or raw != raw:
            return None
        return raw * float(plan.factor) + float(plan.offset)
    as_it_stands = plan.numbers is None and plan.factor == 1 and plan.offset == 0
    if raw in codes and not (plan.length == 1 and not plan.signed and as_it_stands):
        return None
    if plan.numbers is not None:
        return plan.texts.get(raw)
    exact = Fraction(raw) * plan.factor + plan.offset
    whole = plan.factor.denominator == 1 and plan.offset.denominator == 1
    return int(exact) if whole else float(exact)


@pytest.mark.parametrize("seed", range(1000, 1020))
def test_random_frames_are_decoded_as_cantools_does(seed: int) -> None:
    rng = random.Random(seed)
    maker = LayoutMaker(rng, ESCS)
    messages = [maker.message() for _ in range(MESSAGES)]
    database = read(dbc_text(messages))
    settings = DbcConfig(bind=bindings(messages))
    layout = prepare(database, "random.dbc", ESCS, settings, is_fd_allowed=True)
    reader = SignalReader(layout)
    compared = 0
    for message, plan in zip(messages, layout.messages, strict=True):
        theirs = database.get_message_by_name(message.name)
        for _ in range(8):
            data, page = random_frame(rng, message)
            got = values_of(reader, message, data)
            raws: Any = theirs.decode(data, decode_choices=False, scaling=False)
            planned = {s.name: s for s in plan.signals if s.page in (None, page)}
            check_values(message, page, planned, got, data, raws)
            compared += len(got)
    assert compared > 300


def random_frame(rng: random.Random, message: Msg) -> tuple[bytes, int | None]:
    """Return the data of a frame, and its group."""
    size = message.length
    fills = rng.randbytes(size), bytes(size), b"\xff" * size
    data = bytearray(rng.choice(fills))
    page = rng.choice(message.pages)
    for selector in message.signals:
        if selector.mux == "M":
            for byte, bit in bit_places(selector.start, selector.length, selector.little):
                data[byte] &= ~(1 << bit)
            put(data, page or 0, selector.start, selector.length, selector.little)
    return bytes(data), page


def values_of(reader: SignalReader, message: Msg, data: bytes) -> dict[str, Any]:
    """Return the values of a frame by the names of its signals."""
    key = message.can_id | (EXTENDED if message.extended else 0)
    found = {}
    for first, values in reader.read(key, data) or ():
        columns = reader.columns[first : first + len(values)]
        for column, value in zip(columns, values, strict=True):
            found[column.name] = value
    return found


def check_values(
    message: Msg,
    page: int | None,
    planned: dict[str, SignalPlan],
    got: dict[str, Any],
    data: bytes,
    raws: Any,
) -> None:
    """Compare the values of a frame with the raw numbers that cantools decodes."""
    made = {signal.name: signal for signal in message.page_of(page) if signal.mux != "M"}
    assert set(got) == set(made)
    missing = [planned[name] for name, value in got.items() if value is None]
    for name, value in got.items():
        own = planned[name]
        place = made[name]
        bits = get(data, place.start, place.length, place.little)
        expected = wanted(own, raws[name], bits)
        if value is None and own.length == 1 and expected is not None:
            # The other values of the same UART frame are not available either.
            others = [signal for signal in missing if signal.length > 1]
            assert any(same_frame(other, own) for other in others)
        elif isinstance(expected, float) and isinstance(value, float):
            assert math.isclose(value, expected, rel_tol=1e-12), (message.name, name)
        else:
            assert value == expected, (message.name, name)


def same_frame(one: SignalPlan, other: SignalPlan) -> bool:
    """Return True if both are on the same group and from the same kind of UART frame of an ESC."""
    assert one.source is not None
    assert other.source is not None
    if one.source.group != other.source.group:
        return False
    return (one.page, one.esc) == (other.page, other.esc)


def test_error_code_of_another_signal_does_not_hide_flags() -> None:
    """If the voltage does not fit, the flag for undervoltage matters most."""
    reader = SignalReader(layout_of_dbc(shipped("dbc/kontronik_esc.dbc")).layout)
    names = [column.name for column in reader.columns]
    flag = names.index("Undervoltage")
    rows = {
        (254, 254, 0x81): 1,
        (254, 255, 0x80): 1,
        (255, 255, 0x80): None,
        (12, 12, 30): 1,
    }
    for (state, raw, temperature), expected in rows.items():
        data = bytes((1, 0, 0, state, raw, temperature, 0, 0))
        chunks = reader.read(1664, data)
        assert chunks is not None
        ((first, values),) = chunks
        assert values[flag - first] == expected


def view_of(*messages: tuple[str, int, str]) -> View:
    """Return a view of messages with one signal each, given by name, cycle in ms, send type."""
    made = []
    for number, (name, _, _) in enumerate(messages):
        signal = Sig(name, 0, 16, maximum="65533")
        made.append(Msg(f"M{number}", 100 + number, 8, [signal]))
    kinds = {"Cyclic": 0, "Event": 1, "OnChange": 2}
    more = ""
    for can_id, (_, cycle, send) in enumerate(messages, 100):
        more += f'BA_ "GenMsgCycleTime" BO_ {can_id} {cycle};\n'
        more += f'BA_ "GenMsgSendType" BO_ {can_id} {kinds[send]};\n'
    layout = compiled(dbc_text(made, more))
    return View(SignalReader(layout))


def value(view: View, source: str) -> Any:
    sources = [column.source for column in view.reader.columns]
    return view.values[sources.index(source)]


def test_slow_message_is_fresh_for_three_of_its_cycles() -> None:
    view = view_of(("losses", 5000, "Cyclic"), ("variant", 0, "OnChange"))
    for when in range(0, 60, 5):
        view.take(100, b"\1" * 8, when * SECOND)
        if not when:
            view.take(101, b"\2" * 8, 0)
        for later in (1, 3, 4.9):
            view.expire(int((when + later) * SECOND))
            assert value(view, "losses") == 0x0101
            assert value(view, "variant") == 0x0202
    view.expire(55 * SECOND + 15 * SECOND + 1)
    assert value(view, "losses") is None
    assert value(view, "variant") is None


def test_event_message_is_fresh_for_a_second() -> None:
    view = view_of(("battery_voltage", 0, "Event"), ("losses", 100, "Cyclic"))
    view.take(100, b"\1" * 8, 0)
    for when in range(0, 2000, 100):
        view.take(101, b"\1" * 8, when * MS)
        view.expire(when * MS)
        assert (value(view, "battery_voltage") is not None) == (when <= 1000)
        assert value(view, "losses") is not None
    assert view.expire(2000 * MS + 250 * MS + 1)
    assert value(view, "losses") is None
    assert not view.expire(3600 * SECOND)


@pytest.mark.parametrize("seed", range(1000, 1010))
def test_columns_of_many_frames_have_the_values_of_each_frame(seed: int) -> None:
    rng = random.Random(seed)
    maker = LayoutMaker(rng, ESCS)
    messages = [maker.message() for _ in range(MESSAGES)]
    settings = DbcConfig(bind=bindings(messages))
    random_layout = prepare(
        read(dbc_text(messages)), "random.dbc", ESCS, settings, is_fd_allowed=True
    )
    shipped_layout = layout_of_dbc(shipped("dbc/kontronik_esc.dbc")).layout
    lost = 0
    for layout in (random_layout, shipped_layout):
        for part in SignalReader(layout).parts:
            length = part.plan.length
            fills = [rng.randbytes(length) for _ in range(6)]
            fills += [bytes(length), b"\xff" * length]
            frames = [int.from_bytes(rng.choice(fills), "little") for _ in range(30)]
            rows = [part.unpacker.values(bits) for bits in frames]
            columns = [part.unpacker.column(at, frames) for at in range(part.count)]
            assert [*zip(*columns, strict=True)] == [*map(tuple, rows)]
            lost += sum(row.count(None) for row in rows)
    assert lost > 100
