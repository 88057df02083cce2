"""The judge of the tests: its sample stays the same where code does, and its list of faults fits the present code."""

import ast
import textwrap
from pathlib import Path

import pytest
from mutants import PROJECT
from mutations import Mutation, mutations, noting_lines
from put_in_faults import Fault, faults

FILE = Path("kontronik_can_gw/some.py")


def mutants(source: str) -> list[Mutation]:
    return list(mutations(FILE, textwrap.dedent(source)))


def mutated(source: str) -> set[str]:
    """Each mutant's whole source."""
    found = set()
    for number in range(len(mutants(source))):
        mutant = mutants(source)[number]
        mutant.put_in()
        found.add(ast.unparse(mutant.tree))
    return found


@pytest.mark.parametrize(
    ("line", "others"),
    [
        ("x = a < b", {"x = a <= b"}),
        ("x = a is not b", {"x = a is b"}),
        ("x = a << b", {"x = a >> b"}),
        ("x = 0x10", {"x = 15", "x = 17"}),
        ("x = a and b", {"x = a or b"}),
        ("x = not a", {"x = a"}),
        ("x = f(a, b)", {"x = f(b, a)"}),
        ("x += a", {"x -= a", "pass"}),
        ("x[a] = b", {"pass"}),
        ("x = min(a, b)", set()),
        ("x = isinstance(a, int | float)", set()),
        ("x: Literal[1] | None", set()),
        ("'text 1'", set()),
    ],
)
def test_what_takes_the_place_of_a_line(line: str, others: set[str]) -> None:
    found = mutated(line)
    assert found <= others
    assert bool(found) == bool(others)


def test_error_texts_and_texts_of_objects_are_left_out() -> None:
    source = """
        def f(a):
            raise ValueError(f"{a + 1} does not fit", 1 + 2)

        def __repr__(self):
            return f"{self.a + 1}"
    """
    assert mutated(source) == {
        ast.unparse(ast.parse(textwrap.dedent(source).replace("raise", "pass #")))
    }


def test_a_key_does_not_depend_on_what_stands_elsewhere() -> None:
    source = """
        def f(a):
            return a + 1
    """
    more = f"import os\n\nx = 5 < 6\n{textwrap.dedent(source)}\n\ndef g(a):\n    return a + 1\n"
    keys = [mutant.key for mutant in mutants(source)]
    assert len(keys) == len(set(keys)) == 3
    of_f = [mutant.key for mutant in mutants(more) if mutant.function == "f"]
    assert of_f == keys
    assert len({mutant.key for mutant in mutants(more)}) == len(mutants(more))


def test_each_statement_that_is_executed_is_noted() -> None:
    source = """\
        "docstring"
        if 1 < 2:
            x = [
                1
            ]
        elif x:
            y = 2
        for z in x:
            w = z
        else:
            v = 3
    """
    seen: list[tuple[str, int]] = []
    exec(
        compile(noting_lines(textwrap.dedent(source), "f", "note"), "f", "exec"),
        {"note": seen.append},
    )
    assert seen == [("f", line) for line in (2, 3, 8, 9, 11)]


@pytest.mark.parametrize("fault", faults(), ids=lambda fault: fault.what)
def test_a_fault_of_the_list_can_be_put_in(fault: Fault) -> None:
    file, changed = fault.put_in()
    assert changed != file.read_text()
    assert all((PROJECT / tests).exists() for tests in fault.seen_by)
