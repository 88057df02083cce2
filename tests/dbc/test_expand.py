"""The DBC for several ESCs is made from the DBC of one ESC and from a configuration.

Nothing is lost, names and ids follow the rules, and the file describes exactly the frames sent.
"""

import random
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from cantools.database.can import Database, Message
from dbc_bench import refused
from hypothesis import given, settings
from hypothesis import strategies as st
from packer_oracle import LayoutMaker, Msg, Sig, bindings, dbc_text, read

from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.dbc import expand
from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.dbc.reader import parse_database
from kontronik_can_gw.desk.dbc import writer
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.signals.plan import MessageLayout, MessagePlan

pytestmark = pytest.mark.promise("expansion")

SHIPPED = shipped("dbc/kontronik_esc.dbc").read_text()
RICH = Path(__file__).with_name("rich.dbc").read_text()


def escs(*names: str) -> list[EscSettings]:
    return [EscSettings(name) for name in names]


ONE = escs("esc1")
PAIR = escs("left", "right")


def multiplied(
    text: str,
    escs: Sequence[EscSettings],
    node: str = "Gateway",
    **more: Any,
) -> tuple[Database, str]:
    """Return the DBC for these ESCs, as a database and as text."""
    plain = read(text)
    settings = DbcConfig(node=node, **more)
    copies = expand.copies_of(plain, "my.dbc", escs, settings)
    out = writer.copies_text(plain, copies)
    return read(out), out


# --- everything that a database of cantools contains, as plain data

MADE = {"_codecs", "_signal_tree", "_signal_dict", "_relation_attributes"}
"""Attributes that cantools derives from the others, and those that ``relations`` compares."""


def facts(thing: Any, prefix: str = "") -> Any:
    """Return all attributes of an object as plain data. The prefix is removed from names."""
    if isinstance(thing, str):
        return thing.removeprefix(prefix)
    if isinstance(thing, Mapping):
        return {facts(key, prefix): facts(value, prefix) for key, value in thing.items()}
    if isinstance(thing, list | tuple):
        return [facts(each, prefix) for each in thing]
    if hasattr(thing, "definition") or not hasattr(thing, "__dict__"):  # an attribute, a number
        return getattr(thing, "value", thing)
    kept = vars(thing).keys() - MADE
    return {name: facts(value, prefix) for name, value in vars(thing).items() if name in kept}


def facts_of_message(message: Message, prefix: str = "") -> Any:
    """Return all attributes of a message except its name and its id."""
    names = [signal.name for signal in message.signals]
    for group in message.signal_groups or []:
        names += group.signal_names
    assert all(name.startswith(prefix) for name in names)
    found = facts(message, prefix)
    found["_signals"].sort(key=lambda signal: (signal["start"], signal["name"]))
    return found | {"_name": "", "_frame_id": 0}


def all_facts(database: Database) -> tuple[Any, ...]:
    messages = []
    for message in database.messages:
        content = facts_of_message(message)
        messages.append((message.name, message.frame_id, content))
    return facts_of_database(database), messages


def facts_of_database(database: Database) -> Any:
    return facts((database.version, database.nodes, database.buses, database.dbc))


def relations(text: str) -> list[str]:
    return sorted(line for line in text.splitlines() if line.startswith("BA_REL_"))


# --- nothing is lost


def test_shipped_file_for_one_esc_is_written_byte_for_byte() -> None:
    assert writer.copies_text(parse_database(SHIPPED.encode(), "x")) == SHIPPED


def test_rich_dbc_is_written_for_two_escs_without_a_loss() -> None:
    before = read(RICH)
    after, text = multiplied(RICH, PAIR, "Gw")
    assert facts_of_database(after) == facts_of_database(before)
    copies = {
        "LeftPower": ("Left", "EscPower"),
        "RightPower": ("Right", "EscPower"),
        "LeftFlow": ("Left", "Flow"),
        "RightFlow": ("Right", "Flow"),
        "GatewayHealth": ("", "GatewayHealth"),
        "Foreign": ("", "Foreign"),
    }
    assert [message.name for message in after.messages] == list(copies)
    for message in after.messages:
        prefix, old = copies[message.name]
        original = before.get_message_by_name(old)
        assert facts_of_message(message, prefix) == facts_of_message(original)
        assert prefix or message.frame_id == original.frame_id
    assert relations(text) == [
        'BA_REL_ "Filter" BU_BO_REL_ Gw 770 1;',
        'BA_REL_ "Filter" BU_BO_REL_ Logger 256 2;',
        'BA_REL_ "Filter" BU_BO_REL_ Logger 257 2;',
        'BA_REL_ "Timeout" BU_SG_REL_ Logger SG_ 256 LeftConsumedCharge 250;',
        'BA_REL_ "Timeout" BU_SG_REL_ Logger SG_ 257 RightConsumedCharge 250;',
    ]
    assert writer.copies_text(after) == text
    assert text.endswith(";\n")
    assert "\r" not in text
    assert "\n\nBO_ 256 LeftFlow" in text
    assert '"NS_DESC' not in text
    assert "\nNS_ :\n" in text


@settings(max_examples=40, deadline=None)
@given(st.text(st.sampled_from('aB1 \n";:,_()[]|é.'), max_size=40))
def test_any_comment_and_any_text_are_kept(words: str) -> None:
    escaped = words.replace('"', '\\"')
    message = Msg("X", 5, 8, [Sig("BatteryVoltage", 0, 16, unit="V")])
    entries = (
        f'CM_ "{escaped}";\n'
        f'CM_ BO_ 5 "{escaped}";\n'
        f'CM_ SG_ 5 BatteryVoltage "{escaped}";\n'
        'BA_DEF_ "T" STRING ;\n'
        'BA_DEF_DEF_ "T" "";\n'
        f'BA_ "T" "{escaped}";'
    )
    text = dbc_text([message], entries)
    after, _ = multiplied(text, ONE)
    assert all_facts(after) == all_facts(read(text))


# --- names and ids


def simple(*ids: int, extended: bool = False, gateway: tuple[int, ...] = ()) -> str:
    """Return a DBC with ESC messages of these ids, and gateway messages of other ids."""
    volts = Sig("BatteryVoltage", 0, 16, unit="V")
    uptime = Sig("Uptime", 0, 32, unit="s")
    messages = []
    for number, can_id in enumerate(ids):
        messages.append(Msg(f"EscM{number}", can_id, 8, [volts], extended))
    for number, can_id in enumerate(gateway):
        messages.append(Msg(f"Gw{number}", can_id, 8, [uptime]))
    return dbc_text(messages)


@pytest.mark.parametrize(
    ("text", "base", "step", "expected"),
    [
        (simple(0x100, 0x108), None, None, [0x100, 0x101, 0x108, 0x109]),
        (simple(0x100, 0x101, 0x102), None, None, [0x100, 0x103, 0x101, 0x104, 0x102, 0x105]),
        (simple(0x100, 0x101, gateway=(0x102,)), None, None, [0x100, 0x103, 0x101, 0x104, 0x102]),
        (simple(0x100, gateway=(0x101, 0x102, 0x103)), None, None,
         [0x100, 0x104, 0x101, 0x102, 0x103]),
        (simple(0x100, gateway=(0x110,)), 0x200, None, [0x200, 0x201, 0x210]),
        (simple(0x110, gateway=(0x100,)), 0x000, None, [0x010, 0x011, 0x000]),
        (simple(0x100, 0x101), None, 0x20, [0x100, 0x120, 0x101, 0x121]),
        (simple(0x1FFFFFFE, extended=True), None, None, [0x1FFFFFFE, 0x1FFFFFFF]),
    ],
)  # fmt: skip
def test_ids_are_moved_by_the_smallest_step_without_a_clash(
    text: str,
    base: int | None,
    step: int | None,
    expected: list[int],
) -> None:
    after, _ = multiplied(text, PAIR, base_id=base, id_step=step)
    assert [message.frame_id for message in after.messages] == expected


@pytest.mark.parametrize(
    ("text", "escs", "more", "words"),
    [
        (simple(0x100, 0x101), PAIR, {"id_step": 1}, "dbc.id_step = 1 "),
        (simple(0x100, gateway=(0x110,)), PAIR, {"id_step": 0x10}, "clash"),
        (simple(0x100), PAIR, {"id_step": 0}, "clash"),
        (simple(0x7FF), PAIR, {}, "RightM0 800h. Set dbc.base_id to at most 0x7FE"),
        (simple(0x1FFFFFFF, extended=True), PAIR, {}, "1 of 2 ids are beyond 1FFFFFFFh"),
        (
            simple(0x100, 0x200, 0x700),
            ONE,
            {"base_id": 0x700},
            "0x700 moves them: EscM1 800h, EscM2 ",
        ),
        (
            simple(0x0, 0x7FF),
            PAIR,
            {"id_step": 2},
            "moves them: RightM1 801h. Leave out",
        ),
    ],
)
def test_ids_that_clash_or_leave_their_range_are_refused(
    text: str,
    escs: list[EscSettings],
    more: dict[str, Any],
    words: str,
) -> None:
    (line,) = refused(text, [esc.name for esc in escs], node="Gateway", **more)
    assert words in line


def test_names_of_more_than_32_characters_are_refused() -> None:
    text = dbc_text([Msg("EscM", 1, 8, [Sig("LimitBatteryVoltageMinimum", 0, 1)])])
    assert multiplied(text, escs("abcdef", "b"))[0]
    (line,) = refused(text, ("abcdefg", "b", "ghijklm"), node="Gateway")
    assert "longer than 32 characters" in line
    assert "AbcdefgLimitBatteryVoltageMinimum, GhijklmLimitBatteryVoltageMinimum." in line
    # longer names that the user's file already has are not changed
    long = text.replace("EscM", "M" * 40)
    after, _ = multiplied(long, ONE, base_id=0x100)
    assert after.messages[0].name == "M" * 40
    theirs = text + f"BO_ 9 {'T' * 40}: 8 Other\n"
    after, _ = multiplied(theirs, escs("a", "b"))
    assert after.messages[-1].name == "T" * 40


# --- the written file describes the frames that are sent


def plain_plans(layout: MessageLayout) -> list[MessagePlan]:
    """Return the plans with their signals sorted by name, because the writer sorts them."""
    plans = []
    for plan in layout.messages:
        ordered = sorted(plan.signals, key=lambda signal: signal.name)
        plans.append(replace(plan, compiled=tuple(ordered)))
    return plans


def test_limits_of_64_bits_are_written_exactly() -> None:
    limits = (Fraction(-1, 8), Fraction(2**64 - 2))
    signal = writer.SignalRow("Big", 0, 64, limits=limits)
    row = writer.MessageRow(1, "M", 8, ["Gateway"], None, {}, [signal])
    assert "[-0.125|18446744073709551614]" in writer.dbc_text(read(SHIPPED), [row])


@pytest.mark.parametrize("seed", range(20))
def test_random_files_are_written_without_a_loss_and_give_the_same_plans(seed: int) -> None:
    maker = LayoutMaker(random.Random(seed), PAIR)
    messages = [maker.message() for _ in range(5)]
    before = read(dbc_text(messages))
    after = read(writer.copies_text(before))
    assert all_facts(after) == all_facts(before)
    bind = DbcConfig(bind=bindings(messages))
    old = prepare(before, "x", PAIR, bind, is_fd_allowed=True)
    new = prepare(after, "x", PAIR, bind, is_fd_allowed=True)
    assert plain_plans(new) == plain_plans(old)


@pytest.mark.parametrize(
    ("text", "node"),
    [
        (SHIPPED, "KontronikGateway"),
        (RICH, "Gw"),
    ],
)
def test_written_file_compiles_to_the_plans_that_are_sent(text: str, node: str) -> None:
    """Two of the ESCs are alike and share a plan. It equals the plan of each compiled alone."""
    three = [
        EscSettings("left", 7),
        EscSettings("mid", 14),
        EscSettings("right", 7),
    ]
    settings = DbcConfig(node=node)
    written, _ = multiplied(text, three, node)
    sent = prepare(read(text), "x", three, settings, is_fd_allowed=True)
    again = prepare(written, "x", three, settings, is_fd_allowed=True)
    assert any(plan.renamed for plan in sent.messages)
    plain = [replace(plan, compiled=plan.signals, renamed=None) for plan in sent.messages]
    assert plain_plans(replace(sent, messages=tuple(plain))) == plain_plans(again)


def test_long_names_by_attribute_are_written_in_full_and_not_as_attributes() -> None:
    more = (
        'BA_DEF_ SG_ "SystemSignalLongSymbol" STRING ;\n'
        'BA_DEF_DEF_ "SystemSignalLongSymbol" "";\n'
        'BA_ "SystemSignalLongSymbol" SG_ 5 U "BatteryVoltage";'
    )
    message = Msg("EscX", 5, 8, [Sig("U", 0, 16, unit="V")])
    after, text = multiplied(dbc_text([message], more), PAIR)
    names = []
    for copy in after.messages:
        names += [signal.name for signal in copy.signals]
    assert names == ["LeftBatteryVoltage", "RightBatteryVoltage"]
    assert 'BA_ "SystemSignalLongSymbol"' not in text
