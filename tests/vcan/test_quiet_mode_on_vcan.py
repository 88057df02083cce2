"""Quiet mode on a real interface: its begin and its end are logged and listed, in both cores."""

import json
from pathlib import Path

import pytest
from vcan_tools import GatewayProcess, configuration, feeding, wait_for

pytestmark = pytest.mark.promise("quiet-mode")

QUIET = "quiet_after_s = 3\n"
BEGIN = "quiet: no ESC was heard for 3"
AFTER_BEGIN = "esc1: no telemetry: no bytes"
"""A line of the log a second later. A late line would come after it."""
END = "quiet mode ends: an ESC is heard"


@pytest.mark.parametrize("core", ["c", "python"])
def test_begin_and_end_of_quiet_mode_are_logged_at_once(
    vcan: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, core: str
) -> None:
    monkeypatch.setenv("KONTRONIK_PURE", "1" if core == "python" else "")
    status = tmp_path / "status.json"
    statistics = f'{QUIET}[statistics]\nfile = "{status}"\n'
    with feeding(tmp_path) as ports:
        config = tmp_path / "gateway.toml"
        esc = "telemetry_timeout_ms = 1000"
        config.write_text(configuration(vcan, ports, statistics, esc))
        gateway = GatewayProcess(config)
        try:
            ports[0].on = True
            gateway.wait_for_line("esc1: telemetry ok")
            ports[0].on = False
            gateway.wait_for_line(AFTER_BEGIN)
            begun = gateway.log.partition(AFTER_BEGIN)[0]
            assert BEGIN in begun
            assert END not in gateway.log

            def is_listed() -> bool:
                shown = json.loads(status.read_text())
                return shown["gateway"]["state"] == "quiet" and BEGIN in str(shown["log"])

            wait_for(is_listed, status.read_text)
            ports[0].on = True
            gateway.wait_for_line(END)
            assert gateway.log.index(BEGIN) < gateway.log.index(END)
            assert gateway.log.count(BEGIN) == gateway.log.count(END) == 1
            assert gateway.end() == 0, gateway.log
        finally:
            gateway.kill()
