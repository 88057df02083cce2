"""Node-IDs and messages belong to one gateway on a machine."""

import os
import selectors
import subprocess
import sys

import pytest

from kontronik_can_gw.cli.common import assemble
from kontronik_can_gw.config import parse
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.runtime.can_side import CanSide
from kontronik_can_gw.runtime.claims import Claims, in_use, messages_claim, node_claim
from kontronik_can_gw.runtime.conditions import Conditions

CHANNEL = f"test{os.getpid()}"


def test_what_one_has_another_cannot_have_until_it_is_given_back() -> None:
    first, second = Claims(), Claims()
    names = [node_claim(CHANNEL, 5), node_claim(CHANNEL, 6), messages_claim(CHANNEL, 0x680)]
    try:
        assert first.hold(names) == []
        assert first.hold(names) == []
        assert second.hold([node_claim(CHANNEL, 6), node_claim(CHANNEL, 7)]) == [node_claim(CHANNEL, 6)]
        assert first.hold([node_claim(CHANNEL, 5)]) == []
        assert second.hold([node_claim(CHANNEL, 6), node_claim(CHANNEL, 7)]) == []
        first.close()
        assert second.hold([node_claim(CHANNEL, 5)]) == []
    finally:
        first.close()
        second.close()


def test_a_claim_ends_with_the_process_whatever_ends_it() -> None:
    code = (
        "import sys, os, signal\n"
        "from kontronik_can_gw.runtime.claims import Claims\n"
        "claims = Claims()\n"
        "print(claims.hold([sys.argv[1]]), flush=True)\n"
        "sys.stdin.read()\n"
    )
    name = node_claim(CHANNEL, 9)
    claims = Claims()
    with subprocess.Popen(
        [sys.executable, "-c", code, name], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "[]\n"
        assert claims.hold([name]) == [name]
        other.kill()
        other.wait()
    assert claims.hold([name]) == []
    claims.close()


@pytest.mark.parametrize("channel", ["can0", "/dev/ttyACM0@115200"])
def test_what_is_said_names_interface_number_and_remedy(channel: str) -> None:
    assert str(in_use(node_claim(channel, 12))).startswith(f"CANopen node 12 on {channel}: another gateway")
    assert f"CAN {channel}: another gateway" in str(in_use(messages_claim(channel, 0x680)))
    assert "from 680h on" in str(in_use(messages_claim(channel, 0x680)))


@pytest.mark.parametrize("dbc", [True, False])
def test_a_second_gateway_with_the_same_node_or_messages_is_refused_before_it_opens_the_bus(dbc: bool) -> None:
    tables = {
        "can": {"channel": CHANNEL},
        "dbc": {"enabled": dbc},
        "canopen": {"enabled": not dbc, "node_id": 42, "store": "/nowhere"},
        "esc": [{"port": "p"}],
    }
    loaded = assemble(parse(tables, "test"))
    sides = []
    try:
        for _ in range(2):
            gateway = Gateway(loaded.escs, loaded.layout, 0, canopen=loaded.canopen)
            selector = selectors.DefaultSelector()
            sides.append(CanSide(loaded.config.can, gateway, selector, Conditions()))
        sides[0].open(0, wait=True)
        with pytest.raises(RunError, match=f"messages from 680h|CANopen node 42 on {CHANNEL}"):
            sides[1].open(0, wait=True)
        sides[0].close()
        sides[1].open(0, wait=True)
    finally:
        for side in sides:
            side.close()


def test_an_overlong_channel_is_no_trouble() -> None:
    claims, other = Claims(), Claims()
    channel = f"/dev/serial/by-id/{CHANNEL}" + "x" * 300
    names = [node_claim(channel, 1), node_claim(channel, 2), messages_claim(channel, 0x680)]
    assert claims.hold(names) == []
    assert other.hold([*names, node_claim(channel + "y", 1)]) == names
    claims.close()
    other.close()
