"""What is sent of ESCs, as the package ``dronecan`` reads it: values, when, and when not."""

import math

import pytest
from dronecan_bench import LIVE, START, Bench, intervals

from kontronik_can_gw.dronecan import types
from kontronik_can_gw.esc.kontronik import Device
from kontronik_can_gw.esc.kontronik.states import OperatingError
from kontronik_can_gw.esc.telemetry import MS, SECOND
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway_status import CanState

HOT = OperatingError.POWER_STAGE_OVERTEMP_ERROR
WARM = OperatingError.POWER_STAGE_OVERTEMP_WARNING


def test_status_has_the_values_of_the_esc() -> None:
    bench = Bench(2, first_index=3)
    bench.info(0, Device.KOSMIK)
    got = bench.run(1).of("Status")[-2].payload
    assert (got.esc_index, got.rpm, got.power_rating_pct, got.error_count) == (3, 6000, 42, 0)
    assert got.voltage == pytest.approx(24.23, abs=0.008)
    assert got.current == pytest.approx(47.3, abs=0.016)
    assert got.temperature == pytest.approx(303.15, abs=0.125)
    assert bench.of("Status")[-1].payload.esc_index == 4


@pytest.mark.parametrize(
    ("rpm", "sent"), [("motor", 6000), ("output", 600), ("electrical", 42_000)]
)
def test_rpm_is_the_speed_that_was_chosen(rpm: str, sent: int) -> None:
    assert Bench(rpm=rpm).run(0.1).of("Status")[-1].payload.rpm == sent


def test_a_speed_beyond_the_type_is_its_limit() -> None:
    bench = Bench(rpm="electrical")
    bench.live[0] = LIVE._replace(electrical_speed=200_000)
    assert bench.run(0.1).of("Status")[-1].payload.rpm == 131_071


def test_all_escs_are_sent_at_one_rate_while_telemetry_is_fresh_and_no_longer() -> None:
    """The last value is sent within the ESC's time-out; then there is silence, the other ESC goes on."""
    bench = Bench(2, rate_hz=50).run(1)
    of_first = [each for each in bench.of("Status") if each.payload.esc_index == 0]
    assert set(intervals(of_first)) == {20 * MS}
    order = [each.payload.esc_index for each in bench.of("Status")]
    assert order == [0, 1] * (len(order) // 2)
    bench.live[0], lost = None, bench.now
    bench.clear()
    bench.run(2)
    of_first = [each for each in bench.of("Status") if each.payload.esc_index == 0]
    assert 230 * MS <= of_first[-1].at - lost <= 250 * MS
    assert len(bench.of("Status")) - len(of_first) == 100
    bench.live[0] = LIVE
    bench.clear()
    assert len(bench.run(1).of("Status")) == 100


def test_a_node_without_telemetry_says_that_it_is_there_and_nothing_else() -> None:
    bench = Bench()
    bench.live[0] = None
    bench.run(5)
    assert {each.name for each in bench.read} == {"NodeStatus"}
    assert set(intervals(bench.of("NodeStatus"))) == {SECOND}
    assert bench.read[0].at == START


def test_what_a_device_does_not_supply_is_nan() -> None:
    bench = Bench()
    bench.info(0, Device.JIVEPRO)
    bench.run(1.1)
    bec = bench.of("CircuitStatus")[-1].payload
    assert math.isnan(bec.current)
    assert bec.voltage == pytest.approx(5.981, abs=0.004)


def test_the_bec_once_a_second() -> None:
    bench = Bench(first_index=2)
    bench.info(0, Device.KOSMIK)
    bench.live[0] = LIVE._replace(operating_errors=1 << OperatingError.BEC_UNDERVOLTAGE | 1 << 9)
    bench.run(3)
    circuit, warm = bench.of("CircuitStatus")[-1].payload, bench.of("Temperature")[-1].payload
    assert (circuit.circuit_id, circuit.error_flags) == (2, 2)
    assert circuit.voltage == pytest.approx(5.981, abs=0.004)
    assert circuit.current == pytest.approx(1.25, abs=0.001)
    assert (warm.device_id, warm.error_flags) == (2, 1)
    assert warm.temperature == pytest.approx(314.15, abs=0.25)
    assert set([*intervals(bench.of("CircuitStatus"))][1:]) == {SECOND}


def test_status_extended_is_sent_only_by_choice() -> None:
    assert not Bench().run(1).of("StatusExtended")
    bench = Bench(extended_hz=10)
    bench.live[0] = LIVE._replace(operating_errors=1 << 17 | 1 << 5 | 1 << 23)
    got = bench.run(2).of("StatusExtended")
    assert set([*intervals(got)][1:]) == {100 * MS}
    last = got[-1].payload
    assert (last.input_pct, last.output_pct, last.motor_temperature_degC) == (55, 42, -256)
    assert last.status_flags == 1 << 17 | 1 << 5 | 1 << 18


def test_error_count_is_that_of_errors_since_the_motor_was_started() -> None:
    bench = Bench()
    counts = []
    for errors, speed in ((0, 0), (1 << HOT, 0), (0, 0), (0, 700), (1 << HOT, 700), (1 << WARM, 700),
                          (1 << HOT | 1, 700), (1 << HOT | 1, 700), (0, 0), (0, 700)):  # fmt: skip
        bench.live[0] = LIVE._replace(operating_errors=errors, electrical_speed=speed)
        counts.append(bench.run(1.1).of("Status")[-1].payload.error_count)
    assert counts == [0, 1, 1, 0, 1, 1, 3, 3, 3, 0]


def test_errors_that_telemetry_comes_back_with_are_not_counted_and_those_after_it_are() -> None:
    bench = Bench()
    counts = []
    for errors in (1 << HOT, 0, None, 1 << HOT, 1 << HOT | 1, 0, 1 << HOT):
        bench.live[0] = None if errors is None else LIVE._replace(operating_errors=errors)
        bench.run(1)
        counts.append(bench.of("Status")[-1].payload.error_count)
    assert counts == [0, 0, 0, 0, 1, 1, 2]


@pytest.mark.parametrize("health", ["gateway", "esc"])
def test_errors_of_an_esc_count_in_health_by_choice_only(health: str) -> None:
    bench = Bench(2, per_esc_nodes=True, health=health).run(0.5)
    found = []
    for errors in (0, 1 << WARM, 1 << HOT, None):
        bench.live[0] = None if errors is None else LIVE._replace(operating_errors=errors)
        bench.run(1.5)
        found.append([bench.of("NodeStatus", node)[-1].payload.health for node in (42, 43)])
    by_choice = [[0, 0], [1, 0], [2, 0], [1, 0]]
    assert found == (by_choice if health == "esc" else [[0, 0]] * 4)
    assert {each.payload.mode for each in bench.of("NodeStatus")} == {types.OPERATIONAL}


def test_the_state_of_the_gateway_itself() -> None:
    bench = Bench()
    bench.live[0] = LIVE._replace(operating_errors=1 << HOT | 1 << 17)
    got = bench.run(3.5).of("NodeStatus")[-1].payload
    assert (got.uptime_sec, got.health, got.vendor_specific_status_code) == (3, 0, 1 << HOT)
    bench.gateway.set_can_state(CanState.ERROR_PASSIVE, bench.now)
    assert bench.run(1).of("NodeStatus")[-1].payload.health == types.WARNING
    bench.gateway.set_can_state(CanState.ERROR_ACTIVE, bench.now)
    assert bench.run(1).of("NodeStatus")[-1].payload.health == types.OK
    bench.clear()
    bench.gateway.stop(bench.now)
    bench.take()
    assert [(each.name, each.payload.mode) for each in bench.read] == [("NodeStatus", 7)]


def test_what_waited_while_the_process_was_held_up_is_made_anew() -> None:
    """Nothing is made up for: one Status, of what is fresh then."""
    bench = Bench().run(1)
    bench.clear()
    bench.now += 3 * SECOND
    bench.gateway.held_up(bench.now, True)
    bench.gateway.advance(bench.now)
    bench.take()
    assert not bench.of("Status")  # what was heard is three seconds old
    assert len(bench.of("NodeStatus")) == 1
    assert len(bench.run(0.1).of("Status")) == 5


def test_errors_that_begin_and_end_are_logged_with_the_remedy() -> None:
    bench = Bench().run(0.5)
    assert not bench.of("LogMessage")
    bench.live[0] = LIVE._replace(operating_errors=1 << HOT | 1 << 12)  # and its summary
    bench.run(2)
    got = [each.payload for each in bench.of("LogMessage")]
    assert {(each.level.value, bytes(each.source.to_bytes())) for each in got} == {(3, b"e0")}
    texts = [bytes(each.text.to_bytes()).decode() for each in got]
    assert all(len(text) <= 90 for text in texts)
    assert " ".join(texts) == f"e0: {HOT.meaning}. {HOT.remedy}"
    bench.clear()
    bench.live[0] = LIVE
    bench.run(12)
    (got_end,) = bench.of("LogMessage")
    assert bytes(got_end.payload.text.to_bytes()).decode() == f"e0: over: {HOT.meaning}"
    assert got_end.payload.level.value == 1


def test_an_error_that_comes_and_goes_all_the_time_is_logged_now_and_then() -> None:
    bench = Bench()
    for turn in range(600):
        bench.live[0] = LIVE._replace(operating_errors=turn % 2 << WARM)
        bench.run(0.1)
    assert 1 <= len(bench.of("LogMessage")) <= 2 * 7


def test_errors_are_neither_begun_nor_over_while_nothing_is_known() -> None:
    bench = Bench()
    bench.live[0] = LIVE._replace(operating_errors=1 << WARM)
    bench.run(15)
    bench.clear()
    bench.live[0] = None
    bench.run(15)
    bench.live[0] = LIVE._replace(operating_errors=1 << WARM)
    bench.run(15)
    assert not bench.of("LogMessage")
    assert not Bench(log_messages=False).run(2).of("LogMessage")


def test_a_status_that_the_bus_takes_in_parts_is_never_one_of_two() -> None:
    """Frames that wait are replaced by newer ones: what a reader puts together then is whole, or nothing."""
    bench = Bench()
    numbers = iter(range(1 << 30))
    bench.passes = lambda frame: frame.can_id >> 8 & 0xFFFF != 1034 or next(numbers) % 4 != 1
    bench._reader.read = lambda _at, _frame: None  # type: ignore[method-assign, assignment]
    bench.run(5)
    statuses = [frame for _, frame in bench.frames if frame.can_id >> 8 & 0xFFFF == 1034]
    from kontronik_can_gw.dronecan.transport import Assembler

    assembler = Assembler()
    whole = [assembler.receive(f.can_id, f.data, types.STATUS.seed, 0) for f in statuses]
    found = [each for each in whole if each is not None]
    assert 20 < len(found) < 200
    assert len(set(found)) == 1


def test_per_esc_nodes_send_for_themselves() -> None:
    bench = Bench(3, per_esc_nodes=True, node_id=10).run(1)
    for number in range(3):
        got = bench.of("Status", 10 + number)
        assert {each.payload.esc_index for each in got} == {number}
        assert set(intervals(got)) == {20 * MS}


@pytest.mark.parametrize("is_bus_off", [False, True])
def test_errors_that_began_while_nothing_reached_the_bus_are_logged_when_it_returns(
    is_bus_off: bool,
) -> None:
    bench = Bench().run(0.5)
    if is_bus_off:
        bench.gateway.set_can_state(CanState.BUS_OFF, bench.now)
    bench.passes = lambda _frame: False
    bench.live[0] = LIVE._replace(operating_errors=1 << WARM)
    bench.run(3)
    bench.passes = lambda _frame: True
    bench.run(15)
    assert not bench.of("LogMessage")
    if is_bus_off:
        bench.gateway.set_can_state(CanState.ERROR_ACTIVE, bench.now)
    else:
        bench.clear()
        bench.gateway.can_returned(bench.now)
        bench.run(0.01)
        assert bench.read[0].name == "NodeStatus"
    bench.run(1)
    texts = [bytes(each.payload.text.to_bytes()).decode() for each in bench.of("LogMessage")]
    assert " ".join(texts) == f"e0: {WARM.meaning}. {WARM.remedy}"


def test_what_is_no_frame_of_dronecan_is_nothing_to_it() -> None:
    bench = Bench().run(0.1)
    bench.clear()
    for frame in (
        CanFrame(0x601, b"\x40\x18\x10\x04\0\0\0\0"),
        CanFrame(0x1E01AAE5, b"\xc0", True, remote=True),
        CanFrame(0x1E01AAE5, b"\xc0", True, fd=True),
        CanFrame(0x1E01AAE5, b"", True),
        CanFrame(0x1E01AB65, b"\xc0", True),  # to 43
        CanFrame(0x1E012AE5, b"\xc0", True),  # a response
        CanFrame(0x1E01AA80, b"\xc0", True),  # of nobody
        CanFrame(0x1E63AAE5, b"\xc0", True),  # a service that we do not have
    ):
        bench.output.receive(frame, bench.now, bench.now)
    assert not bench.output.frames


def test_what_is_on_is_logged_again_when_the_bus_returns_but_a_bit_no_more_than_each_ten_seconds() -> (
    None
):
    """What began while the bus stood still is sent from the queue when it returns."""
    bench = Bench().run(0.5)
    bench.live[0] = LIVE._replace(operating_errors=1 << WARM)
    begun = len(bench.run(1).of("LogMessage"))
    bench.gateway.can_returned(bench.now)
    assert len(bench.run(9).of("LogMessage")) == begun > 0
    assert len(bench.run(1.5).of("LogMessage")) == 2 * begun
