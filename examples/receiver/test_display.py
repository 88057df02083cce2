"""Tests of a display with a real gateway: telemetry, a lost ESC, error bits, a failed interface."""

from conftest import Bench, until
from display import Display


def test_telemetry_is_shown(bench: Bench, display: Display) -> None:
    bench.plug_in()
    until(lambda: display.shown("BatteryVoltage"))
    voltage = display.shown("BatteryVoltage")
    assert isinstance(voltage, float)
    assert 18 < voltage < 26


def test_lost_esc_shows_dashes_and_one_that_is_back_shows_values(
    bench: Bench, display: Display
) -> None:
    bench.plug_in()
    until(lambda: display.shown("BatteryVoltage") is not None)
    bench.unplug()
    until(lambda: display.shown("BatteryVoltage") is None)
    until(lambda: str(display.shown("LinkState")) in ("Lost", "PortError"))
    bench.plug_in()
    until(lambda: display.shown("BatteryVoltage") is not None)


def test_error_of_the_esc_is_shown(bench: Bench, display: Display) -> None:
    bench.plug_in("--error", "undervoltage@1s+2s")
    until(lambda: display.shown("Undervoltage") == 1)
    until(lambda: display.shown("Undervoltage") == 0)


def test_bus_that_goes_down_shows_dashes_until_it_is_back(bench: Bench, display: Display) -> None:
    bench.plug_in()
    until(lambda: display.shown("BatteryVoltage") is not None)
    bench.bus("down")
    until(lambda: display.shown("BatteryVoltage") is None)
    bench.bus("up")
    until(lambda: display.shown("BatteryVoltage") is not None)


def test_gateway_that_is_gone_shows_dashes(bench: Bench, display: Display) -> None:
    bench.plug_in()
    until(lambda: display.shown("BatteryVoltage") is not None)
    bench.gateway.kill()
    until(lambda: display.shown("BatteryVoltage") is None)
