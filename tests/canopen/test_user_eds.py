"""An EDS of a user.

All its mistakes are reported together, each with file, section, key and remedy. Everything that
CiA 306 allows is accepted. If it lacks an object, the node behaves as with the shipped default.
"""

import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import eds_text
import pytest
from dialogue import Bench, info, live, shipped_eds
from dialogue import changed as changed_eds
from eds_text import SHIPPED, variable, with_key
from hypothesis import given, settings
from hypothesis import strategies as st

from kontronik_can_gw.canopen import eds as reader
from kontronik_can_gw.canopen.check import check_eds
from kontronik_can_gw.canopen.eds import EdsEntry
from kontronik_can_gw.canopen.eds_changes import without
from kontronik_can_gw.desk import dcf
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings

pytestmark = pytest.mark.promise("user-eds")


def with_object(content: str, index: int = 0x2200) -> str:
    """Return the shipped EDS with a further manufacturer object."""
    return eds_text.with_object(SHIPPED, index, content)


def problems(text: str | bytes, *node_ids: int) -> tuple[str, ...]:
    """Return the problems of an EDS for these nodes, by default 1 and 2."""
    data = text if isinstance(text, bytes) else text.encode("ascii")
    try:
        eds = reader.load(data, "mine.eds")
        check_eds(eds, shipped_eds(), [EscSettings()], node_ids or (1, 2))
    except UserError as error:
        return error.problems
    return ()


def changed(section: str, old: str, new: str) -> str:
    """Return the shipped EDS, changed by the first three columns of mistakes.txt."""
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
    if old == "*":
        body = new
    else:
        assert old in body
        body = body.replace(old, new, 1)
    return before + heading + body + bracket + rest


def rows_of(name: str) -> Iterator[Any]:
    """Yield the rows of a table. The id of a row is its line number."""
    lines = Path(__file__).with_name(name).read_text("ascii").splitlines()
    for number, line in enumerate(lines, 1):
        if line and not line.startswith((";", "==")):
            cells = [cell.strip(" ") for cell in line.split("|")]
            yield pytest.param(*cells, id=f"line {number}")


# --- the file


@pytest.mark.parametrize(("section", "old", "new", "message"), list(rows_of("mistakes.txt")))
def test_mistake_is_reported_with_section_and_key(
    section: str,
    old: str,
    new: str,
    message: str,
) -> None:
    new = re.sub(r"\{var (0x[0-9A-F]+)\}", lambda match: variable(int(match[1], 16)), new)
    found = problems(changed(section, old.replace("~", "\r\n"), new.replace("~", "\r\n")))
    assert all(problem.startswith("mine.eds: ") for problem in found)
    assert any(message.removeprefix("+ ") in problem for problem in found), found
    assert len(found) == 1 or message.startswith("+ ")


def test_all_mistakes_are_reported_together() -> None:
    text = SHIPPED.replace("CompactPDO=0", "CompactPDO=1")
    found = problems(text.replace("AccessType=const", "AccessType=x"))
    more = 1 + SHIPPED.count("AccessType=const") - 20
    assert len(found) == 21
    assert found[-1] == f"mine.eds: and {more} more mistakes."


HUGE = "9" * 5_000
OUT_OF_BOUNDS = [
    (";" * reader.MAX_BYTES, "is larger than 2 MB"),
    (f"[2800]\n{variable(5)}DefaultValue={HUGE}\n", "[2800] DefaultValue=999"),
    (f"[2800]\n{variable(5)}LowLimit=-{HUGE}\n", "[2800] LowLimit=-999"),
    (f"[{HUGE}]\n{HUGE}\n", "is neither a section"),
]  # fmt: skip


@pytest.mark.parametrize(("more", "said"), OUT_OF_BOUNDS, ids=[said for _, said in OUT_OF_BOUNDS])
def test_oversized_eds_is_refused_with_short_messages(more: str, said: str) -> None:
    found = problems(f"{SHIPPED}\n{more}")
    assert any(said in line for line in found), found
    assert all(len(line) < 600 for line in found)


VALUES = st.sampled_from(["", "-1", "0", "255", "0x1FFFFFFFF", "9" * 30, "[", "$NODEID", "x"])


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_damaged_file_is_either_read_or_refused(data: st.DataObject) -> None:
    lines = SHIPPED.split("\r\n")
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(lines) - 1))
        line = lines[at]
        value = data.draw(VALUES | st.text())
        more = [f"{line.split('=')[0]}={value}"], [value], [f"[{value}]"], [line, "CompactSubObj=2"]
        lines[at : at + 1] = data.draw(st.sampled_from([[], [line] * 2, *more]))
    for problem in problems("\r\n".join(lines).encode("utf-8", "replace")):
        assert problem.startswith("mine.eds: ")
        assert problem.endswith((".", ";'."))


def test_cob_ids_of_one_node_and_of_missing_objects_are_checked() -> None:
    text = with_key(SHIPPED, "1800sub1", "DefaultValue", "$NODEID+0x40000080")
    (said,) = problems(without(text.encode(), {0x1014}), 1)
    assert "COB-ID 081h is used by 1014h:00 of node 1 and by 1800h:01 of node 1." in said
    text = with_key(SHIPPED, "1800sub1", "DefaultValue", "$NODEID+0x4000057F")
    assert problems(text, 1) == ()
    said = problems(text, 3)[0]
    assert "TPDO 1: the defaults of 1800h and 1A00h are not a valid PDO of node 3" in said
    assert problems(SHIPPED, *range(1, 128)) == ()


def test_configured_setting_that_does_not_fit_its_object_is_refused() -> None:
    text = SHIPPED
    for key, value in (("DataType", "0x0005"), ("HighLimit", "0xFF"), ("DefaultValue", "0xFA")):
        text = with_key(text, "2100sub4", key, value)
    assert problems(text, 1) == ()
    eds = reader.load(text.encode(), "my.eds")
    said = "2100h:04 Telemetry time.out: cannot hold 5000, the configured value of b"
    with pytest.raises(UserError, match=said):
        check_eds(eds, shipped_eds(), [EscSettings(), EscSettings("b", timeout_ns=5_000_000_000)])


# --- allowed content


def test_any_case_lf_comments_and_unknown_sections_are_accepted() -> None:
    text = SHIPPED.replace("\r\n", "\n").replace("AccessType=rw", "ACCESSTYPE=RW")
    for old, new in (
        ("[1A00sub", "[1a00Sub"),
        ("ObjectType=0x8", "ObjectType=0x9"),
        ("SubNumber=", "SubNumber=1"),
        ("[DeviceInfo]", "[deviceinfo]"),
        ("ParameterName=", "parametername =  "),
        ("[1017]\n", "; a comment\n[1017]\n  ; another\n# a third\n"),
        ("DefaultValue=0x03E8", "DefaultValue=0x03E8 ; one second"),
    ):
        text = text.replace(old, new)
    ours = reader.load(f"{text}\n[Editor]\nColour=blue\n".encode(), "mine.eds")
    assert ours.entries == reader.load(SHIPPED.encode(), "kontronik_esc.eds").entries


def entry_2200(content: str) -> EdsEntry:
    """Return the variable 2200h of an EDS that is accepted."""
    eds = reader.load(with_object(content).encode("ascii"), "mine.eds")
    return next(entry for entry in eds.entries if entry.index == 0x2200)


@pytest.mark.parametrize(("data_type", "text", "read", "written"), list(rows_of("values.txt")))
def test_values_of_every_type_are_read_from_an_eds_and_written_to_a_dcf(
    data_type: str,
    text: str,
    read: str,
    written: str,
) -> None:
    content = variable(int(data_type, 16), DefaultValue=text)
    eds = reader.load(with_object(content).encode("ascii"), "mine.eds")
    entry = next(entry for entry in eds.entries if entry.index == 0x2200)
    shown = repr(entry.default)
    if entry.is_relative:
        shown += " + node-ID"
    assert shown == read
    assert entry.default is not None
    text = dcf.dcf(
        eds,
        1,
        500_000,
        {(0x2200, 0): entry.default},
        "left",
        "left.dcf",
    )
    expected = [written] if written != "-" else []
    assert re.findall("(?m)^ParameterValue=(.*)\r$", text) == expected


EMPTY = dict.fromkeys(("ObjectType", "LowLimit", "HighLimit", "DefaultValue", "PDOMapping"), "")


def test_signed_limits_and_keys_without_a_value_are_read() -> None:
    signed = {"LowLimit": "0x9C", "HighLimit": "0x64", "DefaultValue": "-100"}
    for data_type, keys, wanted in (
        (0x02, signed, (-100, 100, -100)),
        (0x06, EMPTY, (None, None, None)),
    ):
        entry = entry_2200(variable(data_type, **keys))
        assert (entry.low, entry.high, entry.default, entry.is_mappable) == (*wanted, False)


# --- the DCF


@pytest.mark.parametrize(
    "value",
    [
        "Gaß".encode("latin-1"),
        b"a\r\nb",
        b" a",
        b"a ; b",
        b"a\x00",
    ],
)
def test_text_that_a_dcf_cannot_contain_is_refused(value: bytes) -> None:
    eds = reader.load(SHIPPED.encode(), "kontronik_esc.eds")
    expected = r"kontronik_esc\.eds: 2010h:06 the text .* of Device name cannot be written"
    with pytest.raises(UserError, match=expected):
        dcf.dcf(
            eds,
            1,
            500_000,
            {(0x2010, 6): value},
            "left",
            "left.dcf",
        )


# --- dropped objects

DATA = SHIPPED.encode()
PDOS = frozenset(range(0x1800, 0x1C00))
OPTIONAL = sorted(
    {entry.index for entry in shipped_eds().entries} - PDOS - {0x1000, 0x1001, 0x1018}
)
EVERY_SYNC = {(0x1800, 2): {"default": 1}}
LSS_INQUIRY = ("5A", "5B", "5C", "5D", "5E")


def pdos_with(index: int) -> frozenset[int]:
    """Return the objects of PDOs that map a part of this object. They are dropped with it."""
    found = set()
    for entry in shipped_eds().entries:
        is_mapping = entry.index >> 9 == 0x1A00 >> 9 and entry.sub
        if is_mapping and isinstance(entry.default, int) and entry.default >> 16 == index:
            found |= {entry.index, entry.index - 0x200}
    return frozenset(found)


def behaviour(dropped: frozenset[int], self_start: bool = False) -> list[str]:
    """Return the frames of a node with their times, in a session that uses every service.

    SDO is not used, because it would show which objects exist.
    """
    eds = changed_eds(reader.load(without(DATA, dropped), "my.eds"), EVERY_SYNC)
    check_eds(eds, shipped_eds(), [EscSettings()])
    bench = Bench(eds=eds, boot=False, self_start=self_start)
    bench.can_state("ERROR_ACTIVE")
    bench.put(0, "01 00")
    for number in range(60):
        bench.wait(10)
        errors = (0, 1 << 17, 1 | 1 << 17, 0)[number // 15]
        bench.uart(live(battery_voltage=2000 + number, operating_errors=errors))
        if number == 5:
            bench.uart(info(cell_count=6))
        if number % 7 == 0:
            bench.put(0x080, b"" if number != 21 else b"\x01")
        if number % 9 == 0:
            bench.put(0x702, "05")
    bench.wait(1500)  # heartbeats are sent, and telemetry is lost
    bench.uart(live()[:-1] + b"\xff")
    bench.uart(live())
    for name in ("BUS_OFF", "ERROR_ACTIVE"):
        bench.can_state(name)
        bench.wait(300)
    bench.put(0x7E5, "04 01 00 00 00 00 00 00")
    for service in LSS_INQUIRY:
        bench.put(0x7E5, service + 7 * " 00")
    bench.put(0, "82 00")
    bench.wait(2000)
    for index in dropped:
        assert bench.read(index) == bench.write(index, 0, 0, size=1) == 0x06020000
    for entry in eds.entries:
        bench.read(entry.index, entry.sub)
    return [f"{time} {frame.can_id:03X} {frame.data.hex()}" for time, frame in bench.heard]


@cache
def whole(dropped: frozenset[int] = frozenset()) -> list[str]:
    return behaviour(dropped)


@pytest.mark.parametrize("index", OPTIONAL, ids=lambda index: f"{index:04X}h")
def test_without_an_object_a_node_behaves_as_with_the_shipped_default(index: int) -> None:
    pdos = pdos_with(index)
    assert behaviour(pdos | {index}) == whole(pdos)


def test_without_all_optional_objects_a_node_behaves_the_same() -> None:
    pdos = frozenset(index for index in shipped_eds().object_names if index in PDOS)
    dropped = frozenset(OPTIONAL) | pdos
    assert behaviour(dropped) == whole(pdos)
    assert behaviour(dropped, self_start=True) == behaviour(pdos, self_start=True)


@pytest.mark.parametrize("number", range(6))
def test_pdo_is_missing_only_without_its_own_objects(number: int) -> None:
    left = [line for line in whole() if line.split()[1] != f"{number + 1}81"]
    assert behaviour(frozenset({0x1800 + number, 0x1A00 + number})) == left


def test_session_receives_frames_of_every_service() -> None:
    heard = {line.split()[1] for line in whole()}
    assert heard == {"701", "081", "181", "281", "381", "481", "7E4"}
    codes = {line.split()[2][:4] for line in whole() if line.split()[1] == "081"}
    assert codes == {"0000", "2032", "4081", "4082", "1075"}


# --- files of editors on Windows

LATIN = SHIPPED.replace(
    "ParameterName=Battery voltage", "ParameterName=Akkuspannung gr\u00f6\u00dfer 5\u00b0"
).replace("[FileInfo]", "; f\u00fcr den Pr\u00fcfstand\r\n[FileInfo]", 1)


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(b"\xef\xbb\xbf" + SHIPPED.encode(), id="UTF-8 byte order mark"),
        pytest.param(SHIPPED.encode("utf-16"), id="UTF-16 with byte order mark"),
        pytest.param(SHIPPED.replace("\r\n", "\r").encode(), id="CR line ends"),
        pytest.param(SHIPPED.replace("\r\n", "\n").encode(), id="LF line ends"),
        pytest.param(SHIPPED.encode() + b"\x1a", id="Ctrl-Z"),
        pytest.param(SHIPPED.encode() + b"\r\n\x1a\r\n", id="Ctrl-Z on a line"),
        pytest.param(SHIPPED.encode() + b"\x1a\r\n\0\0", id="Ctrl-Z and padding"),
        pytest.param(LATIN.encode("latin-1"), id="Latin-1"),
        pytest.param(LATIN.encode("utf-8"), id="UTF-8"),
        pytest.param(LATIN.encode("utf-8-sig").replace(b"\r\n", b"\r") + b"\x1a", id="all at once"),
    ],
)
def test_files_of_windows_editors_result_in_the_same_node(data: bytes) -> None:
    assert problems(data) == ()
    eds = reader.load(data, "mine.eds")
    assert eds.data == data
    plain = shipped_eds().entries
    names = {entry.name for entry in eds.entries} - {entry.name for entry in plain}
    assert names <= {"Akkuspannung grosser 5deg"}
    without_names = [replace(entry, name="") for entry in eds.entries]
    assert without_names == [replace(entry, name="") for entry in plain]


def test_dcf_of_a_file_with_other_letters_is_ascii() -> None:
    data = LATIN.encode("latin-1")
    text = dcf.dcf(
        reader.load(data, "mine.eds"),
        1,
        250_000,
        {},
        "left",
        "left.dcf",
    )
    assert text.isascii()
    assert "ParameterName=Akkuspannung grosser 5deg" in text
    assert problems(without(data, {0x606C})) == ()


@pytest.mark.parametrize("coding", ["latin-1", "utf-8-sig", "utf-16"])
def test_mistake_in_a_file_of_a_windows_editor_is_reported_in_one_line(coding: str) -> None:
    text = LATIN.replace("LowLimit=0x01", "LowLimit=\u00fcbel", 1).replace("\r\n", "\r")
    (found,) = problems((text + "\x1a").encode(coding))
    assert found.startswith("mine.eds: [")
    assert "LowLimit=ubel: not a number" in found


def test_default_text_with_other_letters_is_refused() -> None:
    text = with_object(variable(9, DefaultValue="Gr\u00fc\u00dfe"))
    (found,) = problems(text.encode("latin-1"))
    assert found == (
        "mine.eds: [2200] DefaultValue=Gr\\xfc\\xdfe has characters outside ASCII. Use ASCII only."
    )


def test_key_with_other_letters_is_unknown() -> None:
    text = with_object(variable(5).replace("AccessType", "\u00c4ccessType"))
    (found,) = problems(text.encode("latin-1"))
    assert "[2200] AccessType=" in found
