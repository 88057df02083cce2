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
from command_line import run
from hypothesis import example, given
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from kontronik_can_gw.canopen.eds import TYPE_NAMES
from kontronik_can_gw.canopen.emergency_codes import GatewayError
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.describe.markdown import Table, markdown
from kontronik_can_gw.desk.describe.tables import CAN_STATES, GATEWAY_STATES, LINK_STATES
from kontronik_can_gw.esc.kontronik.states import OperatingError, OperatingState, SelfTestError
from kontronik_can_gw.esc.telemetry import LinkState
from kontronik_can_gw.esc.values import VALUES
from kontronik_can_gw.status import CanState, GatewayState

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
    assert (done.code, done.err) == (0, ""), done.err
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
    told = {message["name"]: message for message in facts["messages"]}
    rows = {(row["message"], row["signal"]): row for row in facts["signals"]}
    assert set(told) == {message.name for message in database.messages}
    assert set(rows) == {(m.name, signal.name) for m in database.messages for signal in m.signals}
    for message in database.messages:
        assert message.dbc is not None
        holds(
            told[message.name],
            id=message.frame_id,
            bytes=message.length,
            meaning=message.comment,
            extended=message.is_extended_frame,
            fd=message.is_fd,
            cycle_ms=message.cycle_time or None,
            delay_ms=message.dbc.attributes["GenMsgDelayTime"].value or None,
        )
        assert ("cyclic" in told[message.name]["sent"]) == ("Cyclic" in str(message.send_type))
        for signal in message.signals:
            found = rows[message.name, signal.name]
            names: dict[Any, Any] = {
                str(text): int(number) for number, text in (signal.choices or {}).items()
            }
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
                not_available=names.pop("NotAvailable", None),
                error=names.pop("Error", None),
                names={str(number): text for text, number in names.items()},
            )
            assert (found["type"] == "signed") == signal.is_signed
            assert found["meaning"].startswith(signal.comment)


def test_objects_agree_with_canopen(facts: Facts) -> None:
    dictionary: Any = canopen.import_od(str(EDS), node_id=0)
    told = {row["object"]: row for row in facts["objects"]}
    variables: dict[str, Any] = {
        f"{index:04X}h:{sub:02X}": (item, variable)
        for index, item in dictionary.items()
        for sub, variable in (
            {0: item} if isinstance(item, ODVariable) else item.subindices
        ).items()
    }
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
        assert found["name"].startswith(item.name) and found["name"].endswith(variable.name)


def test_cob_ids_and_pdos_agree_with_canopen(facts: Facts) -> None:
    ids = {row["cob_id"] for row in facts["cob-ids"] if row["node"] == "esc1, 1"}
    assert {0x081, 0x181, 0x281, 0x381, 0x481, 0x581, 0x601, 0x701} <= ids
    dictionary: Any = canopen.import_od(str(EDS), node_id=1)
    tried: dict[int, int] = {n: dictionary[0x1800 + n][1].default for n in range(6)}
    assert {pdo["TPDO"] - 1: pdo["cob_id"] for pdo in facts["tpdos"]} == {
        number: cob_id & 0x7FF for number, cob_id in tried.items() if not cob_id >> 31
    }
    for pdo in facts["tpdos"]:
        parameters, mapping = dictionary[0x17FF + pdo["TPDO"]], dictionary[0x19FF + pdo["TPDO"]]
        kind, inhibit, timer = (parameters[sub].default for sub in (2, 3, 5))
        holds(pdo, type=kind, inhibit_ms=inhibit / 10, event_ms=timer)
        mapped = [mapping[sub].default for sub in range(1, mapping[0].default + 1)]
        named = [f"{m >> 16:04X}h:{m >> 8 & 0xFF:02X}" for m in mapped]
        assert [text.split()[0] for text in pdo["mapped"]] == named


def test_emergencies_are_the_bits_enabled_in_the_eds(facts: Facts) -> None:
    told = facts["emergencies"]
    of_esc = {e["byte3"]: e for e in told if e["byte3"] != "FFh"}
    dictionary: Any = canopen.import_od(str(EDS))
    mask = dictionary[0x2100][6].default
    assert set(of_esc) == {str(bit) for bit in range(32) if mask >> bit & 1}
    assert str(int(OperatingError.PROGRAMMING_ALLOWED)) not in of_esc
    expected: set[tuple[int, int | None]] = {error.value for error in GatewayError} | {(0, 0)}
    code, detail = GatewayError.HEARTBEAT_LOST.value
    expected = expected - {(code, detail)} | {(code, None)}
    assert {(e["code"], e["byte4"]) for e in told if e["byte3"] == "FFh"} == expected
    assert all(e["meaning"] and e["remedy"].endswith(".") for e in told)
    holds(of_esc["0"], code=0x3220, register=0b101, name="undervoltage")


def test_each_value_has_a_meaning_and_its_objects(facts: Facts) -> None:
    told = {row["name"]: row for row in facts["values"]}
    assert {name for name, row in told.items() if not row["only_objects"]} == set(VALUES)
    assert all(row["meaning"] for row in told.values())
    holds(
        told["battery_voltage"], objects=["2000h:02", "6079h:00"], available="with fresh live data"
    )
    assert told["undervoltage"]["meaning"] == OperatingError.UNDERVOLTAGE.meaning


def test_two_escs_have_their_own_signals_and_cob_ids(tmp_path: Path, facts: Facts) -> None:
    two = facts_of("-c", configuration(tmp_path, TWO_ESCS))
    voltages = [row for row in two["signals"] if row["shows"] == "battery_voltage"]
    assert [(row["esc"], row["message"], row["signal"]) for row in voltages] == [
        ("left", "LeftSpeed", "LeftBatteryVoltage"),
        ("right", "RightSpeed", "RightBatteryVoltage"),
    ]
    assert [pdo["cob_id"] for pdo in two["tpdos"] if pdo["node"] == "right, 21"] == [
        0x180 + 21, 0x280 + 21, 0x380 + 21, 0x480 + 21,
    ]  # fmt: skip
    assert two["objects"] == facts["objects"]
    text = '[[esc]]\nport = "x"\n[canopen]\nstore = "s"\nenabled = '
    none = facts_of("-c", configuration(tmp_path, f"{text}false\n"))
    assert "objects" not in none and {e["byte3"] for e in none["emergencies"]} == {"FFh"}
    text = text.replace("enabled", "node_id = 255\nenabled")
    waits = facts_of("-c", configuration(tmp_path, f"{text}true\n[dbc]\nenabled = false\n"))
    assert "signals" not in waits and waits["values"]
    assert {row["use"] for row in waits["cob-ids"]} == {"NMT", "LSS"}


# --- the document, read by an independent parser


def texts_of(markdown_text: str) -> dict[str, list[str]]:
    """Return the texts of a document by their tag. Raises if a text contains markup."""
    found: dict[str, list[str]] = {}
    parser = MarkdownIt("commonmark").enable("table").enable("strikethrough")
    for opening, token in pairwise(parser.parse(markdown_text)):
        assert token.type != "html_block"
        if token.type == "inline":
            parts = [
                ("text", "\n") if part.type == "softbreak" else (part.type, part.content)
                for part in token.children or ()
            ]
            plain = [text for kind, text in parts if (kind, text) != ("html_inline", "<!-- -->")]
            assert {kind for kind, _ in parts} <= {"text", "html_inline"}, parts
            assert len(plain) == sum(kind == "text" for kind, _ in parts), parts
            found.setdefault(opening.tag, []).append("".join(plain))
    return found


def one_line(text: str) -> str:
    return " ".join(text.split())


def test_every_text_of_the_tables_is_in_the_document(facts: Facts) -> None:
    cells = {text for texts in texts_of(text_of()).values() for text in texts}
    for rows in facts.values():
        for row in rows if isinstance(rows, list) else ():
            assert {one_line(text) for text in row.values() if isinstance(text, str)} <= cells, row


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
    named = [{"one": "x", "head": f"H {title}"}, {"one": "x", "head": "H"}]
    rows = [{"one": cell}, {"one": "y"}]
    tables = [Table(f"T {title}", [paragraph], rows), Table("B", [], named, by="head")]
    found = texts_of(markdown("All", [], tables))
    assert [one_line(text) for text in found["h2"]] == [one_line(f"T {title}"), "B"]
    assert [one_line(text) for text in found["h3"]] == [one_line(f"H {title}"), "H"]
    assert [one_line(text) for text in found.get("p", [])] == [one_line(paragraph)][
        : bool(one_line(paragraph))
    ]
    assert [one_line(text) for text in found["td"]] == [one_line(cell), "y", "x", "x"]


@given(st.lists(words, min_size=8, max_size=16))
@example(["a|b " * 24, ":-:"])
@example(["word " * 20, "- x", "1. x", "# x", "--- x"] * 2)
def test_a_long_paragraph_of_any_words_is_read_back_unchanged(paragraph: list[str]) -> None:
    joined = one_line(" ".join(paragraph))
    found = texts_of(markdown("All", [], [Table("T", [joined])]))
    assert [one_line(text) for text in found.get("p", [])] == [joined][: bool(joined)]
    assert found.keys() <= {"h1", "h2", "p"}


def test_paragraphs_are_wrapped_at_100_columns() -> None:
    lines = markdown(
        "All", ["one two three four five six seven eight [nine] " * 9], []
    ).splitlines()
    assert 90 < max(map(len, lines)) <= 100
