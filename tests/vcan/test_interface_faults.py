"""What happens to the CAN interface happens to the gateway, and heals."""

import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

from vcan_tools import Candump, GatewayProcess, agrees, bench, configuration, ip, wait_for

from kontronik_can_gw.simulator import FLIGHT, EscOptions

Start = Callable[..., GatewayProcess]
QUICK = tuple(
    phase._replace(duration_s=max(0.3, phase.duration_s * 0.1), ramp_s=phase.ramp_s * 0.1) for phase in FLIGHT
)


def test_a_missing_interface_is_one_clear_line_with_the_command_that_makes_one(start_gateway: Start) -> None:
    with bench(EscOptions()) as run:
        gateway = start_gateway(configuration("nocan9", [run.ports[0].path]))
        assert gateway.process.wait(20) == 1
        wait_for(lambda: bool(gateway.lines), 2, "a line")
        assert len(gateway.lines) == 1
        assert "nocan9" in gateway.log
        assert "ip link add nocan9 type vcan" in gateway.log


def test_an_interface_that_goes_down_and_up_is_used_again_within_a_second(vcan: str, start_gateway: Start) -> None:
    with bench(EscOptions(profile=QUICK)) as run, Candump(vcan) as dump:
        gateway = start_gateway(configuration(vcan, [run.ports[0].path]))
        gateway.wait_for_line("esc1: /dev/pts")
        run.start()
        for _ in range(3):
            wait_for(lambda: bool(dump.frames) and dump.frames[-1].time > time.time() - 0.2, 5, "frames")
            ip("link", "set", vcan, "down")
            time.sleep(1.2)
            up = time.time()
            ip("link", "set", vcan, "up")
            wait_for(lambda up=up: dump.of(0x688)[-1].time > up, 3, "frames again")  # type: ignore[misc]
            first = next(frame for frame in dump.of(0x688) if frame.time > up)
            assert first.time - up < 1.2
            assert any(agrees_speed(first.data, live) for when, live in run.live(0) if when > first.time - 0.2)
        assert gateway.end() == 0
        assert gateway.log.count("is down. Start it") == 3
        assert gateway.log.count("frames are sent again") == 3


def agrees_speed(data: bytes, live: object) -> bool:
    """True if an EscSpeed frame carries these live data's speed and voltage: the newest value, not one from before."""
    found = {
        "ElectricalSpeed": int.from_bytes(data[:3], "little"),
        "BatteryVoltage": int.from_bytes(data[3:5], "little") / 100,
    }
    return agrees(found, live, "")  # type: ignore[arg-type]


def test_an_interface_that_is_deleted_and_made_again_is_used_again(vcan: str, start_gateway: Start) -> None:
    with bench(EscOptions(profile=QUICK)) as run:
        gateway = start_gateway(configuration(vcan, [run.ports[0].path]))
        gateway.wait_for_line("esc1: /dev/pts")
        run.start()
        with Candump(vcan) as dump:
            wait_for(lambda: len(dump.of(0x688)) > 20, 5, "frames")
        for _ in range(2):
            ip("link", "del", vcan)
            time.sleep(0.7)
            ip("link", "add", vcan, "type", "vcan")
            ip("link", "set", vcan, "up")
            with Candump(vcan) as dump:
                took = wait_for(lambda dump=dump: len(dump.of(0x688)) > 5, 4, "frames again")  # type: ignore[misc]
            assert took < 2
        assert gateway.end() == 0


def test_a_gateway_that_waits_starts_before_its_interface_and_port_exist(start_gateway: Start, tmp_path: Path) -> None:
    name, link = "kcglate", tmp_path / "esc"
    gateway = start_gateway(configuration(name, [str(link)]), "--wait")
    gateway.wait_for_line("Trying again")
    ip("link", "add", name, "type", "vcan")
    try:
        ip("link", "set", name, "up")
        with bench(EscOptions()) as run, Candump(name) as dump:
            link.symlink_to(run.ports[0].path)
            run.start()
            assert wait_for(lambda: len(dump.of(0x688)) > 20, 5, "frames") < 4
            assert gateway.end() == 0
    finally:
        subprocess.run(["ip", "link", "del", name], check=True)


def test_on_a_full_queue_the_newest_value_wins_and_nothing_piles_up(vcan: str, start_gateway: Start) -> None:
    """A bus that takes less than the gateway sends: the kernel says ENOBUFS, slots hold one frame an id."""
    ip("link", "set", vcan, "txqueuelen", "5")
    subprocess.run(
        ["tc", "qdisc", "add", "dev", vcan, "root", "tbf", "rate", "12kbit", "burst", "160", "limit", "160"], check=True
    )
    with bench(EscOptions(profile=QUICK)) as run, Candump(vcan) as dump:
        gateway = start_gateway(configuration(vcan, [run.ports[0].path]))
        gateway.wait_for_line("esc1: /dev/pts")
        run.start()
        time.sleep(4)
        lived = run.live(0)
        speeds = [frame for frame in dump.of(0x688) if frame.data[5] != 0x80]
        assert 20 < len(speeds) < 0.8 * len(lived), "the bus was too slow for all"
        for frame in speeds:
            hits = [when for when, live in lived if when <= frame.time + 0.05 and agrees_speed(frame.data, live)]
            assert hits, "a value that was never sent"
            assert frame.time - hits[-1] < 0.6, "an old value came late"
        subprocess.run(["tc", "qdisc", "del", "dev", vcan, "root"], check=True)
        free = time.time()
        wait_for(lambda: len([f for f in dump.of(0x688) if f.time > free]) > 80, 3, "all frames again")
        traffic = dump.of(0x6D9)[-1].data
        assert int.from_bytes(traffic[4:6], "little") > 50, "ReplacedFrames counts"
        assert int.from_bytes(traffic[6:8], "little") > 50, "SendFailures counts"
        assert gateway.end() == 0


def test_the_controllers_state_is_followed_from_error_frames(vcan: str, start_gateway: Start) -> None:
    frames = {  # error frames as a controller's driver makes them
        "20000004#0008000000000000": 2,  # transmit error counter at warning level
        "20000004#0020000000000000": 3,  # error passive
        "20000040#0000000000000000": 4,  # bus-off
        "20000100#0000000000000000": 1,  # restarted
    }
    with bench(EscOptions()) as run, Candump(vcan) as dump:
        gateway = start_gateway(configuration(vcan, [run.ports[0].path]))
        gateway.wait_for_line("esc1: /dev/pts")
        wait_for(lambda: bool(dump.of(0x6D8)) and dump.of(0x6D8)[-1].data[0] >> 4 == 1, 3, "ErrorActive")
        for frame, state in frames.items():
            subprocess.run(["cansend", vcan, frame], check=True)
            wait_for(lambda state=state: dump.of(0x6D8)[-1].data[0] >> 4 == state, 2, f"CanState {state}")  # type: ignore[misc]
        assert gateway.end() == 0


def test_foreign_traffic_does_not_wake_the_process(vcan: str, start_gateway: Start) -> None:
    """The kernel's filter keeps data frames out: 20 000 of them cost the gateway no measurable time."""
    with bench(EscOptions()) as run, Candump(vcan):
        gateway = start_gateway(configuration(vcan, [run.ports[0].path]))
        gateway.wait_for_line("esc1: /dev/pts")
        time.sleep(0.5)

        def wakeups() -> int:
            status = Path(f"/proc/{gateway.process.pid}/status").read_text()
            return sum(int(line.split()[1]) for line in status.splitlines() if line.startswith("voluntary_ctxt"))

        before = wakeups()
        subprocess.run(["cangen", vcan, "-g", "0", "-n", "5000", "-I", "123", "-L", "8", "-i"], check=True)
        assert wakeups() - before < 2000
        assert gateway.end() == 0


def test_an_interface_without_can_fd_is_refused_for_it_with_the_remedy(vcan: str, start_gateway: Start) -> None:
    ip("link", "set", vcan, "down")
    ip("link", "set", vcan, "mtu", "16")
    with bench(EscOptions()) as run:
        gateway = start_gateway(configuration(vcan, [run.ports[0].path], dbc="fd = true"))
        assert gateway.process.wait(20) == 1
        wait_for(lambda: f"ip link set {vcan} mtu 72" in gateway.log, 2, "the remedy")


def test_a_suspended_process_sends_nothing_old_as_new(vcan: str, start_gateway: Start) -> None:
    with bench(EscOptions(profile=QUICK)) as run, Candump(vcan) as dump:
        gateway = start_gateway(configuration(vcan, [run.ports[0].path]))
        gateway.wait_for_line("esc1: /dev/pts")
        run.start()
        wait_for(lambda: len(dump.of(0x688)) > 50, 5, "EscSpeed")
        gateway.process.send_signal(signal.SIGSTOP)
        time.sleep(3)
        resumed = time.time()
        gateway.process.send_signal(signal.SIGCONT)
        gateway.wait_for_line("suspended")
        wait_for(lambda: len([f for f in dump.of(0x688) if f.time > resumed]) > 50, 5, "EscSpeed again")
        time.sleep(0.4)  # until all that was sent is noted
        for frame in [f for f in dump.of(0x688) if f.time > resumed and f.data[5] != 0x80][:50]:
            hits = [
                when for when, live in run.live(0) if abs(frame.time - when) < 0.3 and agrees_speed(frame.data, live)
            ]
            assert hits, "a value from before the suspension"
        assert gateway.end() == 0
