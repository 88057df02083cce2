"""A DBC that needs too much memory or time is refused in one line, before cantools reads it."""

from pathlib import Path

import cantools.database
import pytest

from kontronik_can_gw.dbc.bounds import MAX_BYTES
from kontronik_can_gw.dbc.reader import load_database, parse_database
from kontronik_can_gw.errors import UserError

pytestmark = pytest.mark.promise("dbc-bounds")

HEAD = 'VERSION ""\nNS_ :\nBS_:\nBU_: A\n'
ONE = 'BO_ 1 Msg: 8 A\n SG_ s : 0|8@1+ (1,0) [0|0] "" A\n'
IN_ALL = "total number of multiplexer values is"
PAGED = (
    'BO_ 1 Msg: 8 A\n SG_ m M : 0|32@1+ (1,0) [0|0] "" A\n SG_ s m0 : 32|8@1+ (1,0) [0|0] "" A\n'
)
ATTRIBUTE = 'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;\n'


def nested(depth: int, width: int) -> str:
    """Return a message with a chain of multiplexers.

    Each group of a multiplexer has all groups of the next one, so that there are ``width`` to the
    power of ``depth`` groups.
    """
    lines = ["BO_ 1 Msg: 8 A", ' SG_ s0 M : 0|1@1+ (1,0) [0|0] "" A']
    for n in range(1, depth):
        lines.append(f' SG_ s{n} m0M : {n}|1@1+ (1,0) [0|0] "" A')
    for n in range(1, depth):
        lines.append(f"SG_MUL_VAL_ 1 s{n} s{n - 1} 0-{width - 1};")
    return "\n".join([*lines, ""])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            ONE.replace(": 8", ": 400000000"),
            "Msg: length in bytes is 400000000, but must be 0 to 4095",
        ),
        (ONE.replace("|8@", "|4294967295@"), "Msg.s: length in bits is 4294967295"),
        (ONE.replace(": 0|", ": -1|"), "Msg.s: start bit is -1, but must be 0 to 32759"),
        (ONE.replace("BO_ 1", "BO_ 99999999999"), "Msg: CAN id is 99999999999"),
        (PAGED.replace("m0", "m99999999999"), "Msg.s: multiplexer value is 99999999999"),
        (PAGED + "SG_MUL_VAL_ 1 s m 0-3000000;", f"SG_MUL_VAL_ of s: {IN_ALL} 3000001"),
        (PAGED + "SG_MUL_VAL_ 1 s m 0 93000000;", f"SG_MUL_VAL_ of s: {IN_ALL} 3000001"),
        (PAGED + "VAL_ 1 m" + ' 1 "x"' * 70_000 + ";", f"Msg: {IN_ALL} 70001"),
        (nested(5, 16), f"Msg: {IN_ALL} 88740"),
        (nested(20, 2), "Msg: depth of multiplexers is 9"),
        ("".join(f"BO_ {n} M{n}: 8 A\n" for n in range(10_001)), "number of messages is 10001"),
        (ONE + ONE.partition("\n")[2] * 4_096, "Msg: number of signals is 4097"),
        ("BU_:" + " A" * 2_001, "number of nodes is 2001"),
        ("BO_ 1 Msg: 8 A\n" + " ," * 500_000, "more than 500000 words"),
        (ONE.replace("(1,", f"({'1' * 5000},"), "line 6: a number has more than 400 digits"),
        (ATTRIBUTE + 'BA_ "GenMsgCycleTime" BO_ 1 1e999999999;', "line 6: exponent is 999999999, "),
        (ATTRIBUTE + 'BA_DEF_DEF_ "GenMsgCycleTime" " 1e99_999";', "line 6: exponent is 99999, "),
        (
            'VAL_TABLE_ T 0 "' + "x" * 10_000 + '";\n' + "VAL_ 1 s T;\n" * 801,
            "value tables of VAL_",
        ),
        (" " * MAX_BYTES, "is larger than 8 MB"),
    ],
)
def test_file_out_of_bounds_is_refused_in_one_line_without_cantools(
    text: str,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def must_not_be_called(*_: object, **__: object) -> None:
        pytest.fail("cantools was called")

    monkeypatch.setattr(cantools.database, "load_string", must_not_be_called)
    with pytest.raises(UserError) as caught:
        parse_database((HEAD + text).encode(), "my.dbc")
    (line,) = caught.value.problems
    assert line.startswith("my.dbc: ")
    assert said in line
    assert len(line) < 200


def test_file_without_end_is_read_up_to_the_limit() -> None:
    with pytest.raises(UserError, match="is empty"):
        parse_database(b" " * MAX_BYTES, "my.dbc")
    with pytest.raises(UserError, match="larger than 8 MB"):
        load_database(Path("/dev/zero"))


@pytest.mark.parametrize(
    "text",
    [
        ONE.replace("BO_ 1 Msg: 8", "BO_ 3221225472 VECTOR__INDEPENDENT_SIG_MSG: 0") + ONE,
        ONE.replace(": 8", ": 1785").replace("|8@", "|13824@"),  # a transfer of SAE J1939
        PAGED + "SG_MUL_VAL_ 1 s m 0-255, 1000-1010;",
        nested(3, 4),
        f'{ONE}CM_ "SG_MUL_VAL_ 1 s m 0-3000000; BO_ 1 Msg: 400000000 A {"1" * 500}";',
        f'{ONE}CM_ BO_ 1 "part 1E123456, http://x";',
    ],
)
def test_unusual_entries_of_real_files_are_read(text: str) -> None:
    assert parse_database((HEAD + text).encode(), "my.dbc").messages
