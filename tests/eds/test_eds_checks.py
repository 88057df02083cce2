"""An EDS with a mistake is refused by file, section, key and remedy, all mistakes at once; what CiA 306 allows is taken."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import eds_text
import pytest
from eds_text import SHIPPED, variable
from hypothesis import given, settings
from hypothesis import strategies as st

from kontronik_can_gw.cia301 import eds as reader
from kontronik_can_gw.cia301.eds import Entry
from kontronik_can_gw.errors import UserError


def with_object(content: str, index: int = 0x2200) -> str:
    """The shipped EDS with one manufacturer object more."""
    return eds_text.with_object(SHIPPED, index, content)


def problems(text: str | bytes) -> tuple[str, ...]:
    """What is wrong with an EDS, () for nothing."""
    data = text if isinstance(text, bytes) else text.encode("ascii")
    try:
        reader.load(data, "mine.eds")
    except UserError as error:
        return error.problems
    return ()


def entry_of(text: str, index: int = 0x2200, sub: int = 0) -> Entry:
    """One entry of an EDS that is accepted."""
    eds = reader.load(text.encode("ascii"), "mine.eds")
    return next(entry for entry in eds.entries if (entry.index, entry.sub) == (index, sub))


def changed(old: str, new: str, count: int = 1) -> str:
    """The shipped EDS with one text for another."""
    assert old in SHIPPED
    return SHIPPED.replace(old, new, count)


def within(section: str, old: str, new: str) -> str:
    """The shipped EDS with one text for another in one section."""
    before, after = SHIPPED.split(f"[{section}]\r\n")
    body, bracket, rest = after.partition("\r\n[")
    assert old in body
    return f"{before}[{section}]\r\n{body.replace(old, new)}{bracket}{rest}"


def without_section(section: str) -> str:
    """The shipped EDS without a section."""
    before, after = SHIPPED.split(f"[{section}]\r\n")
    return f"{before}[{after.split(chr(10) + '[', 1)[1]}"


def test_the_shipped_one_has_no_mistake() -> None:
    assert problems(SHIPPED) == ()


# --- the file -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("section", ["FileInfo", "DeviceInfo", "MandatoryObjects"])
def test_mandatory_sections(section: str) -> None:
    assert f"mine.eds: [{section}] this section is mandatory and is not there. Add it." in problems(
        without_section(section)
    )


@pytest.mark.parametrize(("index", "name"), [(0x1000, "1000"), (0x1001, "1001"), (0x1018, "1018")])
def test_mandatory_objects(index: int, name: str) -> None:
    shorter = reader.without(SHIPPED.encode(), {index})
    assert problems(shorter) == (f"mine.eds: [{name}] this object is mandatory and is not there. Add it.",)


def test_the_vendor_id_is_mandatory() -> None:
    text = without_section("1018sub1").replace("SubNumber=0x5\r\n\r\n[1018sub0]", "SubNumber=0x4\r\n\r\n[1018sub0]")
    assert problems(text) == ("mine.eds: [1018] sub-index 1 is mandatory and is not there. Add it.",)


def mistakes() -> Iterator[Any]:
    """The rows of mistakes.txt, as text of an EDS and what is said."""
    for number, line in enumerate(Path(__file__).with_name("mistakes.txt").read_text("ascii").splitlines(), 1):
        if line.startswith((";", "==")) or not line:
            continue
        section, old, new, message = (part.strip(" ").replace("~", "\r\n") for part in line.split("|"))
        new = new.replace("{242 x}", "x" * 242)
        text = changed(old, new) if section == "-" else within(section, old, new)
        yield pytest.param(text, message, id=f"line {number}")


@pytest.mark.parametrize(("text", "message"), list(mistakes()))
def test_mistakes_by_section_and_key(text: str, message: str) -> None:
    found = problems(text)
    assert all(problem.startswith("mine.eds: ") for problem in found)
    assert any(message.removeprefix("+ ") in problem for problem in found), found
    assert len(found) == 1 or message.startswith("+ ")


def test_one_section_in_two_spellings_is_there_twice() -> None:
    assert problems(f"{SHIPPED}\r\n[1018SUB01]\r\n{variable(0x07)}") == (
        "mine.eds: [1018SUB01] this section is there twice. Remove one.",
    )


def test_letters_beyond_ascii_are_named_with_their_line() -> None:
    data = SHIPPED.replace("ParameterName=Throttle", "ParameterName=Gaß").encode("latin-1")
    line = SHIPPED[: SHIPPED.index("ParameterName=Throttle")].count("\n") + 1
    assert problems(data) == (f"mine.eds: line {line} is not ASCII: ParameterName=Ga\\xdf. Write it in plain letters.",)


def test_all_mistakes_are_told_at_once() -> None:
    text = (
        changed("[FileInfo]", "[File]")
        .replace("NrOfTXPDO=6", "NrOfTXPDO=7")
        .replace("AccessType=const", "AccessType=x")
    )
    found = problems(text)
    more = 2 + SHIPPED.count("AccessType=const") - 20
    assert len(found) == 21
    assert found[-1] == f"mine.eds: and {more} more mistakes."


def test_rubbish_is_refused_without_anything_else_being_raised() -> None:
    for data in (
        b"",
        b"\x00\xff" * 100,
        b"[",
        b"[]",
        b"=",
        b"[1000]",
        b"[1000sub0]\nParameterName=x",
        b"[Comments]\nLines=x",
    ):
        assert problems(data)


def test_what_is_no_eds_at_all_is_one_line() -> None:
    for data in (b"", bytes(range(256)) * 99, b'VERSION ""\nBO_ 1 A: 8 B', "[FileInfo]\r\n".encode("utf-16")):
        assert list(problems(data)) == [
            "mine.eds: is no EDS: it has none of the sections [FileInfo], [DeviceInfo], [MandatoryObjects]."
        ]


@settings(max_examples=80, deadline=None)
@given(st.data())
def test_a_damaged_file_is_read_or_refused_and_nothing_else(data: st.DataObject) -> None:
    lines = SHIPPED.split("\r\n")
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(lines) - 1))
        key = lines[at].split("=")[0]
        value = data.draw(
            st.one_of(st.sampled_from(["", "-1", "0", "255", "0x1FFFFFFFF", "9" * 30, "[", "$NODEID", "x"]), st.text())
        )
        lines[at : at + 1] = data.draw(
            st.sampled_from(
                [[], [lines[at]] * 2, [f"{key}={value}"], [value], [f"[{value}]"], [lines[at], "CompactSubObj=2"]]
            )
        )
    text = "\r\n".join(lines).encode("utf-8", "replace")
    found = problems(text)
    assert all(problem.startswith("mine.eds: ") and problem.endswith((".", ";'.")) for problem in found)


# --- lists ----------------------------------------------------------------------------------------------------------


def test_an_object_that_is_in_no_list_is_named() -> None:
    text = f"{SHIPPED}\r\n[2200]\r\n{variable(0x05)}"
    assert problems(text) == ("mine.eds: [2200] Test object is in none of the lists. Add it to [ManufacturerObjects].",)


def test_a_listed_object_without_a_section_is_named() -> None:
    assert any(
        "there is no section [1017]. Add it or remove this line." in problem
        for problem in problems(without_section("1017"))
    )


# --- objects and entries --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("data_type", [0x00, 0x0C, 0x0D, 0x10, 0x12, 0x13, 0x14, 0x16, 0x18, 0x19, 0x1A, 0x20])
def test_types_that_no_other_tool_can_be_trusted_with_are_refused(data_type: int) -> None:
    found = problems(with_object(variable(data_type)))
    assert len(found) == 1
    assert f"[2200] DataType=0x{data_type:04X}: not supported." in found[0]


@pytest.mark.parametrize(
    "data_type", [0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, 0x09, 0x0A, 0x0B, 0x0F, 0x11, 0x15, 0x1B]
)
def test_the_other_types_are_taken_as_plain_storage(data_type: int) -> None:
    entry = entry_of(with_object(variable(data_type)))
    assert (entry.data_type, entry.access, entry.default, entry.name) == (data_type, "rw", None, "Test object")


def test_a_sub_index_needs_its_object_and_an_object_its_sub_index_0() -> None:
    assert problems(f"{SHIPPED}\r\n[2200sub1]\r\n{variable(0x05)}") == (
        "mine.eds: [2200sub1] there is no section [2200]. Add it or remove this one.",
    )
    text = with_object(f"ParameterName=List\r\nObjectType=0x9\r\nSubNumber=1\r\n\r\n[2200sub1]\r\n{variable(0x05)}")
    assert problems(text) == (
        "mine.eds: [2200] sub-index 0 is missing. Add it with the highest sub-index as DefaultValue.",
    )


def test_a_variable_has_no_sub_indices() -> None:
    text = with_object(f"{variable(0x05)}\r\n[2200sub1]\r\n{variable(0x05)}")
    assert problems(text) == ("mine.eds: [2200sub1] [2200] is a VAR and has no sub-indices. Remove this section.",)


def test_sub_indices_end_at_fe() -> None:
    sub0 = variable(0x05, "const", DefaultValue="0xFF")
    text = with_object(
        f"ParameterName=List\r\nObjectType=0x9\r\nSubNumber=2\r\n\r\n[2200sub0]\r\n{sub0}\r\n[2200subFF]\r\n{variable(0x05)}"
    )
    assert problems(text) == ("mine.eds: [2200subFF] sub-indices end at FE. Remove this section.",)


# --- communication objects ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("index", [0x0005, 0x1004, 0x1006, 0x1007, 0x100C, 0x1012, 0x1201, 0x1400, 0x1600, 0x1F50])
def test_a_communication_object_without_a_service_is_refused_by_name(index: int) -> None:
    text = with_object(variable(0x07), index)
    found = problems(text)
    assert f"mine.eds: [{index:04X}] Test object: this node has no such service. Remove the object." in found


def test_the_width_of_1022h_is_not_agreed_on_and_both_are_taken() -> None:
    assert problems(within("1022", "DataType=0x0005", "DataType=0x0006")) == ()


def test_the_reserved_sub_index_4_of_a_pdo_is_refused() -> None:
    text = within("1800", "SubNumber=0x6", "SubNumber=0x7") + f"\r\n[1800sub4]\r\n{variable(0x05)}"
    assert problems(text) == ("mine.eds: [1800sub4] 1800h has no sub-index 4. Remove it.",)


@pytest.mark.parametrize(("dropped", "named", "partner"), [(0x1A03, "1803", "1A03"), (0x1803, "1A03", "1803")])
def test_half_a_pdo_is_refused(dropped: int, named: str, partner: str) -> None:
    assert problems(reader.without(SHIPPED.encode(), {dropped})) == (
        f"mine.eds: [{named}] [{partner}] of the same PDO is not there. Add it or remove this object.",
    )


def test_a_default_mapping_of_more_than_eight_bytes_is_refused() -> None:
    text = within("1A00sub0", "DefaultValue=0x03", "DefaultValue=0x04")
    text = text.replace("[1A00sub4]", "[1A00sub4]\r\n;", 1).replace(
        "ParameterName=TPDO 1 application object 4\r\nObjectType=0x7\r\nDataType=0x0007\r\nAccessType=rw\r\nDefaultValue=0x00000000",
        "ParameterName=TPDO 1 application object 4\r\nObjectType=0x7\r\nDataType=0x0007\r\nAccessType=rw\r\nDefaultValue=0x20000410",
    )
    assert problems(text) == ("mine.eds: [1A00] 80 bits are mapped, a PDO has 64. Map fewer objects.",)


def test_dropping_an_object_that_a_pdo_carries_is_told() -> None:
    found = problems(reader.without(SHIPPED.encode(), {0x2020}))
    assert [problem.split("] ")[0] for problem in found] == ["mine.eds: [1A03sub4", "mine.eds: [1A03sub5"]


# --- what is allowed ------------------------------------------------------------------------------------------------


def test_any_case_and_lf_are_taken() -> None:
    text = SHIPPED.replace("\r\n", "\n").replace("AccessType=rw", "ACCESSTYPE=RW").replace("[1A00sub", "[1a00Sub")
    text = text.replace("[DeviceInfo]", "[deviceinfo]").replace("ParameterName=", "parametername =  ")
    ours = reader.load(text.encode(), "mine.eds")
    assert ours.entries == reader.load(SHIPPED.encode(), "kontronik_esc.eds").entries


def test_comments_and_unknown_sections_are_passed_over() -> None:
    text = changed("[1017]\r\n", "; a comment\r\n[1017]\r\n  ; another\r\n# a third\r\n")
    text = text.replace("DefaultValue=0x03E8", "DefaultValue=0x03E8 ; one second") + "\r\n[Editor]\r\nColour=blue\r\n"
    assert reader.load(text.encode(), "mine.eds").entries == reader.load(SHIPPED.encode(), "kontronik_esc.eds").entries


def test_keys_without_a_value_are_not_there_as_editors_write_them() -> None:
    entry = entry_of(with_object(variable(0x06, LowLimit="", HighLimit="", DefaultValue="", PDOMapping="")))
    assert (entry.low, entry.high, entry.default, entry.mappable) == (None, None, None, False)


def test_a_missing_object_type_is_a_variable() -> None:
    assert entry_of(with_object(variable(0x06).replace("ObjectType=0x7\r\n", ""))).object_type == reader.VAR


@pytest.mark.parametrize(
    ("data_type", "text", "value"),
    [
        (0x01, "1", 1),
        (0x02, "-128", -128),
        (0x02, "0x80", -128),
        (0x02, "0xFF", -1),
        (0x02, "127", 127),
        (0x03, "0xFFFE", -2),
        (0x04, "0x80000000", -(1 << 31)),
        (0x15, "0xFFFFFFFFFFFFFFFF", -1),
        (0x05, "255", 255),
        (0x07, "0xffffffff", 0xFFFFFFFF),
        (0x1B, "0xFFFFFFFFFFFFFFFF", (1 << 64) - 1),
        (0x08, "-1.5", -1.5),
        (0x08, "0x3FC00000", 1.5),
        (0x11, "0x3FF8000000000000", 1.5),
        (0x09, "a name; with words", b"a name; with words"),
        (0x0A, "0102fE", b"\x01\x02\xfe"),
        (0x0B, "Hi", b"H\x00i\x00"),
        (0x0F, "00 FF", b"\x00\xff"),
    ],
)
def test_defaults_of_every_type(data_type: int, text: str, value: float | bytes) -> None:
    entry = entry_of(with_object(variable(data_type, DefaultValue=text)))
    assert entry.default == value
    assert type(entry.default) is type(value)


@pytest.mark.parametrize(
    ("data_type", "text"),
    [
        (0x01, "2"),
        (0x02, "128"),
        (0x02, "0x100"),
        (0x02, "-129"),
        (0x05, "256"),
        (0x07, "-1"),
        (0x08, "x"),
        (0x0A, "012"),
    ],
)
def test_defaults_that_do_not_fit(data_type: int, text: str) -> None:
    found = problems(with_object(variable(data_type, DefaultValue=text)))
    assert len(found) == 1
    assert f"[2200] DefaultValue={text}: " in found[0]


@pytest.mark.parametrize("text", ["$NODEID+0x200", "$NODEID + 512", "0x200+$NODEID", "$nodeid+0x200"])
def test_the_node_id_is_left_to_the_node(text: str) -> None:
    entry = entry_of(with_object(variable(0x07, DefaultValue=text)))
    assert (entry.default, entry.relative) == (0x200, True)


def test_the_node_id_alone() -> None:
    entry = entry_of(with_object(variable(0x05, DefaultValue="$NODEID")))
    assert (entry.default, entry.relative) == (0, True)


def test_signed_limits_in_twos_complement() -> None:
    entry = entry_of(with_object(variable(0x02, LowLimit="0x9C", HighLimit="0x64", DefaultValue="-100")))
    assert (entry.low, entry.high, entry.default) == (-100, 100, -100)


@given(st.integers(-(1 << 31), (1 << 31) - 1))
def test_every_integer_is_read_in_decimal_and_in_hexadecimal(number: int) -> None:
    for text in (str(number), f"0x{number & 0xFFFFFFFF:X}"):
        section = f"[2200]\n{variable(0x04, DefaultValue=text)}"
        found = reader.load(_small(section).encode(), "mine.eds").entries[-1]
        assert found.default == number


def _small(more: str) -> str:
    """A small EDS with a 2200h."""
    vendor = variable(0x07, "ro")
    return (
        "[FileInfo]\n[DeviceInfo]\n[MandatoryObjects]\nSupportedObjects=3\n1=0x1000\n2=0x1001\n3=0x1018\n"
        f"[ManufacturerObjects]\nSupportedObjects=1\n1=0x2200\n[1000]\n{variable(0x07, 'ro')}\n[1001]\n{variable(0x05, 'ro')}\n"
        "[1018]\nParameterName=Identity\nObjectType=9\nSubNumber=2\n"
        f"[1018sub0]\n{variable(0x05, 'ro', DefaultValue=1)}\n[1018sub1]\n{vendor}\n{more}"
    )


COMPACT = (
    "ParameterName=Cell\r\nObjectType=0x8\r\nDataType=0x0006\r\nAccessType=rw\r\nDefaultValue=0x10\r\nLowLimit=1\r\n"
)


def test_compact_sub_objects() -> None:
    text = with_object(f"{COMPACT}CompactSubObj=3\r\n")
    found = [entry for entry in reader.load(text.encode(), "mine.eds").entries if entry.index == 0x2200]
    assert [(each.sub, each.name, each.data_type, each.access, each.default, each.low) for each in found] == [
        (0, "Cell highest sub-index", 0x05, "const", 3, None),
        (1, "Cell1", 0x06, "rw", 0x10, 1),
        (2, "Cell2", 0x06, "rw", 0x10, 1),
        (3, "Cell3", 0x06, "rw", 0x10, 1),
    ]
    assert {each.object_type for each in found} == {reader.ARRAY}


def test_names_of_compact_sub_objects() -> None:
    text = with_object(f"{COMPACT}CompactSubObj=3\r\n\r\n[2200Name]\r\nNrOfEntries=2\r\n1=First\r\n3=Last\r\n")
    names = [entry.name for entry in reader.load(text.encode(), "mine.eds").entries if entry.index == 0x2200]
    assert names == ["Cell highest sub-index", "First", "Cell2", "Last"]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("CompactSubObj=255\r\n", "[2200] CompactSubObj=255: not 1 to 254."),
        ("CompactSubObj=x\r\n", "[2200] CompactSubObj=x: not a number."),
        (
            "CompactSubObj=2\r\n\r\n[2200Name]\r\nNrOfEntries=2\r\n1=A\r\n",
            "[2200Name] NrOfEntries=2, but 1 names are there.",
        ),
        ("CompactSubObj=2\r\n\r\n[2200Name]\r\nNrOfEntries=1\r\n3=A\r\n", "[2200Name] 3: not a sub-index from 1 to 2."),
        ("CompactSubObj=2\r\n\r\n[2200Value]\r\nNrOfEntries=1\r\n1=5\r\n", "[2200Value] values belong in a DCF."),
    ],
)
def test_mistakes_of_compact_sub_objects(more: str, message: str) -> None:
    assert any(message in problem for problem in problems(with_object(f"{COMPACT}{more}")))


def test_a_compact_error_history_begins_empty() -> None:
    text = reader.without(SHIPPED.encode(), {0x1003}).decode()
    count = int(text.split("[OptionalObjects]\r\nSupportedObjects=")[1].split("\r\n")[0])
    text = text.replace(
        f"[OptionalObjects]\r\nSupportedObjects={count}",
        f"[OptionalObjects]\r\nSupportedObjects={count + 1}\r\n{count + 1}=0x1003",
    )
    text += f"\r\n[1003]\r\n{variable(0x07, 'ro')}CompactSubObj=4\r\n".replace("ObjectType=0x7", "ObjectType=0x8")
    assert (entry_of(text, 0x1003, 0).default, entry_of(text, 0x1003, 0).access) == (0, "rw")
    assert entry_of(text, 0x1003, 4).access == "ro"


# --- the DCF --------------------------------------------------------------------------------------------------------


def test_values_of_compact_sub_objects_stand_in_a_section_of_their_own() -> None:
    eds = reader.load(with_object(f"{COMPACT}CompactSubObj=3\r\n").encode(), "mine.eds")
    text = reader.dcf(eds, 1, 500_000, {(0x2200, 3): 7, (0x2200, 1): 5}, "left", "left.dcf")
    assert "CompactSubObj=3\r\n\r\n[2200Value]\r\nNrOfEntries=2\r\n1=0x0005\r\n3=0x0007\r\n" in text


@pytest.mark.parametrize(
    ("data_type", "value", "written"),
    [
        (0x01, 1, "0x1"),
        (0x02, -5, "-5"),
        (0x06, 500, "0x01F4"),
        (0x08, 1.5, "1.5"),
        (0x09, b"two words", "two words"),
        (0x0A, b"\x01\xff", "01ff"),
        (0x0B, b"H\x00i\x00", "Hi"),
    ],
)
def test_values_of_every_type_in_the_dcf(data_type: int, value: float | bytes, written: str) -> None:
    eds = reader.load(with_object(variable(data_type)).encode(), "mine.eds")
    text = reader.dcf(eds, 1, 500_000, {(0x2200, 0): value}, "left", "left.dcf")
    assert text.endswith(f"AccessType=rw\r\nParameterValue={written}\r\n\r\n")


def test_domains_are_left_out_of_the_dcf() -> None:
    eds = reader.load(SHIPPED.encode(), "kontronik_esc.eds")
    assert "ParameterValue" not in reader.dcf(eds, 1, 500_000, {(0x1021, 0): b"abc"}, "left", "left.dcf")


@pytest.mark.parametrize("value", ["Gaß".encode("latin-1"), b"a\r\nb", b" a", b"a ; b", b"a\x00"])
def test_a_text_that_a_dcf_cannot_hold_is_named(value: bytes) -> None:
    eds = reader.load(SHIPPED.encode(), "kontronik_esc.eds")
    with pytest.raises(UserError, match=r"kontronik_esc\.eds: \[2010sub6\] the text .* of Device name cannot stand"):
        reader.dcf(eds, 1, 500_000, {(0x2010, 6): value}, "left", "left.dcf")


def test_a_dcf_is_not_taken_for_an_eds() -> None:
    eds = reader.load(SHIPPED.encode(), "kontronik_esc.eds")
    found = problems(reader.dcf(eds, 1, 500_000, {(0x1017, 0): 500}, "left", "left.dcf"))
    assert len(found) == 2
    assert "this is a DCF" in found[0]


def test_the_canopen_library_is_not_loaded_before_an_eds_is() -> None:
    code = "import sys, kontronik_can_gw.cia301.eds; print('canopen' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "False"
