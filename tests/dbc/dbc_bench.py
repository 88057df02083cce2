"""A DBC as people write it: compiled, refused, and what its messages hold."""

import re
from collections.abc import Sequence
from typing import Any

import pytest
from cantools.database.can import Database

from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.dbc.reader import parse_database
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.kontronik.codec import Layout as WireLayout
from kontronik_can_gw.esc.kontronik.codec import encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.signals.packer import compile_pack
from kontronik_can_gw.signals.plan import Layout, MessagePlan
from kontronik_can_gw.times import MS


def check_comments(database: Database) -> None:
    """Everything has a sentence as comment, without what a parser may take for syntax."""
    owners: list[Any] = [database.buses[0], *database.nodes, *database.messages]
    owners += [signal for message in database.messages for signal in message.signals]
    for text in (str(owner.comment) for owner in owners):
        assert len(text) >= 10 and text.endswith("."), text
        assert not re.search(r"[;\\]|\b[A-Z]+_\B", text), text


NOW = 50 * MS
FILE = "my_car.dbc"


def compiled(text: str, names: Sequence[str] = ("esc1",), **settings: Any) -> Layout:
    """The layout of a DBC for ESCs of these names. ``settings``: fields of DbcConfig."""
    escs = [EscSettings(name, 7) for name in names]
    database = parse_database(text.encode(), FILE)
    return prepare(database, FILE, escs, DbcConfig(**settings), fd_allowed=True)


def refused(text: str, names: Sequence[str] = ("esc1",), **settings: Any) -> list[str]:
    """What ``compiled`` refuses these with: plain lines, each with its place."""
    with pytest.raises(UserError) as caught:
        compiled(text, names, **settings)
    assert caught.value.exit_code == 2
    lines = list(caught.value.problems)
    assert lines
    for line in lines:
        assert line.startswith((f"{FILE}: ", "dbc.")) and FILE in line, line
        assert "\n" not in line and len(line) < 600, line
    return lines


def gateway_with(layout: Layout, *lives: LiveData) -> Gateway:
    """A gateway whose ESCs, called esc1 and so on, have just sent this; without: one that is not heard."""
    names = [f"esc{number}" for number in range(1, max(1, len(lives)) + 1)]
    gateway = Gateway([EscSettings(name, 7) for name in names], layout, 0)
    for esc, live in enumerate(lives):
        gateway.receive_bytes(esc, encode(live, WireLayout.V4), NOW, NOW)
    return gateway


def packed(plan: MessagePlan, gateway: Gateway, page: int | None = None) -> bytes:
    """What a message holds now."""
    bits = compile_pack(plan)(gateway.escs, gateway.status, NOW, 0, plan.pages.index(page))
    return bits.to_bytes(plan.length, "little")
