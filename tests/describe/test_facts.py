"""The description is complete and true: compared with what cantools and canopen read from the same files by themselves."""

import json
from enum import IntEnum
from pathlib import Path
from typing import Any

import canopen
import cantools.database
import pytest
from canopen.objectdictionary import ODVariable
from command_line import run
from described import DBC, EDS, TWO_ESCS, configuration, described

from kontronik_can_gw.canopen.data_types import TYPE_NAMES
from kontronik_can_gw.canopen.emergency_codes import GatewayError
from kontronik_can_gw.desk.describe.line_states import CAN_STATES, GATEWAY_STATES, LINK_STATES
from kontronik_can_gw.esc.kontronik.states import OperatingError, OperatingState, SelfTestError
from kontronik_can_gw.esc.telemetry import LinkState
from kontronik_can_gw.esc.values import VALUES
from kontronik_can_gw.gateway_status import CanState, GatewayState

Facts = dict[str, Any]


@pytest.fixture(scope="module")
def facts() -> Facts:
    """The description of what is shipped."""
    found = json.loads(described("--format", "json"))
    assert isinstance(found, dict)
    return found


def by_configuration(folder: Path, text: str) -> Facts:
    found = json.loads(described("-c", configuration(folder, text), "--format", "json"))
    assert isinstance(found, dict)
    return found


def holds(found: Facts, **expected: object) -> None:
    assert {name: found[name] for name in expected} == expected


# --- texts


@pytest.mark.parametrize("kind", [OperatingError, SelfTestError, OperatingState, GatewayError])
def test_each_error_and_state_has_a_meaning_of_its_own_and_a_remedy(kind: Any) -> None:
    assert all(each.meaning.strip() == each.meaning != "" for each in kind)
    assert all(each.remedy.endswith(".") for each in kind)
    assert len({each.meaning for each in kind}) == len(kind)


@pytest.mark.parametrize(
    ("texts", "states"),
    [(LINK_STATES, LinkState), (CAN_STATES, CanState), (GATEWAY_STATES, GatewayState)],
)
def test_each_state_of_line_controller_and_gateway_has_a_meaning_and_a_remedy(
    texts: dict[IntEnum, tuple[str, str]], states: type[IntEnum]
) -> None:
    assert list(texts) == list(states)
    assert all(meaning and remedy.endswith(".") for meaning, remedy in texts.values())


# --- the document of --format json


def test_messages_and_signals_are_those_that_cantools_reads(facts: Facts) -> None:
    database = cantools.database.load_file(DBC)
    assert isinstance(database, cantools.database.Database)
    told = {message["name"]: message for message in facts["dbc"]["messages"]}
    assert set(told) == {message.name for message in database.messages}
    for message in database.messages:
        found = told[message.name]
        assert message.dbc is not None
        holds(
            found,
            id=message.frame_id,
            length=message.length,
            comment=message.comment,
            extended=message.is_extended_frame,
            fd=message.is_fd,
            cycle_ms=message.cycle_time or 0,
            delay_ms=message.dbc.attributes["GenMsgDelayTime"].value,
        )
        assert ("cyclic" in found["send_type"]) == ("Cyclic" in str(message.send_type))
        signals = {row["name"]: row for row in found["signals"]}
        assert set(signals) == {signal.name for signal in message.signals}
        for signal in message.signals:
            choices = {int(number): str(name) for number, name in (signal.choices or {}).items()}
            texts = {name: number for number, name in choices.items()}
            holds(
                signals[signal.name],
                start_bit=signal.start,
                length=signal.length,
                byte_order=signal.byte_order,
                signed=signal.is_signed,
                is_float=signal.is_float,
                unit=signal.unit or "",
                factor=signal.scale,
                offset=signal.offset,
                minimum=signal.minimum,
                maximum=signal.maximum,
                comment=signal.comment,
                values=[{"value": number, "name": choices[number]} for number in sorted(choices)],
                not_available=texts.get("NotAvailable"),
                error=texts.get("Error"),
            )


def test_objects_are_those_that_canopen_reads(facts: Facts) -> None:
    dictionary: Any = canopen.import_od(str(EDS), node_id=0)
    told = {item["index"]: item for item in facts["canopen"]["objects"]}
    assert sorted(told) == sorted(dictionary)
    for index, item in dictionary.items():
        found, is_alone = told[index], isinstance(item, ODVariable)
        assert found["name"] == item.name
        variables: dict[int, Any] = {0: item} if is_alone else dict(item.subindices)
        assert [entry["sub"] for entry in found["entries"]] == sorted(variables)
        assert (found["kind"] == "VAR") == is_alone or found["kind"] == "DOMAIN"
        for entry in found["entries"]:
            variable = variables[entry["sub"]]
            holds(
                entry,
                name=variable.name,
                access=variable.access_type,
                readable=variable.readable,
                writable=variable.writable,
                type=TYPE_NAMES[variable.data_type],
                mappable=variable.pdo_mappable,
                low=variable.min,
                high=variable.max,
                plus_node_id=variable.relative,
                default=variable.default,
            )
            assert entry["bits"] in (None, len(variable))


def test_the_node_has_the_cob_ids_and_pdos_that_canopen_computes(facts: Facts) -> None:
    node = facts["canopen"]["nodes"][0]
    holds(node, esc="esc1", node_id=1)
    ids = {cob["id"] for cob in node["cob_ids"]}
    assert {0x081, 0x181, 0x281, 0x381, 0x481, 0x581, 0x601, 0x701} <= ids
    dictionary: Any = canopen.import_od(str(EDS), node_id=1)
    tried: dict[int, int] = {n: dictionary[0x1800 + n][1].default for n in range(6)}
    assert {pdo["number"] - 1: pdo["cob_id"] for pdo in node["pdos"]} == {
        number: cob_id & 0x7FF for number, cob_id in tried.items() if not cob_id >> 31
    }
    for pdo in node["pdos"]:
        parameters, mapping = dictionary[0x17FF + pdo["number"]], dictionary[0x19FF + pdo["number"]]
        kind, inhibit, timer = (parameters[sub].default for sub in (2, 3, 5))
        holds(pdo, transmission_type=kind, inhibit_ms=inhibit / 10, event_ms=timer)
        mapped = [mapping[sub].default for sub in range(1, mapping[0].default + 1)]
        named = [f"{m >> 16:04X}h:{m >> 8 & 0xFF:02X}" for m in mapped]
        assert [text.split()[0] for text in pdo["mapped"]] == named


def test_emergencies_are_those_that_the_eds_enables(facts: Facts) -> None:
    told = facts["canopen"]["emergencies"]
    of_esc = {e["byte3"]: e for e in told if e["byte3"] != 0xFF}
    dictionary: Any = canopen.import_od(str(EDS))
    mask = dictionary[0x2100][6].default
    assert set(of_esc) == {bit for bit in range(32) if mask >> bit & 1}
    assert OperatingError.PROGRAMMING_ALLOWED not in of_esc
    expected: set[tuple[int, int | None]] = {error.value for error in GatewayError} | {(0, 0)}
    code, detail = GatewayError.HEARTBEAT_LOST.value
    expected = expected - {(code, detail)} | {(code, None)}
    assert {(e["code"], e["byte4"]) for e in told if e["byte3"] == 0xFF} == expected
    assert all(e["meaning"] and e["remedy"].endswith(".") for e in told)
    assert {e["code"]: e["register"] for e in of_esc.values()}[0x3220] == 0b101


def test_each_source_is_reported_with_a_meaning_and_where_it_is_shown(facts: Facts) -> None:
    told = {row["name"]: row for row in facts["sources"]}
    assert {name for name, row in told.items() if row["bindable"]} == set(VALUES)
    assert all(row["meaning"] for row in told.values())
    shown = {s["source"] for m in facts["dbc"]["messages"] for s in m["signals"] if s["source"]}
    assert {name for name, row in told.items() if row["signals"]} == shown
    holds(
        told["battery_voltage"],
        signals=["EscSpeed.BatteryVoltage"],
        objects=["2000h:02", "6079h:00"],
        available="with fresh live data",
    )
    assert told["undervoltage"]["meaning"] == OperatingError.UNDERVOLTAGE.meaning


# --- by a configuration


def test_of_two_escs_each_has_its_signals_and_cob_ids_and_the_objects_are_reported_once(
    tmp_path: Path, facts: Facts
) -> None:
    two = by_configuration(tmp_path, TWO_ESCS)
    assert two["escs"] == ["left", "right"]
    voltages = {
        signal["esc"]: (message["name"], message["id"], signal["name"])
        for message in two["dbc"]["messages"]
        for signal in message["signals"]
        if signal["source"] == "battery_voltage"
    }
    assert voltages == {
        "left": ("LeftSpeed", 0x688, "LeftBatteryVoltage"),
        "right": ("RightSpeed", 0x689, "RightBatteryVoltage"),
    }
    nodes = two["canopen"]["nodes"]
    assert [(node["esc"], node["node_id"]) for node in nodes] == [("left", 20), ("right", 21)]
    ids = [0x180 + 21, 0x280 + 21, 0x380 + 21, 0x480 + 21]
    assert [pdo["cob_id"] for pdo in nodes[1]["pdos"]] == ids
    assert two["canopen"]["objects"] == facts["canopen"]["objects"]


def test_a_node_that_waits_for_lss_has_no_cob_ids_of_its_own(tmp_path: Path) -> None:
    text = '[canopen]\nenabled = true\nnode_id = 255\nstore = "s"\n[[esc]]\nport = "/dev/ttyUSB0"\n'
    node = by_configuration(tmp_path, text)["canopen"]["nodes"][0]
    assert (node["node_id"], node["pdos"]) == (None, [])
    assert {cob["use"] for cob in node["cob_ids"]} == {"NMT", "LSS"}


def test_the_same_files_give_the_same_text_without_a_path(tmp_path: Path) -> None:
    file = tmp_path / "x.json"
    assert run("describe", "--format", "json", "-o", file).code == 0
    assert file.read_text(encoding="utf-8") == described("--format", "json")
    assert str(DBC.parent) not in file.read_text(encoding="utf-8")
