"""A wrong number in any field of any row that the core in C gets is refuted.

Each field is changed in one row after the other, until the proof refutes the change. A field whose
changes are never refuted is not read by the proof.
"""

import ctypes
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any

import pytest
from dbc_proof.proof import Proof
from test_dbc_proof import EVERY_RULE

from kontronik_can_gw.assembly.assemble import load_configuration
from kontronik_can_gw.native.header import NotInCore, structure
from kontronik_can_gw.native.tables import Tables

pytestmark = pytest.mark.promise("proven-dbc")

DBCS = ("every_rule.dbc", "protected.dbc")
ROWS = ("message", "signal", "piece", "pair", "e2e", "settings")
FIELDS = [
    (name, field)
    for name in ROWS
    for field, _ in structure(f"kcg_{name}")._fields_
    if not field.startswith("reserved")
]
BITS = (1, 3, 4, 5, 6, 7, 15, 31, 40, 62)


@pytest.fixture(scope="module")
def proofs(tmp_path_factory: pytest.TempPathFactory) -> list[Proof]:
    found = []
    for dbc in DBCS:
        path = tmp_path_factory.mktemp("every_number") / "gateway.toml"
        path.write_text(EVERY_RULE.replace("every_rule.dbc", dbc))
        loaded = load_configuration(path)
        assert loaded.database is not None
        found.append(Proof(loaded.database, loaded.layout, loaded.escs, loaded.config.dbc))
    return found


def rows_of(tables: Tables, name: str) -> Iterator[Any]:
    """Yield the rows of a table. A change of such a row changes the table."""
    if name == "settings":
        yield from tables.settings
        return
    kind, rows = tables.arrays[name]
    for place in range(len(rows)):
        yield kind.from_buffer(rows.data, place * ctypes.sizeof(kind))


def changes_of_rows(tables: Tables, name: str, field: str) -> Iterator[None]:
    """Change a field of one row after the other, and restore it after each yield."""
    for row in rows_of(tables, name):
        right = getattr(row, field)
        if isinstance(right, ctypes.Array):
            yield from changes_of_list(right)
            continue
        for wrong in (right + 1, right - 1, *(right ^ 1 << bit for bit in BITS)):
            try:
                setattr(row, field, wrong)
                yield
            except NotInCore:
                continue  # the field cannot hold the number
            finally:
                setattr(row, field, right)


def changes_of_list(numbers: Any) -> Iterator[None]:
    """Change one number after the other, and restore it after each yield."""
    for place, right in enumerate(numbers):
        for wrong in (right + 1, right ^ 1 << 15):
            try:
                numbers[place] = wrong
                yield
            finally:
                numbers[place] = right


def changes_of_pages(tables: Tables) -> Iterator[None]:
    right = tables.pages
    try:
        tables.pages = right + 1
        yield
    finally:
        tables.pages = right


def changes_of_quiet_mode(tables: Tables) -> Iterator[None]:
    right = tables._core_settings
    try:
        tables._core_settings = replace(right, quiet_after_ns=right.quiet_after_ns + 1)
        yield
    finally:
        tables._core_settings = right


def assert_one_is_refuted(proofs: list[Proof], change: Callable[[Tables], Iterator[None]]) -> None:
    tried = 0
    for proof in proofs:
        assert proof.tables is not None
        assert proof.complete().refuted == []
        with closing(change(proof.tables)) as changes:  # type: ignore[type-var]
            for _ in changes:
                tried += 1
                if proof.complete().refuted:
                    return
    pytest.fail(f"{tried} changes were not refuted, so the proof does not read the number")


@pytest.mark.parametrize(("name", "field"), FIELDS)
def test_wrong_number_in_a_row_is_refuted(proofs: list[Proof], name: str, field: str) -> None:
    assert_one_is_refuted(proofs, lambda tables: changes_of_rows(tables, name, field))


@pytest.mark.parametrize("name", ["constants", "esc_of", "listeners_of"])
def test_wrong_number_in_a_list_is_refuted(proofs: list[Proof], name: str) -> None:
    def change(tables: Tables) -> Iterator[None]:
        numbers = getattr(tables, name)
        return changes_of_list(numbers[1] if name == "listeners_of" else numbers)

    assert_one_is_refuted(proofs, change)


@pytest.mark.parametrize("change", [changes_of_pages, changes_of_quiet_mode])
def test_wrong_number_of_the_plan_is_refuted(
    proofs: list[Proof],
    change: Callable[[Tables], Iterator[None]],
) -> None:
    """The other numbers are the lengths of tables."""
    assert_one_is_refuted(proofs, change)


def test_lists_of_numbers_are_complete(proofs: list[Proof]) -> None:
    tables = proofs[0].tables
    assert tables is not None
    lists = {"constant", "esc_of", "listener", "first_listener"}
    assert tables.arrays.keys() == {*ROWS, *lists} - {"settings"}
    lengths = {"words", "messages", "escs", "slots"}
    assert tables.counts.keys() == {"pages", "quiet_after_ns", *lengths}
