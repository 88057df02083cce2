"""A user's own DBC on a real bus: 29-bit ids, big-endian, CAN FD, one multiplexer, other cycle times; no code change."""

import time
from collections.abc import Callable
from pathlib import Path

import can
import cantools.database
from vcan_tools import GatewayProcess, bench, configuration

from kontronik_can_gw.simulator import FLIGHT, EscOptions

Start = Callable[..., GatewayProcess]
QUICK = tuple(
    phase._replace(duration_s=max(0.3, phase.duration_s * 0.1), ramp_s=phase.ramp_s * 0.1) for phase in FLIGHT
)

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


def test_a_users_dbc_is_followed(vcan: str, start_gateway: Start, tmp_path: Path) -> None:
    (tmp_path / "car.dbc").write_text(USERS_DBC)
    database = cantools.database.load_string(USERS_DBC, "dbc", strict=True)
    assert isinstance(database, cantools.database.Database)
    dbc = '[dbc]\nfile = "car.dbc"\nnode = "Gw"\n[dbc.bind]\n"BigEndian.Temp" = "power_stage_temperature"\n'
    with bench(EscOptions(profile=QUICK)) as run, can.Bus(interface="socketcan", channel=vcan, fd=True) as bus:
        gateway = start_gateway(configuration(vcan, [run.ports[0].path], dbc=f"fd = true\n{dbc}"))
        gateway.wait_for_line("esc1: /dev/pts")
        run.start()
        received: list[can.Message] = []
        deadline = time.monotonic() + 4
        while time.monotonic() < deadline:
            if (message := bus.recv(0.5)) is not None:
                received.append(message)
        run.stop()
        assert gateway.end() == 0
    live = run.live(0)
    counts = {message.name: 0 for message in database.messages}
    pages = set()
    for message in received:
        known = database.get_message_by_frame_id(message.arbitration_id)
        assert message.is_extended_id == known.is_extended_frame
        assert message.is_fd == (known.length > 8)
        values = known.decode_simple(bytes(message.data))
        recent = [data for when, data in live if message.timestamp - 0.15 < when < message.timestamp + 0.05]
        found = {
            "BigEndian": lambda d, v=values: (
                abs(v["battery_voltage"] - d.battery_voltage * 10) < 1e-6
                and abs(v["BATTERYCURRENT"] - d.battery_current / 10) <= 0.25 + 1e-9
                and abs(v["Temp"] - (d.power_stage_temperature + 273.15)) < 1e-6
            ),
            "Pages": lambda d, v=values: (
                abs(v["MotorSpeed"] - d.electrical_speed / 7) <= 0.5 + 1e-9
                if v["Page"] == 0
                else abs(v["ConsumedCharge"] - d.consumed_charge / 1000) < 1e-6
            ),
            "Long": lambda d, v=values: (
                (v["ElectricalSpeed"], v["OperatingErrors"], v["PwmInput"])
                == (d.electrical_speed, d.operating_errors, d.pwm_input)
            ),
        }[known.name]
        if known.name == "Pages":
            pages.add(values["Page"])
        if any(map(found, recent)):
            counts[known.name] += 1
        else:
            early = not recent or message.timestamp < live[0][0] + 0.05
            late = message.timestamp > live[-1][0] + 0.2
            assert early or late, f"{known.name}: {values} fits nothing that was sent"
    assert counts["NotOurs"] == 0
    assert pages == {0, 1}
    assert counts["BigEndian"] > 100
    assert counts["Pages"] > 80
    assert counts["Long"] > 300
