"""Telemetry that the package ``dronecan`` reads: its values, its times, and when it is not sent."""

import math

import pytest
from dronecan_bench import LIVE, START, Bench

from kontronik_can_gw.dronecan import wire
from kontronik_can_gw.esc.kontronik.fields import InfoData, device_and_variant
from kontronik_can_gw.esc.kontronik.states import Device, OperatingError, OperatingState
from kontronik_can_gw.native import load
from kontronik_can_gw.status import CanState
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("dronecan")

HOT = OperatingError.POWER_STAGE_OVERTEMP_ERROR
WARM = OperatingError.POWER_STAGE_OVERTEMP_WARNING
HOT_NOW = LIVE._replace(operating_errors=1 << HOT)
WARM_NOW = LIVE._replace(operating_errors=1 << WARM)


@pytest.mark.parametrize("per_esc_nodes", [False, True])
def test_all_escs_are_sent_at_one_rate_while_telemetry_is_fresh(
    per_esc_nodes: bool,
) -> None:
    """The last value is sent within the ESC's timeout. The other ESC is still sent after that."""
    bench = Bench(2, per_esc_nodes=per_esc_nodes).run(1)
    assert bench.intervals("Status") == {0, 20 * MS}
    order = [(each.source, each.payload.esc_index) for each in bench.of("Status")]
    assert order == [(42, 0), (42 + per_esc_nodes, 1)] * 50
    bench.live[0] = None
    lost = bench.now
    bench.clear()
    bench.run(2)
    of_first = [each for each in bench.of("Status") if each.payload.esc_index == 0]
    assert 230 * MS <= of_first[-1].at - lost <= 250 * MS
    assert len(bench.of("Status")) - len(of_first) == 100
    bench.live[0] = LIVE
    bench.clear()
    assert len(bench.run(1).of("Status")) == 100


@pytest.mark.parametrize(
    ("rpm", "speed"),
    [("motor", 6000), ("output", 600), ("electrical", 42_000)],
)
@pytest.mark.parametrize(
    ("negative_rpm", "sign"),
    [
        (True, -1),
        (False, 1),
    ],
)
def test_rpm_of_a_backward_motor_is_negative_unless_that_is_off(
    rpm: str,
    speed: int,
    negative_rpm: bool,
    sign: int,
) -> None:
    """The motor is started forward, reversed, and started forward again."""
    bench = Bench(rpm=rpm, negative_rpm=negative_rpm)
    seen = []
    for state in (OperatingState.Forward, OperatingState.Backward, OperatingState.Forward):
        bench.live[0] = LIVE._replace(operating_state=state)
        bench.clear()
        seen.append({each.payload.rpm for each in bench.run(0.5).of("Status")[1:]})
    assert seen == [{speed}, {sign * speed}, {speed}]


@pytest.mark.parametrize(
    ("rate_hz", "live_ms"),
    [
        (50, 50),
        (50, 14),
        (100, 10),
        (30, 10),
        (7, 10),
    ],
)
def test_rate_is_kept_on_average_at_any_rate_of_telemetry(rate_hz: int, live_ms: int) -> None:
    """A frame of the ESC causes a Status if it arrives at about the right time, else the clock.

    StatusExtended is sent only if configured.
    """
    bench = Bench(rate_hz=rate_hz, extended_hz=10 * (rate_hz == 30))
    bench.live[0] = None
    for number in range(10_000 // live_ms):
        bench.hear(LIVE._replace(electrical_speed=7 * number))
        bench.run(live_ms / 1000)
    assert len(bench.of("Status")) == pytest.approx(10 * rate_hz, rel=0.02)
    assert len(bench.of("StatusExtended")) == pytest.approx(100 * (rate_hz == 30), abs=2)
    late = [each.at - START - each.payload.rpm * live_ms * MS for each in bench.of("Status")]
    assert 0 <= min(late) < max(late) + 1 <= live_ms * MS + 1


@pytest.mark.parametrize(
    ("device", "amperes"),
    [
        (Device.KOSMIK, 1.25),
        (Device.JIVEPRO, math.nan),
    ],
)
def test_bec_is_sent_once_a_second_with_nan_for_missing_values(
    device: Device,
    amperes: float,
) -> None:
    bench = Bench(first_index=2)
    bench.hear(InfoData(device_and_variant=device_and_variant(device, 1)))
    bench.live[0] = LIVE._replace(operating_errors=1 << OperatingError.BEC_UNDERVOLTAGE | 1 << 9)
    bench.run(3)
    circuit = bench.of("CircuitStatus")[-1].payload
    warm = bench.of("Temperature")[-1].payload
    assert circuit.circuit_id == 2
    assert circuit.error_flags == 2
    assert circuit.voltage == pytest.approx(5.981, abs=0.004)
    assert circuit.current == pytest.approx(amperes, abs=0.001, nan_ok=True)
    assert warm.device_id == 2
    assert warm.error_flags == 1
    assert warm.temperature == pytest.approx(314.15, abs=0.25)
    assert len(bench.of("CircuitStatus")) == len(bench.of("Temperature")) == 4
    assert max(bench.intervals("CircuitStatus")) == SECOND


@pytest.mark.parametrize(
    ("flight", "counts"),
    [
        # (errors, electrical speed) of each second, or None without telemetry
        (
            [
                (0, 0),
                (1 << HOT, 0),
                (0, 0),
                (0, 700),
                (1 << HOT, 700),
                (1 << WARM, 700),
                (1 << HOT | 1, 700),
                (1 << HOT | 1, 700),
                (0, 0),
                (0, 700),
            ],
            [0, 1, 1, 0, 1, 1, 3, 3, 3, 0],
        ),
        (
            [(1 << HOT, 7), (0, 7), None, (1 << HOT, 7), (1 << HOT | 1, 7), (0, 7), (1 << HOT, 7)],
            [0, 0, 0, 0, 1, 1, 2],
        ),
    ],
    ids=["the motor is started again", "telemetry returns with errors"],
)
def test_error_count_counts_errors_since_the_motor_was_started(
    flight: list[tuple[int, int] | None],
    counts: list[int],
) -> None:
    bench = Bench()
    found = []
    for second in flight:
        bench.live[0] = None
        if second is not None:
            bench.live[0] = LIVE._replace(operating_errors=second[0], electrical_speed=second[1])
        found.append(bench.run(1.1).of("Status")[-1].payload.error_count)
    assert found == counts


@pytest.mark.parametrize("health", ["gateway", "esc"])
def test_errors_of_an_esc_change_health_only_if_configured(health: str) -> None:
    bench = Bench(2, per_esc_nodes=True, health=health).run(0.5)
    found = []
    for bench.live[0] in (LIVE, WARM_NOW, HOT_NOW, None):
        bench.run(1.5)
        found.append([bench.of("NodeStatus", node)[-1].payload.health for node in (42, 43)])
    expected = [[0, 0]] * 4
    if health == "esc":
        expected = [[0, 0], [1, 0], [2, 0], [1, 0]]
    assert found == expected
    assert {each.payload.mode for each in bench.of("NodeStatus")} == {wire.OPERATIONAL}


def test_node_sends_its_status_and_the_gateways_health_each_second() -> None:
    """Without telemetry it sends nothing else.

    NodeStatus has the lowest error bits, and at the end the node reports that it is offline.
    """
    bench = Bench()
    bench.live[0] = None
    bench.run(2)
    assert {each.name for each in bench.read} == {"NodeStatus"}
    assert bench.read[0].at == START
    bench.live[0] = LIVE._replace(operating_errors=1 << HOT | 1 << 17)
    got = bench.run(1.5).of("NodeStatus")[-1].payload
    assert got.uptime_sec == 3
    assert got.health == 0
    assert got.vendor_specific_status_code == 1 << HOT
    assert bench.intervals("NodeStatus") == {SECOND}
    for state, health in ((CanState.ERROR_PASSIVE, 1), (CanState.ERROR_ACTIVE, 0)):
        bench.gateway.set_can_state(state, bench.now)
        assert bench.run(1).of("NodeStatus")[-1].payload.health == health
    bench.clear()
    bench.gateway.stop(bench.now)
    bench.take()
    assert [(each.name, each.payload.mode) for each in bench.read] == [("NodeStatus", 7)]


@pytest.mark.parametrize("is_pure", [True, False])
def test_transfer_ids_count_from_0_to_31_for_each_message_of_a_node(
    is_pure: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A receiver takes a transfer with the same id as the one before for a repetition."""
    monkeypatch.setenv(load.PURE, str(int(is_pure)))
    load.library.cache_clear()
    bench = Bench(2, extended_hz=5).run(70)
    load.library.cache_clear()
    bench.live[0] = HOT_NOW
    bench.run(2)
    for name in ("NodeStatus", "Status", "StatusExtended", "CircuitStatus", "Temperature"):
        numbers = [each.number for each in bench.of(name)]
        assert len(numbers) > 64
        assert numbers == [n % 32 for n in range(len(numbers))], name
    texts = [each.number for each in bench.of("LogMessage")]
    assert texts == list(range(len(texts))) != []


@pytest.mark.promise("late-frames")
def test_values_that_waited_in_a_hold_up_are_not_sent() -> None:
    """No frame is sent later in place of a missed one, and only fresh values are sent."""
    bench = Bench().run(1)
    bench.clear()
    bench.now += 3 * SECOND
    bench.gateway.held_up(bench.now, True)
    bench.gateway.advance(bench.now)
    bench.take()
    assert not bench.of("Status")  # the telemetry is three seconds old
    assert len(bench.of("NodeStatus")) == 1
    assert len(bench.run(0.1).of("Status")) == 5


def text_of(bench: Bench) -> str:
    """Return all log messages since the bench was cleared, and clear it."""
    texts = [bytes(each.payload.text.to_bytes()).decode() for each in bench.of("LogMessage")]
    assert all(len(text) <= 90 for text in texts)
    bench.clear()
    return " ".join(texts)


def test_errors_are_logged_with_the_remedy_when_they_begin_and_end() -> None:
    """Bits of other severities are not logged. Without telemetry no error begins or ends."""
    bench = Bench().run(0.5)
    assert not bench.of("LogMessage")
    bench.live[0] = LIVE._replace(operating_errors=1 << HOT | 1 << 12)  # with the summary bit
    got = [each.payload for each in bench.run(2).of("LogMessage")]
    assert {(each.level.value, bytes(each.source.to_bytes())) for each in got} == {(3, b"e0")}
    assert text_of(bench) == f"e0: {HOT.meaning}. {HOT.remedy}"
    for live in (None, bench.live[0]):
        bench.live[0] = live
        assert text_of(bench.run(15)) == ""
    bench.live[0] = LIVE
    (end,) = bench.run(12).of("LogMessage")
    assert end.payload.level.value == 1
    assert text_of(bench) == f"e0: over: {HOT.meaning}"
    silent = Bench(log_messages=False)
    silent.live[0] = HOT_NOW
    assert text_of(silent.run(2)) == ""


def test_bit_is_logged_at_most_each_ten_seconds() -> None:
    """One bit flaps all the time, and another one is on when the bus returns."""
    bench = Bench()
    for turn in range(600):
        bench.live[0] = LIVE._replace(operating_errors=turn % 2 << WARM)
        bench.run(0.1)
    assert 1 <= len(bench.of("LogMessage")) <= 2 * 7
    bench = Bench().run(0.5)
    bench.live[0] = WARM_NOW
    begun = len(bench.run(1).of("LogMessage"))
    bench.gateway.can_returned(bench.now)
    assert len(bench.run(9).of("LogMessage")) == begun > 0
    assert len(bench.run(2.5).of("LogMessage")) == 2 * begun


@pytest.mark.parametrize("is_bus_off", [False, True])
def test_errors_during_a_bus_outage_are_logged_when_the_bus_returns(
    is_bus_off: bool,
) -> None:
    bench = Bench().run(0.5)
    bench.gateway.set_can_state(CanState.BUS_OFF if is_bus_off else CanState.DOWN, bench.now)
    bench.live[0] = WARM_NOW
    bench.run(3)
    bench.clear()  # discards frames that a bus in bus-off did not take
    assert text_of(bench.run(15)) == ""
    if is_bus_off:
        bench.gateway.set_can_state(CanState.ERROR_ACTIVE, bench.now)
    else:
        bench.gateway.can_returned(bench.now)
        assert bench.run(0.01).read[0].name == "NodeStatus"
    assert text_of(bench.run(1.1)) == f"e0: {WARM.meaning}. {WARM.remedy}"
