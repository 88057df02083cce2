"""``monitor`` on a real vcan beside a running gateway: what it shows, that it sends nothing, and that it comes back."""

import json
import re
import subprocess
from collections.abc import Callable
from pathlib import Path

from vcan_tools import (
    LIMIT_S,
    Candump,
    GatewayProcess,
    bench,
    configuration,
    ip,
    program,
    wait_for,
)

from kontronik_can_gw.esc.kontronik.simulator import ErrorWindow, EscOptions, Faults
from kontronik_can_gw.esc.kontronik.states import OperatingError

Start = Callable[..., GatewayProcess]
FAULTY = EscOptions(faults=Faults(errors=(ErrorWindow(OperatingError.BEC_OVERCURRENT, 0),)))


def once(*words: object) -> subprocess.CompletedProcess[str]:
    return program("monitor", "--once", *words)


def sent_on(interface: str) -> int:
    """Frames that were sent on a vcan, by anybody."""
    return int(Path("/sys/class/net", interface, "statistics/tx_packets").read_text())


def test_once_tells_of_all_escs_of_the_configuration(
    vcan: str, start_gateway: Start, tmp_path: Path
) -> None:
    with bench(FAULTY, EscOptions(cell_count=12)) as run, Candump(vcan) as dump:
        gateway = start_gateway(configuration(vcan, [port.path for port in run.ports]))
        gateway.wait_for_line("esc2: /dev/pts")
        run.start()
        wait_for(lambda: len(dump.frames) > 300, "frames")
        done = once("-c", tmp_path / "gateway0.toml", "--timeout", LIMIT_S)
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
        assert done.stdout.count("\n") == 1
        dump.catch_up()
        # every frame on the bus is one of the gateway's
        assert {frame.can_id for frame in dump.frames} <= set(range(0x680, 0x6E0))
    found = json.loads(done.stdout)
    first, second = found["escs"]
    assert found["interface"] == vcan
    assert found["gateway"]["state"] == "Running"
    assert (first["name"], second["name"]) == ("esc1", "esc2")
    assert (first["errors"], second["errors"]) == (["bec_overcurrent"], [])
    # a machine that stood still a moment ago has lost bytes
    assert {esc["link"] for esc in found["escs"]} <= {"Ok", "Degraded"}
    sent = {live.battery_voltage / 100 for live in run.live(0)}
    assert first["values"]["battery_voltage"] in sent
    assert second["values"]["cell_count"] == 12


def test_once_on_a_silent_bus_is_one_line_and_nothing_is_sent(vcan: str) -> None:
    done = once("--channel", vcan, "--timeout", 0.5)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.count("\n") == 1
    assert f"no frame of kontronik_esc.dbc on {vcan} for 0.5 s." in done.stderr
    assert f"ip -details link show {vcan}" in done.stderr
    assert sent_on(vcan) == 0


def test_it_says_that_the_interface_is_down_or_gone_and_comes_back(
    vcan: str, start_gateway: Start
) -> None:
    with bench(EscOptions()) as run:
        gateway = start_gateway(configuration(vcan, [run.ports[0].path]))
        gateway.wait_for_line("esc1: /dev/pts")
        run.start()
        shown = GatewayProcess(None, "--channel", vcan, "--interval", 0.25, command="monitor")
        out = shown.out
        try:

            def is_shown() -> bool:
                return any(re.match(r"esc1 .* ok .* \d\d\.\d\d ", line) for line in out[-2:])

            wait_for(is_shown, "values")
            for act, undo, what in (
                (("set", vcan, "down"), [("set", vcan, "up")], "is down. Start it"),
                (
                    ("del", vcan),
                    [("add", vcan, "type", "vcan"), ("set", vcan, "up")],
                    "there is none.",
                ),
            ):
                before = len(out)
                ip("link", *act)
                wait_for(lambda b=before, w=what: w in " ".join(out[b:]), what)  # type: ignore[misc]
                wait_for(lambda: "errors: -" in out[-1], "no old value")
                assert shown.process.poll() is None
                for words in undo:
                    ip("link", *words)
                wait_for(is_shown, "values again")
            assert shown.end() == 0
            assert shown.lines[-1].endswith(f"seen on {vcan}, none sent")
            assert "Traceback" not in shown.log
        finally:
            shown.kill()
