"""The status document: every value is true and fresh or null, and every counter is in it."""

import json
import os
from dataclasses import fields
from pathlib import Path

import pytest
from statistics_bench import Bench, moment_of

from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.deframer import DeframerCounters
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData, rows
from kontronik_can_gw.esc.kontronik.protocol import KONTRONIK
from kontronik_can_gw.esc.kontronik.simulator import EscOptions, Faults
from kontronik_can_gw.esc.kontronik.states import OperatingError, OperatingState
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.runtime.status.facts import program_facts, utc
from kontronik_can_gw.runtime.status.snapshot import snapshot
from kontronik_can_gw.runtime.system.process import process_facts, start_ticks
from kontronik_can_gw.status import GatewayStatus
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("status")


def test_later_events_do_not_change_the_document_of_a_moment() -> None:
    bench = Bench()
    bench.run(3)
    moment = moment_of(bench.gateway, bench.now)
    document = json.loads(snapshot(moment))
    bench.silent = {1}
    bench.run(2)
    bench.gateway.escs[0].line_errors += 1
    bench.gateway.status.sent_frames += 1
    bench.gateway.core.apply(0, EscSettings("another", 3))
    assert json.loads(snapshot(moment)) == document
    assert bench.document()["escs"] != document["escs"]
    assert document["escs"][1]["fresh"]


def test_every_field_of_the_newest_frames_is_shown_in_its_unit() -> None:
    bench = Bench()
    bench.run(6)
    document = bench.document()
    for number, esc in enumerate(document["escs"]):
        for kind in (LiveData, InfoData):
            sent = bench.newest(number, kind)
            for (name, row), raw in zip(rows(kind).items(), sent, strict=True):
                if name in ("operating_state", "device_and_variant", "firmware_word"):
                    continue
                assert esc["values"][name] == raw / row.per_unit, name
                assert document["units"][name] == row.unit
        live = bench.newest(number, LiveData)
        info = bench.newest(number, InfoData)
        assert esc["operating_state"] == OperatingState(live.operating_state).name
        assert esc["device"] == "KOSMIK"
        assert esc["firmware"] == KONTRONIK.firmware_text(info)
        motor_speed = live.electrical_speed / 7
        output_speed = motor_speed / 9.8
        power = live.battery_voltage * live.battery_current / 1000
        assert esc["values"]["motor_speed"] == pytest.approx(motor_speed, abs=1e-6)
        assert esc["values"]["output_speed"] == pytest.approx(output_speed, abs=1e-6)
        assert esc["values"]["battery_power"] == pytest.approx(power)
        assert set(esc["values"]) == set(document["units"])
        assert (esc["link"], esc["fresh"], esc["layout"]) == ("ok", True, "V4")


def test_values_older_than_the_time_out_are_null() -> None:
    bench = Bench(1)
    bench.run(1)
    heard = bench.gateway.escs[0].live_ns
    assert heard is not None
    last = bench.document(at=heard + 250 * MS)["escs"][0]
    late = bench.document(at=heard + 250 * MS + 1)["escs"][0]
    assert last["fresh"]
    assert last["values"]["battery_voltage"] is not None
    assert not late["fresh"]
    assert late["values"]["battery_voltage"] is late["values"]["motor_speed"] is None
    assert late["operating_state"] is late["errors"] is late["warnings"] is late["statuses"] is None
    assert late["data_age_ms"] == 250
    assert bench.document(at=heard + 20 * SECOND)["escs"][0]["device"] is None


def test_all_counters_of_the_stream_and_of_the_gateway_are_shown() -> None:
    bench = Bench(1, options=EscOptions(faults=Faults(flipped_bits=1e-4)))
    bench.run(3)
    document = bench.document()
    counters = document["escs"][0]["counters"]
    assert {f.name for f in fields(DeframerCounters)} <= set(counters)
    assert counters["dropped_bytes"] > 0
    assert counters == {
        **bench.gateway.escs[0].counters.as_dict(),
        "suspect_frames": 0,
        "late_frames": 0,
        "line_errors": 0,
    }
    others = {"state", "can_state", "esc_count", "escs_ok", "started_ns", "heard_ns", "is_quiet"}
    assert set(document["can"]["counters"]) == {f.name for f in fields(GatewayStatus)} - others


def test_errors_warnings_and_statuses_are_separate() -> None:
    bench = Bench(1)
    word = (
        1 << OperatingError.UNDERVOLTAGE
        | 1 << OperatingError.POWER_STAGE_OVERTEMP_WARNING
        | 1 << OperatingError.PROGRAMMING_ALLOWED
        | 1 << 31
    )
    frame = encode(LiveData(operating_errors=word), WireLayout.V4)
    bench.gateway.receive_bytes(0, frame, bench.now, bench.now)
    (shown,) = bench.document()["escs"]
    assert shown["errors"] == ["undervoltage", "bit31"]
    assert shown["warnings"] == ["power_stage_overtemp_warning"]
    assert shown["statuses"] == ["programming_allowed"]


def test_figures_of_the_process_match_proc(tmp_path: Path) -> None:
    before = process_facts()
    opened = [(tmp_path / f"{n}").open("w") for n in range(5)]
    after = process_facts()
    for file in opened:
        file.close()
    assert after.open_fds == before.open_fds + 5
    assert after.threads == len(list(Path("/proc/self/task").iterdir()))
    status = Path("/proc/self/status").read_text(encoding="ascii")
    (line,) = (line for line in status.splitlines() if line.startswith("VmRSS"))
    resident = int(line.split()[1]) * 1024
    assert abs(after.rss_bytes - resident) < 0.2 * resident


def test_process_is_identified_by_its_start_until_it_has_ended() -> None:
    facts = program_facts("gateway.toml")
    assert facts.pid == os.getpid()
    assert facts.ticks == start_ticks(os.getpid()) > 0
    assert Path(facts.configuration).is_absolute()
    child = os.posix_spawn("/bin/true", ["true"], {})
    os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
    assert start_ticks(child) == -1  # it has ended, but its exit code was not read yet
    os.waitpid(child, 0)
    assert start_ticks(child) == 0


def test_times_of_a_status_are_utc() -> None:
    assert utc(1_700_000_000.9) == "2023-11-14T22:13:20Z"
