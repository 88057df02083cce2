"""What happens to the CAN interface happens to the gateway, and heals. More faults, times and losses: the fault programme."""

from collections.abc import Callable

from harness import PtyPort
from vcan_tools import GatewayProcess, configuration, ip


def test_a_missing_interface_and_one_without_can_fd_are_one_line_with_the_remedy(
    vcan: str, escs: list[PtyPort], start_gateway: Callable[..., GatewayProcess]
) -> None:
    ip("link", "set", vcan, "down")
    ip("link", "set", vcan, "mtu", "16")
    for name, options, remedy in (
        ("nocan9", "", "ip link add nocan9 type vcan"),
        (vcan, "fd = true", f"ip link set {vcan} mtu 72"),
    ):
        gateway = start_gateway(configuration(name, escs, options))
        assert gateway.wait() == 1
        assert remedy in gateway.log
        assert name in gateway.log
        assert name == vcan or len(gateway.lines) == 1
