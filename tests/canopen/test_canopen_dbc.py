"""The DBC of the CANopen side decodes the nodes' frames to the values of the telemetry."""

import re
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import dialogue
import pytest
from cantools.database.can import Database
from cantools.database.namedsignalvalue import NamedSignalValue
from dbc_bench import check_comments
from eds_text import SHIPPED as EDS_TEXT
from eds_text import variable, with_object
from packer_oracle import ERROR_BITS, KNOWN, pascal, read

from kontronik_can_gw.canopen import eds as reader
from kontronik_can_gw.cli import main
from kontronik_can_gw.dbc.names import esc_prefix
from kontronik_can_gw.desk.dbc import canopen as canopen_dbc
from kontronik_can_gw.desk.dbc.writer import copies_text
from kontronik_can_gw.esc.kontronik.simulator import (
    BYTE_NS,
    Dropout,
    ErrorWindow,
    EscOptions,
    Faults,
    SimulatedEsc,
)
from kontronik_can_gw.esc.kontronik.states import Device, OperatingError
from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("shipped-eds")

SHIPPED = Path(__file__).parents[2] / "dbc" / "kontronik_canopen.dbc"
ONE = (EscSettings("esc1"),)
PAIR = (EscSettings("left"), EscSettings("right_r", pole_pairs=7, gear=Fraction(5, 2)))
NA = "NotAvailable"


def described(bench: dialogue.Bench) -> str:
    """Return the DBC of the nodes in their present state."""
    settings = [esc.settings for esc in bench.gateway.escs]
    text = canopen_dbc.pdo_text(bench.output, settings)
    assert text.isascii()
    return text


def remap(
    bench: dialogue.Bench,
    pdo: int,
    cob_id: int,
    objects: Sequence[int],
    node: int = 1,
    kind: int = 254,
) -> None:
    """Change a mapping by the procedure of CiA 301. ``objects`` are mapping entries."""
    writes = [(0x1800 + pdo, 1, 0xC0000000 | cob_id, 4), (0x1A00 + pdo, 0, 0, 1)]
    writes += [(0x1A00 + pdo, sub, entry, 4) for sub, entry in enumerate(objects, 1)]
    writes += [(0x1A00 + pdo, 0, len(objects), 1), (0x1800 + pdo, 2, kind, 1)]
    writes += [(0x1800 + pdo, 1, 0x40000000 | cob_id, 4)]
    for index, sub, value, size in writes:
        assert bench.write(index, sub, value, node, size) is None


class Bench(dialogue.Bench):
    """A gateway with simulated ESCs.

    Each frame is decoded immediately and compared with the telemetry of that moment.
    """

    def __init__(
        self,
        escs: Sequence[EscSettings] = ONE,
        simulated: Sequence[EscOptions] = (EscOptions(),),
        **more: Any,
    ) -> None:
        self.database = Database()
        self.seen: dict[str, list[dict[str, Any]]] = {}
        """Decoded values of each message by its name, in order."""
        self.simulators = [
            SimulatedEsc(option, seed=n, start_ns=MS) for n, option in enumerate(simulated)
        ]
        self.prefixes = [esc_prefix(esc.name) if len(escs) > 1 else "" for esc in escs]
        super().__init__(escs=escs, boot=False, **more)
        self.database = read(described(self))
        for frame in self.take():
            self.decode(frame)

    def run(self, until: int) -> None:
        events = []
        for number, simulator in enumerate(self.simulators):
            for sent in simulator.frames_until(until):
                end = sent.time_ns + len(sent.wire) * BYTE_NS
                events.append((end, number, sent.wire))
        for when, esc, wire in sorted(events):
            self.pass_time(when)
            self.uart(wire, esc)
        self.pass_time(until)

    def _collect(self) -> None:
        before = len(self.heard)
        super()._collect()
        if self.database.messages:
            for _, frame in self.heard[before:]:
                self.decode(frame)

    def decode(self, sent: CanFrame) -> None:
        if 0x580 <= sent.can_id < 0x600:
            return
        message = self.database.get_message_by_frame_id(sent.can_id)
        assert len(sent.data) == message.length, message.name
        decoded: Any = message.decode(sent.data)
        values = {}
        for name, value in decoded.items():
            values[name] = str(value) if isinstance(value, NamedSignalValue) else value
        self.seen.setdefault(message.name, []).append(values)
        if "Tpdo" not in message.name:
            return
        used = [{use.cob_id for use in node.uses()} for node in self.nodes]
        esc = next(n for n, cob_ids in enumerate(used) if sent.can_id in cob_ids)
        known = self.expected(self.gateway.escs[esc])
        for signal in message.signals:
            wanted = known[signal.name.removeprefix(self.prefixes[esc])]
            if isinstance(wanted, Fraction):
                wanted = pytest.approx(float(wanted), abs=float(signal.scale) / 2 + 1e-9)
            assert values[signal.name] == wanted, signal.name

    def expected(self, esc: EscTelemetry) -> dict[str, Any]:
        """Return the expected value of each signal without prefix, by the packers' oracle."""
        found: dict[str, Any] = {}
        for name, known in KNOWN.items():
            value = known.read(esc, self.gateway.status, self.now)
            shown = NA if value is None else known.names.get(int(value), value)
            found[pascal(name) + ("Percent" if known.unit == "%" else "")] = shown
        found |= {pascal(bit): int(found[pascal(bit)] != 0) for bit in ERROR_BITS}
        state = found["OperatingState"]
        if isinstance(state, str):
            found["OperatingState"] = state.replace("_", "")
        else:
            found["OperatingState"] = f"State{state}"
        found |= {"Replay": 0, "InfoValid": int(esc.info is not None)}
        found["LiveCounter"] = esc.counters.live % 256
        found["VelocityActualValue"] = found["MotorSpeed"]
        found["DcLinkCircuitVoltage"] = found["BatteryVoltage"]
        return found


# --- the shipped file


def test_command_writes_the_shipped_file(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dbc", "--canopen"]) == 0
    assert capsys.readouterr().out == SHIPPED.read_text()
    assert copies_text(read(SHIPPED.read_text())) == SHIPPED.read_text(), "it can be written again"


# --- decoding the nodes' frames


def test_every_frame_of_running_nodes_decodes_to_the_telemetry() -> None:
    """One ESC has errors and a loss of telemetry. The other is a JIVEPRO without BEC current."""
    hot = OperatingError.POWER_STAGE_OVERTEMP_WARNING
    errors = (
        ErrorWindow(OperatingError.UNDERVOLTAGE, SECOND, SECOND),
        ErrorWindow(hot, 3 * SECOND, SECOND),
    )
    faults = Faults(errors=errors, dropout=Dropout(2 * SECOND, 8 * SECOND))
    escs = EscOptions(faults=faults), EscOptions(device=Device.JIVEPRO)
    bench = Bench(PAIR, escs, node_ids=(5, 9))
    bench.start()
    bench.run(9 * SECOND)
    count = {name: len(values) for name, values in bench.seen.items()}
    assert set(count) == {message.name for message in bench.database.messages} - {"RightREmergency"}
    assert count["RightRTpdo1"] > 300
    assert count["RightRTpdo2"] > 100
    assert count["RightRTpdo3"] > 60
    ids = {message.name: message.frame_id for message in bench.database.messages}
    assert ids["LeftTpdo1"] == 0x185
    assert ids["RightRHeartbeat"] == 0x709
    assert ids["LeftEmergency"] == 0x85
    assert "node 5 (left), node 9 (right_r)" in str(bench.database.buses[0].comment)
    states = [values["LeftNodeState"] for values in bench.seen["LeftHeartbeat"]]
    assert states == ["BootUp", *["Operational"] * 9]
    emergencies = bench.seen["LeftEmergency"]
    codes = [(each["LeftEmergencyCode"], each["LeftEmergencySource"]) for each in emergencies]
    assert codes == [
        ("Undervoltage", "Undervoltage"),
        ("NoError", "Gateway"),
        (pascal(hot.name), pascal(hot.name)),
        ("NoError", "Gateway"),
        ("TelemetryFault", "Gateway"),
        ("NoError", "Gateway"),
    ]
    first = emergencies[0]
    register = {name for name in first if "ErrorRegister" in name and first[name]}
    assert register == {"LeftErrorRegisterGeneric", "LeftErrorRegisterVoltage"}
    seen = [values["LeftLinkState"] for values in bench.seen["LeftTpdo4"]]
    assert seen[0] == "NeverSeen"
    assert "Lost" in seen
    assert seen[-1] in ("Ok", "Degraded")
    seen = [values["RightROperatingState"] for values in bench.seen["RightRTpdo4"]]
    assert {"MotorOff", "SpoolUpFromStill"} <= set(seen)
    assert bench.seen["RightRTpdo3"][-1]["RightRBecCurrent"] == NA
    assert bench.seen["LeftTpdo3"][-1]["LeftBecCurrent"] != NA


# --- other mappings


def delay(message: Any) -> int:
    found = message.dbc.attributes.get("GenMsgDelayTime")
    return 0 if found is None else found.value


def test_dbc_has_the_timing_of_pdos_at_syncs_and_disabled_messages() -> None:
    bench = dialogue.Bench()
    remap(bench, 0, 0x181, [0x20000120], kind=3)
    remap(bench, 1, 0x281, [0x20000410], kind=0)
    off = (0x1802, 1, 0xC0000381, 4), (0x1803, 5, 0, 2), (0x1017, 0, 0, 2), (0x1015, 0, 1230, 2)
    for index, sub, value, size in off:
        assert bench.write(index, sub, value, size=size) is None
    db = read(described(bench))
    sent = {m.name: (m.send_type, m.cycle_time or 0, delay(m)) for m in db.messages}
    assert sent == {
        "EscTpdo1": ("None", 0, 0),
        "EscTpdo2": ("None", 0, 0),
        "EscTpdo4": ("OnChange", 0, 0),
        "EscHeartbeat": ("Event", 0, 0),
        "EscEmergency": ("Event", 0, 123),
    }
    comments = {m.frame_id: str(m.comment) for m in db.messages}
    assert "every SYNC number 3" in comments[0x181]
    assert "at the next SYNC after a change" in comments[0x281]
    assert "only the boot-up message" in comments[0x701]
    assert bench.write(0x1014, 0, 0x80000081, size=4) is None
    assert "EscEmergency" not in described(bench)


PLAIN = [
    ("Nick-Winkel des linken Auslegers (grob)", 0x03, "-5", "NickWinkelDesLinkenAuslegersGrob", -5),
    ("%%", 0x05, "7", "Object2201Sub00", 7),
    ("oil pressure", 0x08, "1.5", "OilPressure", 1.5),
    ("BIG", 0x1B, "0xFFFFFFFFFFFFFFFF", "Big", 0xFFFFFFFFFFFFFFFF),
    ('a "switch"; here\\', 0x01, "1", "ASwitchHere", 1),
    ("Battery voltage 2", 0x04, "-70000", "BatteryVoltage2", -70000),
]


def test_storage_object_of_any_eds_is_a_raw_signal_with_its_name() -> None:
    text = EDS_TEXT
    for number, (name, kind, value, *_) in enumerate(PLAIN):
        content = variable(kind, name=name, DefaultValue=value, PDOMapping=1)
        text = with_object(text, 0x2200 + number, content)
    bench = dialogue.Bench(eds=reader.load(text.encode(), "mine.eds"))
    remap(bench, 0, 0x181, [0x22040001, 0x22000010, 0x22010008, 0x22020020])
    remap(bench, 1, 0x281, [0x22030040])
    remap(bench, 2, 0x381, [0x22050020])
    assert bench.write(0x1803, 1, 0xC0000481, size=4) is None
    text = described(bench)
    database = read(text)
    bench.take()
    bench.put(0, "01 00")
    decoded: dict[str, Any] = {}
    for sent in bench.take():
        values: Any = database.decode_message(sent.can_id, sent.data)
        decoded |= values
    assert decoded == {name: value for *_, name, value in PLAIN}
    assert "SIG_VALTYPE_ 385 OilPressure : 1;" in text
    assert "SG_ OilPressure : 25|32@1+ (1,0) [0|0] " in text
    assert "a 'switch', here/" in text
    assert "VAL_ 641" not in text


def test_names_that_are_too_long_are_cut_and_remain_unique() -> None:
    escs = [EscSettings("port_outer_1"), EscSettings("port_outer_2")]
    text = described(dialogue.Bench(escs=escs))
    db = read(text)
    messages = [m.name for m in db.messages]
    signals = [s.name for m in db.messages for s in m.signals]
    for names in (messages, signals):
        assert len({name.lower() for name in names}) == len(names)
    check_comments(db)
    names = messages + signals
    assert max(map(len, names)) == 32
    assert all(re.fullmatch("PortOuter[12][A-Z][A-Za-z0-9]*", name) for name in names)
    assert "PortOuter1LimitBatteryVoltageMin" in names


def test_node_that_waits_for_lss_has_no_frames_and_causes_a_warning(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = tmp_path / "gateway.toml"
    esc = '[[esc]]\nname = "{}"\nport = "/dev/tty{}"\n'
    file.write_text(
        '[can]\ninterface = "virtual"\n[dbc]\nenabled = false\n[canopen]\nenabled = true\n'
        + esc.format("left", 0)
        + esc.format("right_r", 1)
        + "node_id = 255\n"
    )
    assert main(["dbc", "--canopen", "-c", str(file)]) == 0
    text, said = capsys.readouterr()
    assert "right_r: left out, because LSS has not assigned a node-ID yet" in said
    db = read(text)
    assert {message.name[:4] for message in db.messages} == {"Left"}
    assert "No frames yet, because LSS must assign a node-ID: right_r." in str(db.buses[0].comment)
    assert read(described(dialogue.Bench(node_ids=(255,)))).messages == []
