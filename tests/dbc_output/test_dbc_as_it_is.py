"""A user's DBC as other tools write it: entries for nothing, units, send types, counters, checksums, flags, unbound signals."""

from collections.abc import Sequence
from typing import Any

import pytest

from kontronik_can_gw.dbc_output.layout import DbcSettings, Layout, parse_database
from kontronik_can_gw.dbc_output.prepare import prepare
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.telemetry import EscSettings

HEAD = (
    'VERSION ""\nNS_ :\n\tNS_DESC_\n\tVAL_\n\tVAL_TABLE_\n\tBA_DEF_\n\tSIG_VALTYPE_\n\nBS_:\n\nBU_: Gateway Other\n\n'
)
MESSAGE = "BO_ 256 Power: 8 Gateway\n"
STATE = f'{MESSAGE} SG_ OperatingState : 0|8@1+ (1,0) [0|0] "" Other\n'


def compiled(text: str, names: Sequence[str] = ("esc1",), **settings: Any) -> Layout:
    database = parse_database((HEAD + text).encode(), "my.dbc")
    return prepare(database, "my.dbc", [EscSettings(name, 7) for name in names], DbcSettings(**settings), True)[1]


def refused(text: str, **settings: Any) -> list[str]:
    with pytest.raises(UserError) as caught:
        compiled(text, **settings)
    assert all(line.startswith(("my.dbc: ", "dbc.")) and "\n" not in line for line in caught.value.problems)
    return list(caught.value.problems)


# --- entries ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "table", ['VAL_TABLE_ States 21 "Forward" 12 "MotorOff" ;', 'VAL_TABLE_ States\n21 "Forward"\n12 "MotorOff";']
)
def test_a_value_table_may_be_named_although_ns_lists_its_keyword(table: str) -> None:
    (plan,) = compiled(f"VAL_TABLE_ Empty ;\n{table}\n{STATE}VAL_ 256 OperatingState States ;\n").messages
    assert plan.signals[0].numbers == {21: 21, 12: 12}


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ('VAL_ 256 Nope 1 "x" ;', "VAL_ 256 Nope"),
        ('VAL_ 999\n  OperatingState\n 1 "x; y" ;', "VAL_ 999 OperatingState"),
        ("VAL_ 256 OperatingState States ;", "VAL_ 256 OperatingState States"),
        ("SIG_VALTYPE_ 256 Nope : 1;", "SIG_VALTYPE_ 256 Nope"),
        ('BA_ "Colour" BO_ 256 1;', 'BA_ "Colour"'),
        ('BA_DEF_DEF_ "Colour" 1;', 'BA_DEF_DEF_ "Colour"'),
    ],
)
def test_an_entry_for_what_is_not_in_the_file_is_ignored_with_a_warning(entry: str, words: str) -> None:
    warnings: list[str] = []
    text = f'{HEAD}{STATE}CM_ SG_ 256 OperatingState "{entry.replace(chr(34), "")}";\n{entry}\n'
    database = parse_database(text.encode(), "my.dbc", warnings)
    (line,) = warnings
    assert line.startswith("my.dbc: ignored") and line.endswith(words)
    (signal,) = database.messages[0].signals
    assert signal.choices is None and signal.comment == entry.replace('"', "")


def test_many_entries_for_nothing_are_one_warning_and_a_mistake_keeps_its_line() -> None:
    warnings: list[str] = []
    text = HEAD + STATE + "".join(f'VAL_ {n} X 1 "x" ;\n' for n in range(1000, 1100))
    parse_database(text.encode(), "my.dbc", warnings)
    (line,) = warnings
    assert line.endswith("VAL_ 1005 X and 94 more")
    with pytest.raises(UserError, match=f"line {text.count(chr(10)) + 1}"):
        parse_database(f"{text}VAL_ x y z;\n".encode(), "my.dbc")
