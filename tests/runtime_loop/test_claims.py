"""Node-IDs and messages belong to one gateway on a machine."""

import os
import subprocess
import sys

import pytest

from kontronik_can_gw.runtime.claims import Claims, in_use, messages_claim, node_claim

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


def test_an_overlong_channel_is_no_trouble() -> None:
    claims = Claims()
    assert claims.hold([node_claim("x" * 300, 1)]) == []
    claims.close()
