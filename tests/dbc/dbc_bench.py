"""A DBC as people write it: compiled, refused, and what its messages hold."""

from collections.abc import Mapping, Sequence
from typing import Any

import pytest

from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.dbc.reader import parse_database
from kontronik_can_gw.dbc.settings import DbcSettings
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.kontronik.codec import Layout as WireLayout
from kontronik_can_gw.esc.kontronik.codec import encode
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData
from kontronik_can_gw.esc.telemetry import MS, EscSettings
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.signals.packer import compile_pack
from kontronik_can_gw.signals.plan import Layout, MessagePlan

NOW = 50 * MS
FILE = "my_car.dbc"


def compiled(
    text: str,
    names: Sequence[str] = ("esc1",),
    fd: bool = True,
    taken: Mapping[int, str] | None = None,
    **settings: Any,
) -> Layout:
    """The layout of a DBC for ESCs of these names. ``settings``: fields of DbcSettings."""
    escs = [EscSettings(name, 7) for name in names]
    database = parse_database(text.encode(), FILE)
    return prepare(database, FILE, escs, DbcSettings(**settings), fd, taken)


def refused(text: str, *arguments: Any, **more: Any) -> list[str]:
    """What ``compiled`` refuses these with: plain lines, each with its place."""
    with pytest.raises(UserError) as caught:
        compiled(text, *arguments, **more)
    assert caught.value.exit_code == 2
    lines = list(caught.value.problems)
    assert lines
    for line in lines:
        assert line.startswith((f"{FILE}: ", "dbc.")) and FILE in line, line
        assert "\n" not in line and len(line) < 600, line
    return lines


def gateway_with(layout: Layout, *lives: LiveData | None, info: InfoData | None = None) -> Gateway:
    """A gateway whose ESCs, called esc1 and so on, have just sent this."""
    lives = lives or (None,)
    gateway = Gateway([EscSettings(f"esc{n}", 7) for n in range(1, len(lives) + 1)], layout, 0)
    for esc, live in enumerate(lives):
        for data in (info, live):
            if data is not None:
                gateway.receive_bytes(esc, encode(data, WireLayout.V4), NOW, NOW)
    return gateway


def packed(plan: MessagePlan, gateway: Gateway, alive: int = 0, page: int | None = None) -> bytes:
    """What a message holds now."""
    bits = compile_pack(plan)(gateway.escs, gateway.status, NOW, alive, plan.pages.index(page))
    return bits.to_bytes(plan.length, "little")
