"""The metrics as Prometheus reads them: names, types, base units, and nothing that is not available."""

import re
from types import SimpleNamespace
from typing import Any

import pytest
from prometheus_client import Metric, generate_latest
from prometheus_client.parser import text_string_to_metric_families
from statistics_bench import Bench, with_nodes

from kontronik_can_gw.desk.metrics import families as made
from kontronik_can_gw.esc.kontronik.codec import Layout, encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.kontronik.states import OperatingError, SelfTestError
from kontronik_can_gw.runtime.facts import CanFacts, PortFacts, StoreFacts

UNITS = (
    "volts", "amperes", "watts", "joules", "coulombs", "celsius", "ratio", "seconds", "bytes", "hertz",
    "revolutions_per_second",
)  # fmt: skip


def metrics(document: dict[str, Any]) -> str:
    found = SimpleNamespace(collect=lambda: made(document, 0.5))
    return generate_latest(found).decode()


def families(document: dict[str, Any]) -> dict[str, Metric]:
    """By name as it is written, ``_total`` included."""
    text = metrics(document)
    found = list(text_string_to_metric_families(text))
    names = [family.name + ("_total" if family.type == "counter" else "") for family in found]
    assert len(set(names)) == len(names)
    return dict(zip(names, found, strict=True))


def value(document: dict[str, Any], name: str, **labels: str) -> float | None:
    family = families(document).get(name)
    if family is None:
        return None
    found = [s.value for s in family.samples if s.labels == labels]
    assert len(found) <= 1
    return found[0] if found else None


@pytest.fixture(scope="module")
def document() -> dict[str, Any]:
    bench = Bench(2)
    bench.run(6)
    ports = [
        PortFacts(f"esc{n}", f"/dev/{n}", True, line_errors={"parity": n, "framing": 0})
        for n in (1, 2)
    ]
    can = CanFacts("socketcan", "can0", 500_000, True, error_counters=(8, 0))
    return with_nodes(bench.document(ports=ports, can=can, store=StoreFacts(1, "disk full")))


def test_names_have_the_prefix_counters_end_in_total_and_a_unit_stands_behind_the_name(
    document: dict[str, Any],
) -> None:
    units = dict.fromkeys(UNITS, 0)
    for name, family in families(document).items():
        assert re.fullmatch(r"kontronik_[a-z][a-z0-9_]*", name)
        assert (family.type == "counter") == name.endswith("_total")
        assert family.documentation
        for unit in UNITS:
            units[unit] += name.removesuffix("_total").endswith(f"_{unit}")
        # promtool check metrics: base units, suffixes and types that belong to other kinds of metric
        kinds = "bits|minutes|hours|days|kelvins|gauge|counter|histogram|summary"
        units_of_people = "v|a|w|wh|mah|ms|us|percent|rpm|millis|degrees|kbit"
        assert not re.search(rf"_({kinds}|{units_of_people})(_|$)", name), name
        assert not name.endswith(("_count", "_sum", "_bucket")), name
    assert all(units.values()), units


def test_values_are_in_base_units(document: dict[str, Any]) -> None:
    values = document["escs"][0]["values"]
    assert values["electrical_speed"] > 0
    expected = {
        "battery_voltage_volts": values["battery_voltage"],
        "battery_current_amperes": values["battery_current"],
        "battery_power_watts": values["battery_power"],
        "consumed_charge_coulombs": values["consumed_charge"] * 3.6,
        "energy_used_joules_total": values["energy_used"] * 3600,
        "motor_run_time_seconds_total": values["motor_run_time"],
        "power_stage_temperature_celsius": values["power_stage_temperature"],
        "throttle_ratio": values["throttle"] / 100,
        "pwm_input_seconds": values["pwm_input"] * 1e-6,
        "electrical_speed_revolutions_per_second": values["electrical_speed"] / 60,
        "cells": values["cell_count"],
        "operating_state_raw": values["operating_state_raw"],
        "esc_data_age_seconds": document["escs"][0]["data_age_ms"] / 1000,
        "esc_frame_rate_hertz": document["escs"][0]["frame_rate_hz"],
        "esc_live_frames_total": document["escs"][0]["counters"]["live"],
        "esc_received_bytes_total": document["escs"][0]["counters"]["bytes"],
    }
    for name, number in expected.items():
        assert value(document, f"kontronik_{name}", esc="esc1") == pytest.approx(number), name
    named = set(families(document))
    for name in ({"cell_count": "cells"}.get(name, name) for name in document["units"]):
        assert any(re.fullmatch(rf"kontronik_{name}(_(?!error).*)?", each) for each in named), name
    assert value(document, "kontronik_can_bitrate") == 500_000
    assert value(document, "kontronik_can_transmit_errors") == 8
    assert value(document, "kontronik_uptime_seconds") == 6
    assert value(document, "kontronik_esc_port_line_errors_total", esc="esc2", kind="parity") == 2
    assert value(document, "kontronik_store_failed") == 1


def test_what_is_not_available_is_left_out() -> None:
    bench = Bench(2)
    bench.run(2)
    bench.silent.add(0)
    bench.run(1)
    document = bench.document()
    values = document["escs"][0]["values"]
    available = {name for name, value_now in values.items() if value_now is not None}
    assert available == {"energy_used", "motor_run_time"}
    text = metrics(document)
    assert value(document, "kontronik_battery_voltage_volts", esc="esc1") is None
    assert value(document, "kontronik_battery_voltage_volts", esc="esc2") is not None
    assert value(document, "kontronik_esc_fresh", esc="esc1") == 0
    assert 'kontronik_operating_error{esc="esc1"' not in text
    assert 'kontronik_esc_info{esc="esc1"' not in text
    assert not re.search("nan|none|null", text, re.IGNORECASE)
    assert value(document, "kontronik_esc_losses_total", esc="esc1") == 1
    assert "kontronik_canopen_node_state" not in text  # there are no nodes
    assert "kontronik_store" not in text


def test_each_error_bit_is_a_flag_with_its_severity_and_an_unknown_one_shows_when_it_is_set() -> (
    None
):
    bench = Bench(1)
    bench.run(3)
    errors = LiveData(operating_errors=1 << OperatingError.OVERVOLTAGE | 1 << 30)
    bench.gateway.receive_bytes(0, encode(errors, Layout.V4), bench.now, bench.now)
    samples = families(bench.document())["kontronik_operating_error"].samples
    assert len(samples) == len(OperatingError) + 1
    known = {s.labels["error"]: s.labels["severity"] for s in samples}
    assert {bit.text: bit.severity.value for bit in OperatingError} | {"bit30": "error"} == known
    assert {s.labels["error"] for s in samples if s.value == 1} == {"overvoltage", "bit30"}
    assert len(families(bench.document())["kontronik_selftest_error"].samples) == len(SelfTestError)
