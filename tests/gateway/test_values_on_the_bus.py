"""Frames that a gateway sends at known times: values that are easily confused or not sent."""

import pytest
from dbc_bench import compiled
from packer_oracle import Msg, Sig, dbc_text

from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.esc.kontronik import codec
from kontronik_can_gw.esc.kontronik.codec import encode
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData, device_and_variant
from kontronik_can_gw.esc.kontronik.states import Device
from kontronik_can_gw.esc.telemetry import INFO_TIMEOUT_NS, EscSettings, LinkState
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("true")

EVENT = 'BA_ "GenMsgSendType" BO_ 256 1;\n'
ON_CHANGE = 'BA_ "GenMsgSendType" BO_ 256 2;\n'
PERIOD = 10 * MS
ESC = EscSettings("esc1")
SPEED = Sig("ElectricalSpeed", 0, 32, unit="1/min")


def text_of(signal: Sig, more: str = EVENT) -> str:
    """Return a DBC with one message of one signal. By default each live frame sends it."""
    return dbc_text([Msg("M", 256, 8, [signal])], more)


def wire(**values: int) -> bytes:
    return encode(LiveData(**values), codec.WireLayout.V4)


class Bench:
    """A gateway with one message that runs at each of its deadlines."""

    def __init__(self, signal: Sig, more: str = EVENT) -> None:
        self.gateway = Gateway(CoreSettings((ESC,), compiled(text_of(signal, more))), 0)
        self.now = 0
        self.gateway.start(0)
        self.first = self.take()

    def live(self, **values: int) -> int:
        """Receive a frame after one period. Return the value of the message after that."""
        return int.from_bytes(self.read(wire(**values))[-1], "little")

    def info(self, device: Device) -> None:
        info = InfoData(device_and_variant=device_and_variant(device, 120), cell_count=6)
        self.read(encode(info, codec.WireLayout.V4))

    def read(self, data: bytes) -> list[bytes]:
        """Receive bytes after one period. Return the frames sent until then and because of them."""
        sent = self.wait(PERIOD)
        self.gateway.receive_bytes(0, data, self.now, self.now)
        self.gateway.advance(self.now)
        return sent + self.take()

    def wait(self, ns: int) -> list[bytes]:
        end = self.now + ns
        sent = []
        due = self.gateway.next_deadline()
        while due <= end:
            self.now = max(self.now, due)
            self.gateway.advance(self.now)
            sent += self.take()
            due = self.gateway.next_deadline()
        self.now = end
        return sent

    def take(self) -> list[bytes]:
        return [frame.data for frame in self.gateway.take_frames(self.now)]


BEC_CURRENT = Sig(
    "BecCurrent",
    0,
    16,
    factor="0.01",
    maximum="655",
    unit="A",
)
NO_BEC_CURRENT = 0xFFFF


@pytest.mark.parametrize(
    ("device", "then"),
    [
        (Device.JIVEPRO, NO_BEC_CURRENT),
        (Device.KOSMIK, 5),
    ],
)
def test_jivepros_bec_current_stays_unavailable_without_information(
    device: Device,
    then: int,
) -> None:
    bench = Bench(BEC_CURRENT)
    bench.info(device)
    assert bench.live(bec_current=50) & 0xFFFF == then
    end = bench.now + INFO_TIMEOUT_NS + SECOND
    while bench.now < end:
        assert bench.live(bec_current=50) & 0xFFFF == then
    assert bench.gateway.escs[0].info is None


def test_messages_without_a_cycle_are_sent_again_after_a_bus_outage() -> None:
    bench = Bench(SPEED)
    bench.live(electrical_speed=30_000)
    bench.wait(SECOND)  # telemetry is lost, and the frame that shows it did not reach the bus
    bench.gateway.can_returned(bench.now)
    assert [data[:4] for data in bench.take()] == [b"\xff\xff\xff\xff"]


@pytest.mark.parametrize(
    ("kind", "name", "per_second"),
    [(EVENT, "Uptime", 1), (ON_CHANGE, "CrcErrors", 10)],
)
def test_counters_without_a_cycle_do_not_go_stale(kind: str, name: str, per_second: int) -> None:
    bench = Bench(Sig(name, 0, 32, unit="s" if name == "Uptime" else ""), kind)
    good = wire(battery_voltage=5000)
    sent: list[bytes] = []
    damaged = good[:20] + b"\x55" + good[21:]
    for n in range(500):  # for 5 s; each tenth frame is damaged
        sent += bench.read(good if n % 10 else damaged)
    assert 3 * per_second <= int.from_bytes(sent[-1][:4], "little") <= 5 * per_second


@pytest.mark.promise("link-state")
def test_each_loss_of_telemetry_counts_once_whatever_its_cause() -> None:
    bench = Bench(SPEED)
    esc = bench.gateway.escs[0]

    def lose_port() -> None:
        bench.gateway.port(0, False, bench.now)

    def time_out() -> None:
        bench.wait(SECOND)

    lose_port()
    bench.gateway.port(0, True, bench.now)
    time_out()
    assert esc.losses == 0  # no value was fresh
    for losses, causes in enumerate(
        ([lose_port], [time_out], [time_out, lose_port], [lose_port, lose_port, time_out]), 1
    ):
        bench.live(electrical_speed=losses)
        for lose in causes:
            lose()
            assert not esc.up
            assert esc.losses == losses
        bench.gateway.port(0, True, bench.now)


@pytest.mark.parametrize(
    ("more", "link"),
    [
        (0, LinkState.OK),
        (1, LinkState.DEGRADED),
    ],
)
def test_link_is_degraded_above_a_tenth_of_dropped_bytes(more: int, link: LinkState) -> None:
    """18 frames and noise of two frames' length arrive in a second, and ``more`` bytes."""
    bench = Bench(SPEED)
    frame = wire(electrical_speed=1)
    bench.read(frame)  # bytes are counted after the first frame
    noise = bytes(2 * len(frame) + more)
    assert (len(noise) * 10 > 18 * len(frame) + len(noise)) == bool(more)
    for n in range(18):
        bench.wait(55 * MS - PERIOD)
        bench.read(noise + frame if n == 0 else frame)
    assert bench.gateway.escs[0].link is LinkState.OK
    bench.wait(20 * MS)  # the second has ended
    assert bench.gateway.escs[0].link is link


def test_dbc_with_a_byte_order_mark_and_a_text_enumeration_is_read() -> None:
    cycle = 'BA_ "GenMsgSendType" BO_ 256 "Cyclic";\nBA_ "GenMsgCycleTime" BO_ 256 20;\n'
    (message,) = compiled("\ufeff" + text_of(SPEED, cycle)).messages
    assert message.cycle_ns == 20 * MS
