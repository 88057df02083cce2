"""ESCs on pseudo terminals -> gateway process -> vcan: each value on the bus is one that was sent, in order, decoded by the DBC alone."""

import signal
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import can
import cantools.database
import pytest
from encoding import POLE_PAIRS, Identity
from harness import PtyPort
from vcan_tools import GatewayProcess, chain, configuration, sent_by, wait_for

from kontronik_can_gw.esc.kontronik.codec import Layout
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.kontronik.states import Device

LINK_THERE, LINK_LOST, STOPPING = (2, 3), 4, 2
"""A link is Degraded rather than Ok when its ESC waits for the bus to show each frame."""
EIGHT = [
    Identity(i + 1, (Layout.V4, Layout.LEGACY)[i % 2], cells=6 + i, alarms=i > 5) for i in range(8)
]


@pytest.mark.parametrize(
    ("identities", "times", "number"),
    [
        ([Identity(1)], 150, signal.SIGTERM),
        ([Identity(2, Layout.LEGACY, Device.JIVEPRO, 12, alarms=True)], 300, signal.SIGINT),
        (EIGHT, 40, signal.SIGTERM),
    ],
    ids=["KOSMIK", "JIVEPRO", "eight"],
)
def test_every_frame_is_on_the_bus_as_it_was_sent_and_the_last_word_is_that_it_ends(
    vcan: str, tmp_path: Path, identities: list[Identity], times: int, number: int
) -> None:
    with chain(vcan, tmp_path, *identities) as run, run.running() as gateway:
        run.feed(times=times)
        every = {can_id for can_id, message in run.watch.table.items()}
        wait_for(
            lambda: {frame.can_id for frame in run.watch.recorded} == every,
            "all messages of the DBC",
        )
        for index, identity in enumerate(identities):
            link = f"Esc{index + 1}Link"
            wait_for(lambda i=index, d=identity.device: run.watch.info_device(i) == d, "the device")  # type: ignore[misc]
            wait_for(
                lambda name=link: run.watch.value(name, "link_state") in LINK_THERE,  # type: ignore[misc]
                "the link is there",
            )
        newest = [len(fed.sent) - 1 for fed in run.escs]
        assert run.watch.values > 2 * times * len(identities)
        wait_for(
            lambda: all(fresh[-1].n == n for fresh, n in zip(run.watch.fresh, newest, strict=True)),
            "the newest values",
        )
        assert gateway.end(number) == 0, gateway.log
        run.watch.wait_for_mark()
        assert run.watch.value("GatewayStatus", "gateway_state") == STOPPING


NOT_AVAILABLE = bytes.fromhex("ffffffffff80ff")
"""What EscCurrent says without telemetry."""


def test_loss_and_return_of_telemetry_are_on_the_bus(vcan: str, tmp_path: Path) -> None:
    with chain(vcan, tmp_path, Identity(1), esc="") as run, run.running() as gateway:
        for times in (1, 2):
            run.feed(times=5)
            count = len(run.watch.of(0x680))
            wait_for(lambda: run.watch.value("Esc1Link", "link_state") == LINK_LOST, "it is lost")
            wait_for(
                lambda count=count: (  # type: ignore[misc]
                    [f.data[3] for f in run.watch.of(0x680)[count:]].count(0xFF) >= 3
                ),
                "cyclic messages go on with NotAvailable",
            )
            lost = [frame.data[:7] == NOT_AVAILABLE for frame in run.watch.of(0x688)]
            assert lost[-2:] == [False, True], "event messages say so once"
            wait_for(
                lambda times=times: gateway.log.count("telemetry lost") >= times,  # type: ignore[misc]
                "the log says so",
            )
        run.feed()
        wait_for(
            lambda: run.watch.value("Esc1Link", "link_state") in LINK_THERE, "it is there again"
        )


CAR = Path(__file__).resolve().parents[1] / "golden" / "inputs" / "my_car.dbc"


FOLLOWED: dict[str, tuple[Callable[[LiveData], float], float]] = {
    "ElectricalSpeed": (lambda data: data.electrical_speed, 1e-6),
    "BatteryVoltage": (lambda data: data.battery_voltage / 100, 0.0251),
    "MotorSpeed": (lambda data: data.electrical_speed / POLE_PAIRS, 0.01),
    "MotorCurrent": (lambda data: data.motor_current * 100, 1e-6),
    "PeakCurrent": (lambda data: data.peak_current / 10, 0.51),
}
"""What signals of the DBC show, and half a step of theirs."""


def test_a_users_dbc_is_followed(
    vcan: str, tmp_path: Path, start_gateway: Callable[..., GatewayProcess]
) -> None:
    """Frames with 29-bit ids, CAN FD, pages and floats leave as the DBC says; that every value is right, the golden set judges."""
    database: Any = cantools.database.load_file(CAR)
    dbc = f'fd = true\n[dbc]\nfile = "{CAR}"\nnode = "Gateway"\nunbound = "start_value"\n[dbc.e2e_data_ids]\nSafe = 0x123\n'
    shown: dict[str, set[float]] = {name: set() for name in FOLLOWED}
    with (
        closing(PtyPort(tmp_path / "esc1", Identity(1))) as port,
        can.Bus(interface="socketcan", channel=vcan, fd=True) as bus,
    ):
        gateway = start_gateway(configuration(vcan, [port], dbc))
        gateway.wait_for_line("CAN socketcan")
        gateway.wait_for_line("esc1: /")

        def enough() -> bool:
            port.send_one()
            while message := bus.recv(0.01):
                known = database.get_message_by_frame_id(message.arbitration_id)
                assert message.is_extended_id == known.is_extended_frame
                assert message.is_fd == (known.length > 8)
                assert known.name != "Theirs"
                for name, value in known.decode_simple(bytes(message.data)).items():
                    if name in FOLLOWED:
                        shown[name].add(value)
            return all(len(values) >= 20 for values in shown.values())

        wait_for(enough, lambda: shown)
        assert port.received() == 0
        sent = sent_by(port)
    for name, (of, half) in FOLLOWED.items():
        wrong = {v for v in shown[name] if all(abs(of(each) - v) > half for each in sent)}
        assert len(wrong) <= 1, (name, wrong)  # what stands for none, before the first frame
