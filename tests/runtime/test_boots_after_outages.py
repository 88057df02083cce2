"""Boot-ups, heartbeats and emergencies after each kind of outage, with the DBC off.

A node that boots does so once, its boot-up is its first frame, and nothing is sent that is off.
"""

import pytest
from test_can_link import (  # noqa: F401  fixtures
    ACTIVE,
    Bench,
    Kernel,
    kernel,
    locks_of_its_own,
)

from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.runtime.can.link_monitor import LinkFacts
from kontronik_can_gw.status import CanState
from kontronik_can_gw.times import MS

pytestmark = pytest.mark.promise("boot-ups")

NODES = 2
PERIOD_MS = 1000
in_both_cores = pytest.mark.parametrize("core_language", ["C", "Python"], indirect=True)


def names(frames: list[tuple[int, bytes]], node: int = 1) -> list[str]:
    """Return the frames of a node as "boot-up", "heartbeat", an emergency's code, or "PDO"."""
    found = []
    for can_id, data in frames:
        if can_id == 0x700 + node:
            found.append("heartbeat" if data[0] else "boot-up")
        elif can_id == 0x080 + node:
            found.append(data[1::-1].hex())
    return found


class Outage(Bench):
    """Nodes whose objects 1029h:1 and 1017h a master has set."""

    def __init__(
        self,
        kernel: Kernel,  # noqa: F811
        behaviour: int,
        period_ms: int = PERIOD_MS,
    ) -> None:
        super().__init__(kernel, dbc={"enabled": False}, nodes=NODES)
        self.begin()
        for node in range(1, NODES + 1):
            for data in (
                b"\x2f\x29\x10\x01" + bytes((behaviour, 0, 0, 0)),
                b"\x2b\x17\x10\x00" + period_ms.to_bytes(4, "little"),
            ):
                self.gateway.receive_frame(CanFrame(0x600 + node, data), self.now, self.now)
                self.turn(2)
        self.take()

    def after(self, cause: str, phase_ms: int = 0, node: int = 1) -> list[str]:
        """Return the names of the frames of a node in the 0.4 s after an outage."""
        self.turn(phase_ms)
        if cause == "bus-off":
            self.goes_off()
            self.turn(700)
            self.take()
            self.error_frame(CanState.ERROR_ACTIVE)
            self.changes(ACTIVE)
        elif cause == "down":
            self.changes(LinkFacts(exists=True, up=False))
            self.turn(700)
            self.changes(ACTIVE)
        else:
            self.port.frame_ns = MS // 4
            self.port.block()
            self.turn(1500)
            self.port.free()
            self.turn(1)
            self.port.frames_left()
            self.take()
        self.turn(400)
        return names(self.take(), node)


@in_both_cores
@pytest.mark.parametrize(
    ("cause", "behaviour", "first", "emergencies"),
    [
        ("bus-off", 0, "boot-up", ["8140", "0000"]),
        ("bus-off", 1, "heartbeat", ["8140", "0000"]),
        ("bus-off", 2, "heartbeat", []),
        ("down", 0, "boot-up", []),
        ("down", 1, "heartbeat", []),
        ("down", 2, "heartbeat", []),
    ],
)
@pytest.mark.parametrize("phase_ms", range(0, 1000, 100))
@pytest.mark.parametrize("node", range(1, NODES + 1))
def test_node_boots_once_and_its_boot_up_is_its_first_frame(
    kernel: Kernel,  # noqa: F811
    cause: str,
    behaviour: int,
    first: str,
    emergencies: list[str],
    phase_ms: int,
    node: int,
) -> None:
    bench = Outage(kernel, behaviour)
    frames = bench.after(cause, phase_ms, node)
    assert frames[0] == first
    assert frames.count("boot-up") == (first == "boot-up")
    assert [name for name in frames if len(name) == 4] == emergencies
    bench.can.close()


@in_both_cores
@pytest.mark.parametrize("cause", ["bus-off", "down", "blocked"])
@pytest.mark.parametrize("behaviour", [0, 1, 2])
def test_no_heartbeat_follows_an_outage_if_1017h_is_0(
    kernel: Kernel,  # noqa: F811
    cause: str,
    behaviour: int,
) -> None:
    bench = Outage(kernel, behaviour, period_ms=0)
    frames = bench.after(cause)
    assert "heartbeat" not in frames
    assert frames.count("boot-up") == (behaviour == 0 and cause != "blocked")
    assert not bench.gateway.is_held, "frames are sent again"
    bench.can.close()


@in_both_cores
def test_boot_up_that_was_lost_with_the_interface_is_repeated(
    kernel: Kernel,  # noqa: F811
) -> None:
    bench = Outage(kernel, behaviour=0)
    bench.changes(LinkFacts(exists=True, up=False))
    bench.turn(300)
    bench.changes(ACTIVE)
    bench.port_blocks = True
    bench.turn(1)
    assert names(bench.take()) == ["boot-up"]
    bench.changes(LinkFacts(exists=True, up=False))
    bench.turn(300)
    bench.port_blocks = False
    bench.changes(ACTIVE)
    bench.turn(400)
    assert names(bench.take()).count("boot-up") == 1
    bench.can.close()


@in_both_cores
def test_boot_up_that_is_held_up_by_the_bus_is_not_repeated(
    kernel: Kernel,  # noqa: F811
) -> None:
    bench = Outage(kernel, behaviour=0)
    bench.changes(LinkFacts(exists=True, up=False))
    bench.turn(300)
    bench.port_blocks = True
    bench.changes(ACTIVE)
    bench.turn(5000)
    frames = names(bench.take())
    assert frames[0] == "boot-up"
    assert frames.count("boot-up") == 1
    bench.port.free()
    bench.turn(400)
    assert "boot-up" not in names(bench.take())
    assert not bench.gateway.is_held
    bench.can.close()
