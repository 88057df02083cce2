"""Another ESC protocol works in the whole gateway without a change of the package.

An ESC with the protocol of kiss.py runs beside a KONTRONIK ESC.
"""

import re
import termios
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import cantools
import pytest

from kontronik_can_gw.assembly.assemble import assemble
from kontronik_can_gw.assembly.capture_setup import CaptureSetup
from kontronik_can_gw.canopen.dictionary import SdoAbort
from kontronik_can_gw.canopen.nodes import Nodes
from kontronik_can_gw.canopen.setup import shipped_canopen
from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.desk.pty import PtyEsc
from kontronik_can_gw.desk.receiver.unpacker import SignalReader
from kontronik_can_gw.desk.recordings.fields import fields_of_values
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc import protocols
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import LinkState
from kontronik_can_gw.esc.values import VALUES, Group, values_of
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.ports.serial_port import SerialPort
from kontronik_can_gw.runtime.status.facts import PortFacts
from kontronik_can_gw.runtime.status.snapshot import _esc
from kontronik_can_gw.times import SECOND

from .kiss import KISS, frame

pytestmark = pytest.mark.promise("another-protocol")

DBC = Path(__file__).with_name("kiss.dbc")
PERIOD = SECOND // 10
MIXED: dict[str, Any] = {
    "can": {"interface": "virtual", "channel": "kiss"},
    "dbc": {"file": str(DBC), "node": "Gateway"},
    "esc": [
        {"port": "/dev/null", "name": "old"},
        {"port": "/dev/zero", "name": "kiss", "protocol": "kiss", "pole_pairs": 7},
    ],
}


@pytest.fixture(autouse=True)
def kiss_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(protocols, "PROTOCOLS", (*protocols.PROTOCOLS, KISS))


class Flight:
    """Two ESCs that send ten times a second, and the newest message of each id.

    cantools decodes the messages. A code is None.
    """

    def __init__(self, **options: Any) -> None:
        config = parse(MIXED, "mixed.toml")
        self.loaded = assemble(config)
        self.gateway = Gateway(self.loaded.core_settings, 0, **options)
        self.gateway.start(0)
        self.now = 0
        self.seen: dict[str, float] = {}
        self._database: Any = cantools.database.load_file(str(DBC))

    def send(self, *data: bytes) -> None:
        self.now += PERIOD
        for esc, wire in enumerate(data):
            if wire:
                self.gateway.receive_bytes(esc, wire, self.now, self.now)
        self.gateway.advance(self.now)
        for sent in self.gateway.take_frames(self.now):
            if 257 <= sent.can_id <= 259:
                self.seen |= self._database.decode_message(sent.can_id, sent.data)


FRAME = frame(20, 2_400, 1_234, 55, 210)
OLD_LIVE = LiveData(electrical_speed=9_000, battery_voltage=2_500, battery_current=-5)
OLD = encode(OLD_LIVE, WireLayout.V4)


def test_values_of_both_protocols_are_sent() -> None:
    flight = Flight()
    for _ in range(361):
        flight.send(OLD, frame(-7, 2_400, 1_234, 55, 210))
    assert flight.seen == {
        "KissBatteryVoltage": 24.0,
        "KissBatteryCurrent": pytest.approx(12.3),  # 12.34 A in steps of 0.1 A
        "KissMotorSpeed": 3_000,
        "KissPowerStageTemperature": -7,
        "KissBecVoltage": pytest.approx(655.35),  # FFFFh: KISS does not have it
        "KissEnergyUsed": pytest.approx(2.96),  # 24 V by 12.34 A for 36 s
        "KissLinkState": LinkState.OK,
        "KissLayout": 1,
        "KissUndervoltage": 0,
        "OldBatteryVoltage": 25.0,
        "OldBatteryCurrent": pytest.approx(-0.5),
        "OldElectricalSpeed": 9_000,
    }
    for _ in range(4):
        flight.send(OLD, b"")
    assert flight.seen["KissBatteryVoltage"] == pytest.approx(655.35)
    assert flight.seen["KissLinkState"] == LinkState.LOST
    assert flight.seen["OldBatteryVoltage"] == 25.0


def test_missing_flag_is_not_read_as_no_error() -> None:
    loaded = Flight().loaded
    reader = SignalReader(loaded.layout)
    columns = [(each.source, each.esc) for each in reader.columns]
    column = columns.index(("undervoltage", 1))
    first, values = (reader.read(258, bytes(8)) or [])[0]
    assert values[column - first] is None
    (warning,) = [line for line in loaded.warnings if "never available" in line]
    words = "KissMore: KissBecVoltage, KissUndervoltage: never available, because the protocol kiss"
    assert words in warning


@pytest.mark.parametrize(
    ("missing", "value"),
    [("electrical_speed", "motor_run_time"), ("battery_current", "energy_used")],
)
def test_value_whose_field_is_missing_is_not_supplied(missing: str, value: str) -> None:
    fields = tuple(field for field in KISS.fields if field.name != missing)
    assert values_of(KISS)[value].supplied
    assert not values_of(replace(KISS, fields=fields))[value].supplied


def test_node_status_and_tables_show_only_supplied_values() -> None:
    flight = Flight(outputs=[shipped_canopen([1, 2])])
    flight.send(OLD, FRAME)
    gateway, esc = flight.gateway, flight.gateway.escs[1]
    (nodes,) = gateway.outputs
    assert isinstance(nodes, Nodes)
    found: dict[int, object] = {}
    for sub in range(1, 17):
        read = nodes.nodes[1].dictionary.find(0x2000, sub).read
        assert read is not None
        with suppress(SdoAbort):
            found[sub] = read(flight.now)
    # Sub-indices of the EDS for speed, voltage, current, charge and temperature, and no others.
    assert there(found) == {1: 21_000, 2: 2_400, 3: 123, 6: 55, 12: 20}

    port = PortFacts("kiss", "/dev/zero", open=True)
    document = _esc(esc, port, gateway.status, flight.now)
    assert document["counters"]["live"] == 1
    assert document["operating_state"] is None
    assert document["errors"] is None
    assert document["device"] is None
    live = {}
    for field in fields_of_values([each.settings for each in gateway.escs]):
        if field.esc == 1 and VALUES[field.source].group is Group.LIVE:
            live[field.source] = field.reader(esc, gateway.status, flight.now)
    values = there(document["values"])
    assert there(live).items() <= values.items()
    assert set(there(live)) <= {name for name, value in values_of(KISS).items() if value.supplied}
    assert (
        there(live).items()
        >= {
            "electrical_speed": 21_000,
            "motor_speed": 3_000,
            "output_speed": 3_000,
            "battery_voltage": 24.0,
            "battery_current": 12.34,
            "consumed_charge": 55,
            "power_stage_temperature": 20,
            "battery_power": pytest.approx(24 * 12.34),
        }.items()
    )


def there(values: dict[Any, Any]) -> dict[Any, Any]:
    """Return the values that are available."""
    return {name: value for name, value in values.items() if value is not None}


def test_capture_names_the_protocol() -> None:
    """A capture of version 0.5.0 does not name one, so the first protocol is used."""
    escs = tuple(parse(MIXED, "mixed.toml").escs)
    setup = CaptureSetup(escs, ("a", "b"), None, DbcConfig(), False)
    assert CaptureSetup.of(setup.header()).escs == escs
    old: Any = setup.header()
    for esc in old["escs"]:
        del esc["protocol"]
    assert [esc.protocol for esc in CaptureSetup.of(old).escs] == ["kontronik", "kontronik"]


def test_line_is_set_without_parity() -> None:
    with PtyEsc() as esc, closing(SerialPort(esc.path, KISS)) as port:
        settings = termios.tcgetattr(port.fileno())
    flags = settings[2]
    speed = settings[4]
    assert not flags & termios.PARENB
    assert speed == termios.B115200


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"protocol": "kiss", "device": "KOSMIK"}, '"KOSMIK" is not a device of the protocol kiss'),
        ({"protocol": "kis"}, 'unknown value "kis". Did you mean kiss?'),
    ],
)
def test_invalid_key_of_its_configuration_is_refused(wrong: dict[str, str], said: str) -> None:
    with pytest.raises(UserError, match=re.escape(said)):
        parse(MIXED | {"esc": [{"port": "/dev/null"} | wrong]}, "mixed.toml")
