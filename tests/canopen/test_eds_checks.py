"""An EDS with a mistake is refused by file, section, key and remedy, all mistakes at once; what CiA 306 allows is taken."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import eds_text
import pytest
from eds_text import SHIPPED, variable
from hypothesis import given, settings
from hypothesis import strategies as st

from kontronik_can_gw.canopen import dcf
from kontronik_can_gw.canopen import eds as reader
from kontronik_can_gw.canopen.check import check_eds
from kontronik_can_gw.canopen.eds_object import Entry
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings


def with_object(content: str, index: int = 0x2200) -> str:
    """The shipped EDS with one manufacturer object more."""
    return eds_text.with_object(SHIPPED, index, content)


def problems(text: str | bytes) -> tuple[str, ...]:
    """What is wrong with an EDS that nodes 1 and 2 are to have, () for nothing."""
    data = text if isinstance(text, bytes) else text.encode("ascii")
    try:
        check_eds(reader.load(data, "mine.eds"), EscSettings(), (1, 2))
    except UserError as error:
        return error.problems
    return ()


def changed(section: str, old: str, new: str) -> str:
    """The shipped EDS with what the first three columns of mistakes.txt say."""
    if section == "end":
        return f"{SHIPPED}\r\n{new}"
    if section.startswith("object "):
        return with_object(new, int(section.removeprefix("object "), 16))
    if section == "-":
        assert old in SHIPPED
        return SHIPPED.replace(old, new, 1)
    heading = f"[{section}]\r\n"
    before, after = SHIPPED.split(heading)
    body, bracket, rest = after.partition("\r\n[")
    assert old == "*" or old in body
    return before + heading + (new if old == "*" else body.replace(old, new, 1)) + bracket + rest


def rows_of(name: str) -> Iterator[Any]:
    """The rows of a table, each by its number of line."""
    for number, line in enumerate(
        Path(__file__).with_name(name).read_text("ascii").splitlines(), 1
    ):
        if line and not line.startswith((";", "==")):
            yield pytest.param(*(cell.strip(" ") for cell in line.split("|")), id=f"line {number}")


# --- the file -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("section", "old", "new", "message"), list(rows_of("mistakes.txt")))
def test_mistakes_by_section_and_key(section: str, old: str, new: str, message: str) -> None:
    new = new.replace("{242 x}", "x" * 242).replace("{compact}", COMPACT)
    new = re.sub(r"\{var (0x[0-9A-F]+)\}", lambda match: variable(int(match[1], 16)), new)
    found = problems(changed(section, old.replace("~", "\r\n"), new.replace("~", "\r\n")))
    assert all(problem.startswith("mine.eds: ") for problem in found)
    assert any(message.removeprefix("+ ") in problem for problem in found), found
    assert len(found) == 1 or message.startswith("+ ")


def test_all_mistakes_are_reported_at_once() -> None:
    text = SHIPPED.replace("CompactPDO=0", "CompactPDO=1")
    found = problems(text.replace("AccessType=const", "AccessType=x"))
    more = 1 + SHIPPED.count("AccessType=const") - 20
    assert len(found) == 21
    assert found[-1] == f"mine.eds: and {more} more mistakes."


HUGE = "9" * 5_000
MANY = "[{:04X}]\nParameterName=x\nObjectType=8\nDataType=5\nAccessType=rw\nCompactSubObj=254\n"
MAPPING = "[1A3F]\nParameterName=x\nObjectType=9\n[1A3Fsub0]\nParameterName=x\nDataType=7\nAccessType=rw\n"
OUT_OF_BOUNDS = [
    (";" * reader.MAX_BYTES, "is larger than 2 MB"),
    ("\n" * 100_001, "is larger than 2 MB or 100000 lines"),
    ("".join(map(MANY.format, range(0x2800, 0x2900))), "more than 10000 objects"),
    (MANY.format(0x2800).replace("254", HUGE), "[2800] CompactSubObj=999"),
    (MANY.format(0x2800) + f"[2800Name]\nNrOfEntries=1\n{HUGE}=x\n", "not a sub-index from 1 to"),
    (f"[2800]\n{variable(5)}DefaultValue={HUGE}\n", "[2800] DefaultValue=999"),
    (f"[2800]\n{variable(5)}LowLimit=-{HUGE}\n", "[2800] LowLimit=-999"),
    (f"[2800]\nParameterName={HUGE}\n", "longer than 241"),
    (f"[{HUGE}]\n{HUGE}\n", "is neither a section"),
    (f"{MAPPING}DefaultValue=0xFFFFFFFF\n", "sub-index 0 is an UNSIGNED8"),
]  # fmt: skip


@pytest.mark.parametrize(("more", "said"), OUT_OF_BOUNDS, ids=[said for _, said in OUT_OF_BOUNDS])
def test_an_eds_that_asks_for_too_much_is_refused_shortly(more: str, said: str) -> None:
    found = problems(f"{SHIPPED}\n{more}")
    assert any(said in line for line in found), found
    assert len(found) <= 21
    assert all(len(line) < 900 for line in found)


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_a_damaged_file_is_read_or_refused_and_nothing_else(data: st.DataObject) -> None:
    lines = SHIPPED.split("\r\n")
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(lines) - 1))
        key = lines[at].split("=")[0]
        value = data.draw(
            st.one_of(
                st.sampled_from(
                    ["", "-1", "0", "255", "0x1FFFFFFFF", "9" * 30, "[", "$NODEID", "x"]
                ),
                st.text(),
            )
        )
        lines[at : at + 1] = data.draw(
            st.sampled_from(
                [
                    [],
                    [lines[at]] * 2,
                    [f"{key}={value}"],
                    [value],
                    [f"[{value}]"],
                    [lines[at], "CompactSubObj=2"],
                ]
            )
        )
    text = "\r\n".join(lines).encode("utf-8", "replace")
    found = problems(text)
    assert all(
        problem.startswith("mine.eds: ") and problem.endswith((".", ";'.")) for problem in found
    )


@pytest.mark.parametrize(
    ("dropped", "named", "partner"), [(0x1A03, "1803", "1A03"), (0x1803, "1A03", "1803")]
)
def test_half_a_pdo_is_refused(dropped: int, named: str, partner: str) -> None:
    assert problems(dcf.without(SHIPPED.encode(), {dropped})) == (
        f"mine.eds: [{named}] [{partner}] of the same PDO is not there. Add it or remove this object.",
    )


# --- what is allowed ------------------------------------------------------------------------------------------------


def test_any_case_lf_comments_and_unknown_sections_are_taken() -> None:
    text = SHIPPED.replace("\r\n", "\n").replace("AccessType=rw", "ACCESSTYPE=RW")
    for old, new in (
        ("[1A00sub", "[1a00Sub"),
        ("[DeviceInfo]", "[deviceinfo]"),
        ("ParameterName=", "parametername =  "),
        ("[1017]\n", "; a comment\n[1017]\n  ; another\n# a third\n"),
        ("DefaultValue=0x03E8", "DefaultValue=0x03E8 ; one second"),
    ):
        text = text.replace(old, new)
    ours = reader.load(f"{text}\n[Editor]\nColour=blue\n".encode(), "mine.eds")
    assert ours.entries == reader.load(SHIPPED.encode(), "kontronik_esc.eds").entries


@pytest.mark.parametrize(("data_type", "text", "read", "written"), list(rows_of("values.txt")))
def test_values_of_every_type_as_an_eds_and_a_dcf_write_them(
    data_type: str, text: str, read: str, written: str
) -> None:
    eds = reader.load(
        with_object(variable(int(data_type, 16), DefaultValue=text)).encode("ascii"), "mine.eds"
    )
    entry = next(entry for entry in eds.entries if entry.index == 0x2200)
    assert repr(entry.default) + (" + node-ID" if entry.relative else "") == read
    assert entry.default is not None
    text = dcf.dcf(eds, 1, 500_000, {(0x2200, 0): entry.default}, "left", "left.dcf")
    assert re.findall("(?m)^ParameterValue=(.*)\r$", text) == ([written] if written != "-" else [])


COMPACT = "ParameterName=Cell\r\nObjectType=0x8\r\nDataType=0x0006\r\nAccessType=rw\r\nDefaultValue=0x10\r\nLowLimit=1\r\n"


def test_compact_sub_objects_with_their_names() -> None:
    names = "\r\n[2200Name]\r\nNrOfEntries=2\r\n1=First\r\n3=Last\r\n"
    text = with_object(f"{COMPACT}CompactSubObj=3\r\n{names}")
    found = [each for each in reader.load(text.encode(), "x.eds").entries if each.index == 0x2200]
    assert [
        (each.sub, each.name, each.data_type, each.access, each.default, each.low) for each in found
    ] == [
        (0, "Cell highest sub-index", 0x05, "const", 3, None),
        (1, "First", 0x06, "rw", 0x10, 1),
        (2, "Cell2", 0x06, "rw", 0x10, 1),
        (3, "Last", 0x06, "rw", 0x10, 1),
    ]


# --- the DCF --------------------------------------------------------------------------------------------------------


def test_values_of_compact_sub_objects_stand_in_a_section_of_their_own() -> None:
    eds = reader.load(with_object(f"{COMPACT}CompactSubObj=3\r\n").encode(), "mine.eds")
    text = dcf.dcf(eds, 1, 500_000, {(0x2200, 3): 7, (0x2200, 1): 5}, "left", "left.dcf")
    assert "CompactSubObj=3\r\n\r\n[2200Value]\r\nNrOfEntries=2\r\n1=0x0005\r\n3=0x0007\r\n" in text


@pytest.mark.parametrize("value", ["Gaß".encode("latin-1"), b"a\r\nb", b" a", b"a ; b", b"a\x00"])
def test_a_text_that_a_dcf_cannot_hold_is_named(value: bytes) -> None:
    eds = reader.load(SHIPPED.encode(), "kontronik_esc.eds")
    with pytest.raises(
        UserError, match=r"kontronik_esc\.eds: \[2010sub6\] the text .* of Device name cannot stand"
    ):
        dcf.dcf(eds, 1, 500_000, {(0x2010, 6): value}, "left", "left.dcf")


def test_a_text_is_not_mapped() -> None:
    text = SHIPPED.replace("PDOMapping=0", "PDOMapping=1")
    found = problems(text.replace("DefaultValue=0x20000120", "DefaultValue=0x20100600"))
    assert any("[1A00sub1]" in each and "2010h:06 cannot be sent" in each for each in found)


def entry_of(text: str, index: int = 0x2200, sub: int = 0) -> Entry:
    """One entry of an EDS that is accepted."""
    eds = reader.load(text.encode("ascii"), "mine.eds")
    return next(entry for entry in eds.entries if (entry.index, entry.sub) == (index, sub))


def test_a_missing_object_type_is_a_variable() -> None:
    entry = entry_of(with_object(variable(0x06).replace("ObjectType=0x7\r\n", "")))
    assert (entry.sub, entry.data_type) == (0, 0x06)


def test_a_compact_error_history_begins_empty() -> None:
    text = dcf.without(SHIPPED.encode(), {0x1003}).decode()
    count = int(text.split("[OptionalObjects]\r\nSupportedObjects=")[1].split("\r\n")[0])
    text = text.replace(
        f"[OptionalObjects]\r\nSupportedObjects={count}",
        f"[OptionalObjects]\r\nSupportedObjects={count + 1}\r\n{count + 1}=0x1003",
    )
    text += f"\r\n[1003]\r\n{variable(0x07, 'ro')}CompactSubObj=4\r\n".replace(
        "ObjectType=0x7", "ObjectType=0x8"
    )
    assert (entry_of(text, 0x1003, 0).default, entry_of(text, 0x1003, 0).access) == (0, "rw")
    assert entry_of(text, 0x1003, 4).access == "ro"


def test_signed_limits_in_twos_complement() -> None:
    entry = entry_of(
        with_object(variable(0x02, LowLimit="0x9C", HighLimit="0x64", DefaultValue="-100"))
    )
    assert (entry.low, entry.high, entry.default) == (-100, 100, -100)


def test_keys_without_a_value_are_not_there_as_editors_write_them() -> None:
    entry = entry_of(
        with_object(variable(0x06, LowLimit="", HighLimit="", DefaultValue="", PDOMapping=""))
    )
    assert (entry.low, entry.high, entry.default, entry.mappable) == (None, None, None, False)


def test_dropping_an_object_that_a_pdo_carries_is_told() -> None:
    found = problems(dcf.without(SHIPPED.encode(), {0x2020}))
    assert [problem.split("] ")[0] for problem in found] == [
        "mine.eds: [1A03sub4",
        "mine.eds: [1A03sub5",
    ]
