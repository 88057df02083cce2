"""The packers agree with cantools and with an oracle that counts bits, in random layouts."""

import math
import os
import random
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import pytest
from cantools.database.can import Database
from packer_oracle import (
    KNOWN,
    LayoutMaker,
    Msg,
    bindings,
    dbc_text,
    get,
    put,
    random_escs,
    random_gateway,
    read,
)

from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry
from kontronik_can_gw.esc.values import VALUES
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.signals.packer import compile_frame, float_of, ratio
from kontronik_can_gw.status import GatewayStatus
from kontronik_can_gw.times import MS

pytestmark = pytest.mark.promise("packing")

ESCS = (
    EscSettings("left", pole_pairs=7, gear=Fraction(31, 4), timeout_ns=250 * MS),
    EscSettings("right", pole_pairs=1, gear=Fraction(1), cell_count=12, timeout_ns=100 * MS),
)
FILES = int(os.environ.get("PACKER_FILES", "110"))
MESSAGES = 30
"""Messages in each file. 110 files have 3300 layouts."""
ROUNDS = 3


State = tuple[Sequence[EscTelemetry], GatewayStatus, int]


def check_frame(
    message: Msg,
    page: int | None,
    data: bytes,
    database: Database,
    state: State,
) -> None:
    """Compare one frame with the oracle, and with the values that cantools decodes."""
    escs, gateway, now = state
    expected_bytes = bytearray(message.length)
    theirs = database.get_message_by_name(message.name)
    raws: Any = theirs.decode(data, decode_choices=False, scaling=False)
    physicals: Any = theirs.decode(data, decode_choices=False)
    for signal in message.page_of(page):
        is_signed = signal.signed and not signal.is_float
        raw = get(data, signal.start, signal.length, signal.little, is_signed)
        about = f"{message.name} {signal.line} of {signal.source} page {page}: {raw}"
        put(expected_bytes, raw, signal.start, signal.length, signal.little)
        number: float = float_of(raw, signal.length) if signal.is_float else raw
        assert same(raws[signal.name], number), about
        if signal.mux == "M":
            assert raw == (page or 0), about
        elif signal.is_float:
            assert signal.float_is_right(raw, escs[signal.esc], gateway, now), about
        else:
            right = signal.right(escs[signal.esc], gateway, now)
            assert raw == right, f"{about}, not {right}"
            known = KNOWN[signal.source]
            rule = signal.rule
            value = signal.physical(escs[signal.esc], gateway, now)
            if value is None or known.names or known.rolls:
                continue
            if rule.is_value(raw) and raw != rule.error:
                apart = abs(float(value) - physicals[signal.name])
                step = abs(float(signal.factor))
                assert apart <= step / 2 + 1e-9 * max(step, abs(float(value))), about
    assert bytes(expected_bytes) == data, f"{message.name}: bits outside its signals"


def same(a: Any, b: Any) -> bool:
    if isinstance(b, float) and math.isnan(b):
        return math.isnan(a)
    return bool(a == b)


def test_ratio_beyond_a_double_is_infinite() -> None:
    assert ratio(-(10**400), 3) == float("-inf")
    assert ratio(10**400, 3) == float("inf")
    assert ratio(1, 4) == 0.25


@pytest.mark.promise("codes")
@pytest.mark.parametrize("seed", range(FILES))
def test_random_layout_is_packed_as_oracle_and_cantools_expect(seed: int) -> None:
    rng = random.Random(seed)
    maker = LayoutMaker(rng, ESCS)
    messages = [maker.message() for _ in range(MESSAGES)]
    text = dbc_text(messages)
    database = read(text)
    layout = prepare(database, "x", ESCS, DbcConfig(bind=bindings(messages)), is_fd_allowed=True)
    plans = {plan.name: plan for plan in layout.messages}
    assert len(plans) == MESSAGES
    makers = {name: compile_frame(plan) for name, plan in plans.items()}
    for message in messages:
        assert list(plans[message.name].pages) == message.pages
    for _ in range(ROUNDS):
        escs, now = random_escs(rng, ESCS, rng.randrange(10**15))
        gateway = random_gateway(rng, now)
        for message in messages:
            for place, page in enumerate(message.pages):
                frame = makers[message.name](escs, gateway, now, 0, place)
                key = (message.can_id, message.extended)
                is_fd = message.length > 8
                assert frame == CanFrame(key[0], frame.data, key[1], is_fd, place)
                assert len(frame.data) == message.length
                check_frame(message, page, frame.data, database, (escs, gateway, now))


def test_oracle_has_exactly_the_sources_of_the_package() -> None:
    assert set(KNOWN) == set(VALUES)
