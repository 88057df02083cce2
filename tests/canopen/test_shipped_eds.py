"""The shipped EDS agrees with the protocol specification, the configuration and strict readers."""

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import canopen
import pytest
from canopen.objectdictionary import ODVariable
from eds_text import SHIPPED as SHIPPED_TEXT
from eds_text import dcfchk, with_key

from kontronik_can_gw.canopen import eds as reader
from kontronik_can_gw.canopen.eds import Eds, EdsEntry
from kontronik_can_gw.canopen.eds_changes import without
from kontronik_can_gw.canopen.objects import BINDINGS
from kontronik_can_gw.config.keys import EscConfig
from kontronik_can_gw.desk import dcf
from kontronik_can_gw.esc.kontronik.fields import DataType, FieldRow, InfoData, LiveData, rows

pytestmark = pytest.mark.promise("shipped-eds")

SHIPPED = Path(__file__).parents[2] / "eds" / "kontronik_esc.eds"
DATA = SHIPPED.read_bytes()
U8 = 0x05
U16 = 0x06
U32 = 0x07
TYPE_OF_WIRE = {"I": U32, "H": U16, "B": U8, "h": 0x03, "b": 0x02}
# CiA 303-2: prefix as a power of ten, numerator, denominator
UNIT_CODES = {"V": 0x260000, "A": 0x040000, "°C": 0x2D0000, "1/min": 0xB44700}
UNIT_CODES |= {"": 0, "µs": 0x030000, "%": 0}
PREFIX = {"µs": -6, "%": -2}


@pytest.fixture(scope="module")
def shipped() -> Eds:
    return reader.load(DATA, SHIPPED.name)


@pytest.fixture(scope="module")
def entries(shipped: Eds) -> dict[tuple[int, int], EdsEntry]:
    return {(entry.index, entry.sub): entry for entry in shipped.entries}


def title(field: str) -> str:
    """Return a field's name in the spelling of the EDS."""
    words = field.replace("_", " ").replace("bec", "BEC").replace("pwm", "PWM")
    return words[0].upper() + words[1:]


def extremes() -> dict[str, FieldRow]:
    names = InfoData._fields[InfoData._fields.index("max_electrical_speed") :]
    return {name: rows(InfoData)[name] for name in names}


# --- the text


def test_names_are_unique_in_the_file_and_have_at_least_two_characters(shipped: Eds) -> None:
    names = re.findall("^ParameterName=(.*)\r$", SHIPPED_TEXT, re.MULTILINE)
    assert [name for name, count in Counter(names).items() if count > 1] == []
    assert min(map(len, names)) >= 2
    read = {entry.name for entry in shipped.entries}
    read |= set(shipped.object_names.values())
    assert read == set(names)


# --- the objects


@pytest.mark.parametrize(
    ("index", "data"),
    [(0x2000, LiveData), (0x2011, InfoData)],
    ids=["live frame", "logged extremes"],
)
def test_fields_are_in_wire_order_and_have_their_types(
    entries: dict[tuple[int, int], EdsEntry],
    index: int,
    data: DataType,
) -> None:
    fields_of_frame = rows(LiveData) if data is LiveData else extremes()
    objects = max(sub for at, sub in entries if at == index)
    assert objects == len(fields_of_frame), f"add the field to eds/{SHIPPED.name}, {index:X}h"
    for sub, (name, row) in enumerate(fields_of_frame.items(), 1):
        entry = entries[index, sub]
        expected = title(name).replace("Max ", "Maximum ").replace("Min ", "Minimum ")
        assert entry.name == expected
        assert entry.data_type == TYPE_OF_WIRE[row.wire], name
        assert entry.access == "ro"
        assert entry.is_mappable
        assert entry.low is None
        assert entry.high is None
        assert entry.default == 0
        assert (index, sub) in BINDINGS, f"add {name} to canopen/objects.tsv"
        shown = BINDINGS[index, sub]
        assert shown.source.name.removesuffix("_raw") == name
        assert shown.steps == row.per_unit, name


def test_unit_codes_agree_with_the_table_of_fields(
    entries: dict[tuple[int, int], EdsEntry],
) -> None:
    for sub, (name, row) in enumerate(rows(LiveData).items(), 1):
        assert (0x2002, sub) in entries, f"add the unit of {name} to eds/{SHIPPED.name}, 2002h"
        entry = entries[0x2002, sub]
        assert entry.access == "const"
        assert entry.data_type == U32
        assert entry.name.lower() == f"unit of {title(name).lower()}"
        if row.unit == "mAh":  # 3.6 C has no code
            assert entry.default == 0
            continue
        power = PREFIX.get(row.unit, 0) - (len(str(row.per_unit)) - 1)
        assert entry.default == (power & 0xFF) << 24 | UNIT_CODES[row.unit], name


@pytest.mark.parametrize(
    ("sub", "key"),
    [(1, "pole_pairs"), (4, "telemetry_timeout_ms"), (7, "cell_count")],
)
def test_settings_have_the_ranges_and_defaults_of_the_configuration(
    entries: dict[tuple[int, int], EdsEntry],
    sub: int,
    key: str,
) -> None:
    definition: Any = next(each for each in fields(EscConfig) if each.name == key)
    entry = entries[0x2100, sub]
    allowed = definition.metadata["kind"].schema
    most = entry.high
    if most is None:
        most = {U8: 0xFF, U16: 0xFFFF}[entry.data_type]
    assert (entry.low or 0) == allowed["minimum"]
    assert most == allowed["maximum"]
    assert entry.default == definition.default


# --- comparison with the canopen library


def variables(dictionary: canopen.ObjectDictionary) -> Iterator[ODVariable]:
    """Yield all entries that the library has read."""
    for item in dictionary.values():
        yield from [item] if isinstance(item, ODVariable) else item.values()


def as_bytes(value: object) -> object:
    """Return a text as bytes, as our reader does. Other values are not changed."""
    return value.encode() if isinstance(value, str) else value


def power_on(entry: EdsEntry, node_id: int) -> int | float | bytes | None:
    """Return the default of an entry for a node."""
    return entry.default + node_id if entry.is_relative else entry.default  # type: ignore[operator]


@pytest.mark.parametrize("node_id", [1, 127])
def test_canopen_library_reads_every_entry_like_our_reader(shipped: Eds, node_id: int) -> None:
    dictionary = canopen.import_od(str(SHIPPED), node_id=node_id)
    theirs = {}
    for v in variables(dictionary):
        about = v.name, v.data_type, v.access_type, v.pdo_mappable, v.min, v.max
        theirs[v.index, v.subindex] = (*about, as_bytes(v.default))
    ours = {}
    for e in shipped.entries:
        about = e.name, e.data_type, e.access, e.is_mappable, e.low, e.high
        ours[e.index, e.sub] = (*about, power_on(e, node_id))
    assert ours == theirs
    assert {index: dictionary[index].name for index in dictionary} == shipped.object_names


def test_mirrors_can_be_dropped(shipped: Eds, tmp_path: Path) -> None:
    mirrors = (0x603F, 0x606C, 0x6079)
    shorter = without(DATA, mirrors)
    rest = reader.load(shorter, "short.eds")
    assert rest.entries == tuple(entry for entry in shipped.entries if entry.index not in mirrors)
    file = tmp_path / "mine.eds"
    file.write_bytes(shorter)
    assert dcfchk(file, 1) == ""


# --- readers of other projects


@pytest.mark.parametrize("node_id", [1, 5, 127])
def test_dcfchk_finds_no_mistake_in_the_eds_and_in_its_dcf(
    shipped: Eds,
    tmp_path: Path,
    node_id: int,
) -> None:
    values = {}
    for entry in shipped.entries:
        value = power_on(entry, node_id)
        if entry.access != "wo" and value is not None:
            values[entry.index, entry.sub] = value
    file = tmp_path / "left.dcf"
    text = dcf.dcf(shipped, node_id, 250_000, values, "left", "left.dcf")
    file.write_bytes(text.encode("ascii"))
    assert dcfchk(SHIPPED, node_id) == dcfchk(file, node_id) == ""
    file.write_bytes(with_key(SHIPPED_TEXT, "2100", "SubNumber", "0x8").encode("ascii"))
    assert "1 extra sub-object(s) for object 0x2100" in dcfchk(file, 1), "it can find something"


def test_defaults_fit_their_limits_for_a_node_without_a_node_id(shipped: Eds) -> None:
    """Lely's dcf2c adds 255 for $NODEID in a file without a node, and warns of an overflow."""
    relative = [entry for entry in shipped.entries if entry.is_relative]
    assert len(relative) > 5
    for entry in relative:
        assert isinstance(entry.default, int)
        _, largest = reader.range_of(entry.data_type)
        high = largest if entry.high is None else entry.high
        assert entry.default + 255 <= high, entry.place
