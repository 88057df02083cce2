"""ESCs on pseudo terminals -> gateway process -> vcan: each value on the bus is one that was sent, in order, decoded by the DBC alone."""

import signal
from pathlib import Path
from typing import Any

import can
import cantools.database
import pytest
from encoding import POLE_PAIRS, Identity
from harness import PtyPort
from vcan_tools import Chain, chain, configuration, gateway_process, wait_for

from kontronik_can_gw.esc.kontronik.codec import Layout
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
                lambda name=link: run.signal(name, "link_state") in LINK_THERE,  # type: ignore[misc]
                "the link is there",
            )
        newest = [len(fed.sent) - 1 for fed in run.escs]
        assert run.watch.values > 2 * times * len(identities)
        wait_for(
            lambda: all(fresh[-1].n == n for fresh, n in zip(run.watch.fresh, newest, strict=True)),
            "the newest values",
        )
        assert gateway.end(number) == 0, gateway.log
        run.catch_up()
        assert run.signal("GatewayStatus", "gateway_state") == STOPPING


NOT_AVAILABLE = bytes.fromhex("ffffffffff80ff")
"""What EscCurrent says without telemetry."""


def links(run: Chain, begin: int) -> list[int]:
    """What EscLink has said since then."""
    return [frame.data[0] & 15 for frame in run.watch.recorded[begin:] if frame.can_id == 0x6B0]


def go_silent(run: Chain) -> None:
    """Frames until the loss."""
    run.feed(times=5)
    begin = len(run.watch.recorded)
    wait_for(lambda: LINK_LOST in links(run, begin), "the link is lost")


def test_loss_and_return_of_telemetry_are_on_the_bus(vcan: str, tmp_path: Path) -> None:
    with chain(vcan, tmp_path, Identity(1), esc="") as run, run.running() as gateway:
        for loss in (1, 2):
            go_silent(run)
            count = len(run.watch.of(0x680))
            wait_for(
                lambda count=count: len(run.watch.of(0x680)) >= count + 3,  # type: ignore[misc]
                "cyclic messages go on",
            )
            assert all(frame.data[3] == 0xFF for frame in run.watch.of(0x680)[-3:]), (
                "with NotAvailable"
            )
            lost = [frame.data[:7] == NOT_AVAILABLE for frame in run.watch.of(0x688)]
            assert lost[-2:] == [False, True], "event messages say so once"
            wait_for(
                lambda loss=loss: gateway.log.count("telemetry lost") >= loss,  # type: ignore[misc]
                "the log says so",
            )
        begin = len(run.watch.recorded)
        run.feed()
        wait_for(lambda: set(links(run, begin)) & set(LINK_THERE), "the link is there again")


def test_silent_on_loss_stops_values_but_not_the_link_status(vcan: str, tmp_path: Path) -> None:
    with (
        chain(vcan, tmp_path, Identity(1), esc="", toml='[dbc]\non_loss = "silent"') as run,
        run.running(),
    ):
        go_silent(run)
        begin = len(run.watch.recorded)
        wait_for(
            lambda: sum(f.can_id == 0x6D9 for f in run.watch.recorded[begin:]) >= 2,
            "the gateway's messages",
        )
        late = {frame.can_id for frame in run.watch.recorded[begin:]}
        assert late == {0x680, 0x6B0, 0x6D8, 0x6D9}, "both messages with link status go on"


USERS_DBC = """VERSION ""

NS_ :

BS_:

BU_: Gw Car

BO_ 2566844672 BigEndian: 8 Gw
 SG_ battery_voltage : 7|16@0+ (1,0) [0|60000] "mV" Car
 SG_ BATTERYCURRENT : 23|12@0- (0.5,0) [-1000|1000] "A" Car
 SG_ Temp : 39|16@0+ (0.01,0) [0|655] "K" Car

BO_ 291 Pages: 8 Gw
 SG_ Page M : 0|4@1+ (1,0) [0|1] "" Car
 SG_ MotorSpeed m0 : 8|32@1+ (1,0) [0|0] "rpm" Car
 SG_ ConsumedCharge m1 : 8|16@1+ (0.001,0) [0|0] "Ah" Car

BO_ 292 Long: 24 Gw
 SG_ ElectricalSpeed : 0|32@1- (1,0) [0|0] "1/min" Car
 SG_ OperatingErrors : 32|32@1+ (1,0) [0|0] "" Car
 SG_ PwmInput : 160|16@1+ (1,0) [0|0] "us" Car

BO_ 293 NotOurs: 8 Car
 SG_ Whatever : 0|8@1+ (1,0) [0|0] "" Gw

BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ BO_ "GenMsgSendType" ENUM "Cyclic","Event";
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","StandardCAN_FD","ExtendedCAN_FD";
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "GenMsgSendType" "Cyclic";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
BA_ "GenMsgCycleTime" BO_ 2566844672 20;
BA_ "GenMsgCycleTime" BO_ 291 25;
BA_ "GenMsgSendType" BO_ 292 1;
BA_ "VFrameFormat" BO_ 292 2;
"""


def test_a_users_dbc_is_followed(vcan: str, tmp_path: Path) -> None:
    """29-bit ids, big-endian, CAN FD, a multiplexer, other cycle times and units: after each frame of the ESC its values, by cantools."""
    (tmp_path / "car.dbc").write_text(USERS_DBC)
    database = cantools.database.load_string(USERS_DBC, "dbc", strict=True)
    assert isinstance(database, cantools.database.Database)
    dbc = 'fd = true\n[dbc]\nfile = "car.dbc"\nnode = "Gw"\n[dbc.bind]\n"BigEndian.Temp" = "power_stage_temperature"\n'
    port = PtyPort(tmp_path / "esc1", Identity(1))
    toml = configuration(vcan, [port.path], dbc)
    with (
        can.Bus(interface="socketcan", channel=vcan, fd=True) as bus,
        gateway_process(tmp_path / "c.toml", toml),
    ):
        for n in range(30):
            while len(port.fed.sent) == n:
                port.fed.send_one()
            data = port.fed.live(n)
            wanted: dict[tuple[str, str], tuple[float, float]] = {
                ("BigEndian", "battery_voltage"): (data.battery_voltage * 10, 0),
                ("BigEndian", "BATTERYCURRENT"): (data.battery_current / 10, 0.25),
                ("BigEndian", "Temp"): (data.power_stage_temperature + 273.15, 0),
                ("Pages", "MotorSpeed"): (data.electrical_speed / POLE_PAIRS, 0.5),
                ("Pages", "ConsumedCharge"): (data.consumed_charge / 1000, 0),
                ("Long", "ElectricalSpeed"): (data.electrical_speed, 0),
                ("Long", "OperatingErrors"): (data.operating_errors, 0),
                ("Long", "PwmInput"): (data.pwm_input, 0),
            }
            shown: dict[tuple[str, str], Any] = {}

            def all_shown(
                wanted: dict[tuple[str, str], tuple[float, float]] = wanted,
                shown: dict[tuple[str, str], Any] = shown,
            ) -> bool:
                message = bus.recv(1)
                if message is not None:
                    known = database.get_message_by_frame_id(message.arbitration_id)
                    assert message.is_extended_id == known.is_extended_frame
                    assert message.is_fd == (known.length > 8)
                    assert known.name != "NotOurs"
                    values = known.decode_simple(bytes(message.data))
                    shown.update({(known.name, name): value for name, value in values.items()})
                return all(
                    key in shown and abs(shown[key] - value) <= half + 1e-6
                    for key, (value, half) in wanted.items()
                )

            wait_for(all_shown, f"frame {n}: {wanted}")
    port.close()
    assert port.received() == 0
