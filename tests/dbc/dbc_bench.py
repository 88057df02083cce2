"""Compile a DBC as users write it, expect its refusal, and read the data of its messages."""

import re
from collections.abc import Sequence
from typing import Any

import pytest
from cantools.database.can import Database

from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.dbc.reader import parse_database
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.signals.packer import compile_pack
from kontronik_can_gw.signals.plan import MessageLayout, MessagePlan
from kontronik_can_gw.times import MS


def check_comments(database: Database) -> None:
    """Assert that each comment is a sentence without text that a parser may take for syntax."""
    owners: list[Any] = [database.buses[0], *database.nodes, *database.messages]
    for message in database.messages:
        owners += message.signals
    for owner in owners:
        text = str(owner.comment)
        assert len(text) >= 10, text
        assert text.endswith("."), text
        assert not re.search(r"[;\\]|\b[A-Z]+_\B", text), text


NOW = 50 * MS
FILE = "my_car.dbc"


def compiled(text: str, names: Sequence[str] = ("esc1",), **settings: Any) -> MessageLayout:
    """Return the layout of a DBC for ESCs of these names. ``settings`` are fields of DbcConfig."""
    escs = [EscSettings(name, 7) for name in names]
    database = parse_database(text.encode(), FILE)
    return prepare(database, FILE, escs, DbcConfig(**settings), is_fd_allowed=True)


def refused(text: str, names: Sequence[str] = ("esc1",), **settings: Any) -> list[str]:
    """Return the lines with which ``compiled`` refuses a DBC. Each line begins with its place."""
    with pytest.raises(UserError) as caught:
        compiled(text, names, **settings)
    assert caught.value.exit_code == 2
    lines = list(caught.value.problems)
    assert lines
    for line in lines:
        assert line.startswith((f"{FILE}: ", "dbc.")), line
        assert FILE in line, line
        assert "\n" not in line, line
        assert len(line) < 600, line
    return lines


def gateway_with(layout: MessageLayout, *lives: LiveData) -> Gateway:
    """Return a gateway whose ESCs (esc1, esc2 ...) have just sent this data.

    Without data the gateway has one ESC, which has sent nothing.
    """
    count = max(1, len(lives))
    escs = [EscSettings(f"esc{number}", 7) for number in range(1, count + 1)]
    gateway = Gateway(CoreSettings(escs, layout), 0)
    for esc, live in enumerate(lives):
        wire = encode(live, WireLayout.V4)
        gateway.receive_bytes(esc, wire, NOW, NOW)
    return gateway


def packed(plan: MessagePlan, gateway: Gateway, page: int | None = None) -> bytes:
    """Return the current data of a message."""
    pack = compile_pack(plan)
    place = plan.pages.index(page)
    bits = pack(gateway.escs, gateway.status, NOW, 0, place)
    return bits.to_bytes(plan.length, "little")
