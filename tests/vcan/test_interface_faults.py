"""What happens to the CAN interface happens to the gateway, and heals. More faults, times and losses: the fault programme."""

import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

from vcan_tools import Candump, GatewayProcess, canopen_table, configuration, ip, wait_for

from kontronik_can_gw.desk.pty import PtyEsc


def test_a_missing_interface_and_one_without_can_fd_are_one_line_with_the_remedy(
    vcan: str, esc: PtyEsc, start_gateway: Callable[..., GatewayProcess]
) -> None:
    ip("link", "set", vcan, "down")
    ip("link", "set", vcan, "mtu", "16")
    for name, options, remedy in (
        ("nocan9", "", "ip link add nocan9 type vcan"),
        (vcan, "fd = true", f"ip link set {vcan} mtu 72"),
    ):
        gateway = start_gateway(configuration(name, [esc.path], options))
        assert gateway.wait() == 1
        assert remedy in gateway.log
        assert name in gateway.log
        assert name == vcan or len(gateway.lines) == 1


def test_commands_to_a_stopped_process_are_obeyed_when_it_goes_on(
    vcan: str, esc: PtyEsc, start_gateway: Callable[..., GatewayProcess], tmp_path: Path
) -> None:
    with Candump(vcan) as dump:
        gateway = start_gateway(configuration(vcan, [esc.path]) + canopen_table(tmp_path / "store"))
        wait_for(lambda: dump.of(0x701), "the boot-up")
        state = Path(f"/proc/{gateway.process.pid}/stat")
        gateway.process.send_signal(signal.SIGSTOP)
        wait_for(lambda: state.read_text().rpartition(")")[2].split()[0] == "T", "it has stopped")
        for frame in ("601#4000100000000000", "000#8101", "601#4018100100000000"):
            subprocess.run(["cansend", vcan, frame], check=True)
        wait_for(lambda: len(dump.of(0x601)) == 2, "the requests are on the bus")
        time.sleep(0.4)  # longer than 250 ms: a hold-up
        gateway.process.send_signal(signal.SIGCONT)
        wait_for(lambda: len(dump.of(0x581)) == 2, "both answers")
        order = [
            frame.can_id
            for frame in dump.frames
            if frame.can_id in (0x581, 0x701) and frame.data[0] != 0x7F
        ]
        assert order == [0x701, 0x581, 0x701, 0x581]
        gateway.wait_for_line("suspended")
        assert gateway.end() == 0
