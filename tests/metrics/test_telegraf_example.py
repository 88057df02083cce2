"""examples/telegraf: the configuration names the exporter and metrics that exist."""

import tomllib
from pathlib import Path
from typing import Any

import pytest
from statistics_bench import Bench

from kontronik_can_gw.cli.metrics import OPTIONS
from kontronik_can_gw.desk.metrics import families
from kontronik_can_gw.runtime.system.clock import ClockFacts

pytestmark = pytest.mark.promise("metrics", "docs")

FILE = Path(__file__).parents[2] / "examples/telegraf/telegraf.conf"
CONFIGURATION: dict[str, Any] = tomllib.loads(FILE.read_text())


def test_address_is_the_default_of_metrics() -> None:
    listen = next(option for option in OPTIONS if getattr(option, "names", ()) == ["--listen"])
    _, port = listen.settings["default"]  # type: ignore[union-attr]
    [prometheus] = CONFIGURATION["inputs"]["prometheus"]
    assert prometheus["urls"] == [f"http://localhost:{port}/metrics"]


def test_every_field_is_a_metric() -> None:
    bench = Bench()
    bench.run(6)
    document = bench.document(clock=ClockFacts(True, 0.01, "rtc-ds3231"))
    names = {sample.name for family in families(document, 0) for sample in family.samples}
    [prometheus] = CONFIGURATION["inputs"]["prometheus"]
    assert set(prometheus["fieldinclude"]) - names == set()


def test_configuration_contains_no_token() -> None:
    [influx] = CONFIGURATION["outputs"]["influxdb_v2"]
    assert influx["token"].startswith("$")
