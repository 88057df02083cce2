"""``monitor`` on a real vcan with a running gateway shows values, sends nothing, and recovers."""

import re
from collections.abc import Callable

import pytest
from harness import PtyPort
from vcan_tools import GatewayProcess, configuration, ip, wait_for

pytestmark = pytest.mark.promise("monitor")

Start = Callable[..., GatewayProcess]


def test_monitor_reports_a_lost_interface_and_recovers(
    vcan: str,
    escs: list[PtyPort],
    start_gateway: Start,
) -> None:
    gateway = start_gateway(configuration(vcan, escs))
    gateway.wait_for_line("esc1: /")
    escs[0].on = True
    shown = GatewayProcess(None, vcan, command="monitor")
    out = shown.out
    try:

        def is_shown() -> bool:
            return any(re.match(r"esc1 .* (ok|degraded) .* \d\d\.\d\d ", line) for line in out[-2:])

        wait_for(is_shown, "values")
        for act, undo, what in (
            (("set", vcan, "down"), [("set", vcan, "up")], "is down. Start it"),
            (
                ("del", vcan),
                [("add", vcan, "type", "vcan"), ("set", vcan, "up")],
                "does not exist.",
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
        assert shown.lines[-1].endswith(f"received on {vcan}. The monitor sends nothing.")
        assert "Traceback" not in shown.log
    finally:
        shown.kill()
