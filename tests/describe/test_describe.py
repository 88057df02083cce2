"""The description agrees with cantools and canopen, which read the same files.

Any text in these files is shown as plain text.
"""

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import canopen
import cantools.database
import pytest
from canopen.objectdictionary import ODVariable
from cantools.database.can import Message, Signal
from command_line import run
from hypothesis import example, given
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from kontronik_can_gw.canopen.eds import TYPE_NAMES
from kontronik_can_gw.canopen.emergency_codes import GatewayError
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.describe.markdown import MarkdownTable, markdown
from kontronik_can_gw.desk.describe.tables import CAN_STATES, GATEWAY_STATES, LINK_STATES
from kontronik_can_gw.esc.kontronik.states import OperatingError, OperatingState, SelfTestError
from kontronik_can_gw.esc.telemetry import LinkState
from kontronik_can_gw.esc.values import VALUES
from kontronik_can_gw.status import CanState, GatewayState

pytestmark = pytest.mark.promise("descriptions")

Facts = dict[str, Any]
DBC = shipped("dbc/kontronik_esc.dbc")
EDS = shipped("eds/kontronik_esc.eds")
TWO_ESCS = """
[canopen]
enabled = true
node_id = 20
store = "store"

[[esc]]
name = "left"
port = "/dev/ttyUSB0"
pole_pairs = 7

[[esc]]
name = "right"
port = "/dev/ttyUSB1"
"""


def text_of(*words: object) -> str:
    """Return the output of ``describe``, which must not write to standard error."""
    done = run("describe", *words)
    assert done.code == 0, done.err
    assert done.err == "", done.err
    return done.out


def configuration(folder: Path, text: str) -> Path:
    """Write a configuration on the virtual interface and return its path."""
    file = folder / "gateway.toml"
    file.write_text(f'[can]\ninterface = "virtual"\n{text}')
    return file


def facts_of(*words: object) -> Facts:
    found = json.loads(text_of(*words, "--format", "json"))
    assert isinstance(found, dict)
    return found


@pytest.fixture(scope="module")
def facts() -> Facts:
    """Return the description of the shipped files."""
    return facts_of()


def holds(found: Facts, **expected: object) -> None:
    assert {name: found[name] for name in expected} == expected


# --- texts


STATES = [state.about for state in OperatingState]
OTHERS = [*LINK_STATES.values(), *CAN_STATES.values(), *GATEWAY_STATES.values()]


@pytest.mark.parametrize("kind", [OperatingError, SelfTestError, STATES, GatewayError, OTHERS])
def test_error_and_state_have_a_unique_meaning_and_a_remedy(kind: Any) -> None:
    assert [list(LINK_STATES), list(CAN_STATES), list(GATEWAY_STATES)] == [
        list(states) for states in (LinkState, CanState, GatewayState)
    ]
    assert all(each.meaning.strip() == each.meaning != "" for each in kind)
    assert all(each.remedy.endswith(".") for each in kind)
    assert len({each.meaning for each in kind}) == len(kind)


# --- tables, as JSON


def test_messages_and_signals_agree_with_cantools(facts: Facts) -> None:
    database = cantools.database.load_file(DBC)
    assert isinstance(database, cantools.database.Database)
    messages = {message["name"]: message for message in facts["messages"]}
    rows = {(row["message"], row["signal"]): row for row in facts["signals"]}
    assert set(messages) == {message.name for message in database.messages}
    for message in database.messages:
        check_message(messages[message.name], message)
        for signal in message.signals:
            check_signal(rows.pop((message.name, signal.name)), signal)
    assert not rows, "signals that cantools does not find"


def check_message(found: Facts, message: Message) -> None:
    assert message.dbc is not None
    holds(
        found,
        id=message.frame_id,
        bytes=message.length,
        meaning=message.comment,
        extended=message.is_extended_frame,
        fd=message.is_fd,
        cycle_ms=message.cycle_time or None,
        delay_ms=message.dbc.attributes["GenMsgDelayTime"].value or None,
    )
    assert ("cyclic" in found["sent"]) == ("Cyclic" in str(message.send_type))


def check_signal(found: Facts, signal: Signal) -> None:
    codes: dict[str, int] = {}
    names: dict[str, str] = {}
    for number, text in (signal.choices or {}).items():
        if str(text) in ("NotAvailable", "Error"):
            codes[str(text)] = number
        else:
            names[str(number)] = str(text)
    holds(
        found,
        start=signal.start,
        bits=signal.length,
        big_endian=signal.byte_order == "big_endian",
        unit=signal.unit or "",
        factor=signal.scale,
        offset=signal.offset or None,
        min=signal.minimum,
        max=signal.maximum,
        not_available=codes.get("NotAvailable"),
        error=codes.get("Error"),
        names=names,
    )
    assert (found["type"] == "signed") == signal.is_signed
    assert found["meaning"].startswith(str(signal.comment))


def test_objects_agree_with_canopen(facts: Facts) -> None:
    dictionary: Any = canopen.import_od(str(EDS), node_id=0)
    told = {row["object"]: row for row in facts["objects"]}
    variables: dict[str, Any] = {}
    for index, item in dictionary.items():
        entries = {0: item} if isinstance(item, ODVariable) else item.subindices
        for sub, variable in entries.items():
            variables[f"{index:04X}h:{sub:02X}"] = (item, variable)
    assert set(told) == set(variables)
    for place, (item, variable) in variables.items():
        found = told[place]
        holds(
            found,
            access=variable.access_type,
            type=TYPE_NAMES[variable.data_type],
            pdo=variable.pdo_mappable,
            min=variable.min,
            max=variable.max,
            node_id=variable.relative,
            default=None if found["shows"] else variable.default,
        )
        assert found["name"].startswith(item.name)
        assert found["name"].endswith(variable.name)


def test_cob_ids_and_pdos_agree_with_canopen(facts: Facts) -> None:
    ids = {row["cob_id"] for row in facts["cob-ids"] if row["node"] == "esc1, 1"}
    assert {0x081, 0x181, 0x281, 0x381, 0x481, 0x581, 0x601, 0x701} <= ids
    dictionary: Any = canopen.import_od(str(EDS), node_id=1)
    enabled = {}
    for number in range(1, 7):
        cob_id = dictionary[0x17FF + number][1].default
        if not cob_id >> 31:
            enabled[number] = cob_id & 0x7FF
    assert {pdo["TPDO"]: pdo["cob_id"] for pdo in facts["tpdos"]} == enabled
    for pdo in facts["tpdos"]:
        parameters = dictionary[0x17FF + pdo["TPDO"]]
        holds(
            pdo,
            type=parameters[2].default,
            inhibit_ms=parameters[3].default / 10,
            event_ms=parameters[5].default,
        )
        mapping = dictionary[0x19FF + pdo["TPDO"]]
        named = []
        for sub in range(1, mapping[0].default + 1):
            mapped = mapping[sub].default
            named.append(f"{mapped >> 16:04X}h:{mapped >> 8 & 0xFF:02X}")
        assert [text.split()[0] for text in pdo["mapped"]] == named


def test_emergencies_are_the_bits_enabled_in_the_eds(facts: Facts) -> None:
    of_esc = {}
    of_gateway = set()
    for emergency in facts["emergencies"]:
        assert emergency["meaning"]
        assert emergency["remedy"].endswith(".")
        if emergency["byte3"] == "FFh":
            of_gateway.add((emergency["code"], emergency["byte4"]))
        else:
            of_esc[emergency["byte3"]] = emergency
    dictionary: Any = canopen.import_od(str(EDS))
    mask = dictionary[0x2100][6].default
    assert set(of_esc) == {str(bit) for bit in range(32) if mask >> bit & 1}
    assert str(int(OperatingError.PROGRAMMING_ALLOWED)) not in of_esc
    holds(of_esc["0"], code=0x3220, register=0b101, name="undervoltage")
    expected: set[tuple[int, int | None]] = {error.value for error in GatewayError}
    expected.add((0, 0))
    code, detail = GatewayError.HEARTBEAT_LOST.value
    expected.remove((code, detail))
    expected.add((code, None))
    assert of_gateway == expected


def test_counter_of_an_object_restarts_after_the_number_of_its_type(facts: Facts) -> None:
    """The limit of the DBC's signal is lower, because the signal has codes and fewer bits."""
    rows = {row["object"]: row for row in facts["objects"]}
    for place in ("2001h:04", "2020h:07", "2021h:03"):
        assert rows[place]["meaning"].endswith(
            "It restarts at 0 after the highest number of its type."
        )
    for row in (*facts["objects"], *facts["values"]):
        assert "65533" not in row["meaning"], row
    signals = {row["signal"]: row["meaning"] for row in facts["signals"]}
    assert "It restarts at 0 after 65533." in signals["CrcErrors"]


def test_each_value_has_a_meaning_and_its_objects(facts: Facts) -> None:
    told = {row["name"]: row for row in facts["values"]}
    assert {name for name, row in told.items() if not row["only_objects"]} == set(VALUES)
    assert all(row["meaning"] for row in told.values())
    holds(
        told["battery_voltage"],
        objects=["2000h:02", "6079h:00"],
        available="with fresh live data",
    )
    assert told["undervoltage"]["meaning"] == OperatingError.UNDERVOLTAGE.meaning


def test_two_escs_have_their_own_signals_and_cob_ids(tmp_path: Path, facts: Facts) -> None:
    two = facts_of("-c", configuration(tmp_path, TWO_ESCS))
    voltages = [row for row in two["signals"] if row["shows"] == "battery_voltage"]
    assert [(row["esc"], row["message"], row["signal"]) for row in voltages] == [
        ("left", "LeftSpeed", "LeftBatteryVoltage"),
        ("right", "RightSpeed", "RightBatteryVoltage"),
    ]
    cob_ids = [pdo["cob_id"] for pdo in two["tpdos"] if pdo["node"] == "right, 21"]
    assert cob_ids == [0x180 + 21, 0x280 + 21, 0x380 + 21, 0x480 + 21]
    assert two["objects"] == facts["objects"]


def test_outputs_that_are_disabled_are_not_described(tmp_path: Path) -> None:
    text = '[[esc]]\nport = "x"\n[canopen]\nstore = "s"\nenabled = '
    none = facts_of("-c", configuration(tmp_path, f"{text}false\n"))
    assert "objects" not in none
    assert {emergency["byte3"] for emergency in none["emergencies"]} == {"FFh"}
    text = text.replace("enabled", "node_id = 255\nenabled")
    waits = facts_of("-c", configuration(tmp_path, f"{text}true\n[dbc]\nenabled = false\n"))
    assert "signals" not in waits
    assert waits["values"]
    assert {row["use"] for row in waits["cob-ids"]} == {"NMT", "LSS"}


# --- the document, read by an independent parser


def texts_of(markdown_text: str) -> dict[str, list[str]]:
    """Return the texts of a document by their tag. Raises if a text contains markup."""
    found: dict[str, list[str]] = {}
    parser = MarkdownIt("commonmark").enable("table").enable("strikethrough")
    for opening, token in pairwise(parser.parse(markdown_text)):
        assert token.type != "html_block"
        if token.type != "inline":
            continue
        text = ""
        for part in token.children or ():
            if part.type == "softbreak":
                text += "\n"
            elif part.type == "html_inline":
                assert part.content == "<!-- -->"  # separates characters that would be markup
            else:
                assert part.type == "text", part
                text += part.content
        found.setdefault(opening.tag, []).append(text)
    return found


def one_line(text: str) -> str:
    return " ".join(text.split())


def test_every_text_of_the_tables_is_in_the_document(facts: Facts) -> None:
    cells: set[str] = set()
    for texts in texts_of(text_of()).values():
        cells.update(texts)
    for rows in facts.values():
        for row in rows if isinstance(rows, list) else ():
            expected = {one_line(text) for text in row.values() if isinstance(text, str)}
            assert expected <= cells, row


texts = st.text(
    st.characters(codec="utf-8", exclude_categories=["Cc", "Cs", "Zl", "Zp"]), max_size=40
)
markup = st.text(st.sampled_from("|`*_[]()<>&\\#-+.!~=$:/1a \n\t\"'"), max_size=24)
words = st.one_of(texts, markup)


@given(words, words, words)
@example("a|b", "`|`", "www.x.org")
@example("1.", "1) x", "- x")
@example("#", "x ##", "# x")
@example("_a_", "a_b_c", "\\|")
@example("&lt;", "<!--", "]]>")
def test_any_text_is_read_back_unchanged(title: str, paragraph: str, cell: str) -> None:
    """The text of a DBC or EDS may contain markup."""
    rows = [{"one": cell}, {"one": "y"}]
    plain = MarkdownTable(f"T {title}", [paragraph], rows)
    named = [{"one": "x", "head": f"H {title}"}, {"one": "x", "head": "H"}]
    grouped = MarkdownTable("B", [], named, by="head")
    found = texts_of(markdown("All", [], [plain, grouped]))
    assert lines_of(found, "h2") == [one_line(f"T {title}"), "B"]
    assert lines_of(found, "h3") == [one_line(f"H {title}"), "H"]
    assert lines_of(found, "p") == paragraphs(paragraph)
    assert lines_of(found, "td") == [one_line(cell), "y", "x", "x"]


def lines_of(found: dict[str, list[str]], tag: str) -> list[str]:
    return [one_line(text) for text in found.get(tag, [])]


def paragraphs(text: str) -> list[str]:
    """Return the paragraphs of a document with this text. An empty text has no paragraph."""
    line = one_line(text)
    return [line] if line else []


@given(st.lists(words, min_size=8, max_size=16))
@example(["a|b " * 24, ":-:"])
@example(["word " * 20, "- x", "1. x", "# x", "--- x"] * 2)
def test_long_paragraph_of_any_words_is_read_back_unchanged(paragraph: list[str]) -> None:
    joined = one_line(" ".join(paragraph))
    found = texts_of(markdown("All", [], [MarkdownTable("T", [joined])]))
    assert lines_of(found, "p") == paragraphs(joined)
    assert found.keys() <= {"h1", "h2", "p"}


def test_paragraphs_are_wrapped_at_100_columns() -> None:
    paragraph = "one two three four five six seven eight [nine] " * 9
    lines = markdown("All", [paragraph], []).splitlines()
    assert 90 < max(map(len, lines)) <= 100
