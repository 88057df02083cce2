"""Every reference of a page or a comment leads to something that exists.

The kinds are links between pages, names of files, and names of functions as in docs/design.md:
``runtime/loop.py: Loop.turn``, or ``Loop.turn`` alone after its file was named.
"""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

pytestmark = pytest.mark.promise("docs")

PROJECT = Path(__file__).resolve().parents[2]
PACKAGE = PROJECT / "kontronik_can_gw"
PARTS = ("kontronik_can_gw", "tests", "docs", "examples", "dbc", "eds", "deb", ".ci")
_WITH_INVENTED_NAMES = (PROJECT / "tests/readme", PROJECT / "tests/prose")
_ROOTS = ("kontronik_can_gw", "tests", "docs")
_CODE_BLOCK = re.compile(r"```.*?```", re.DOTALL)
_PATH = re.compile(r"(?<![\w/.])((?:[\w.-]+/)+[\w-]+\.(?:py|c|h|md|toml|tsv|dbc|eds|txt))\b")
_FUNCTION = re.compile(r"`(?:([\w/]+\.(?:py|c)): )?([A-Za-z_][\w.]*)`")


def files(*suffixes: str) -> list[Path]:
    """Return the project's files with these suffixes. Names that begin with a dot are left out."""
    found = [path for path in PROJECT.glob("*.*") if path.suffix in suffixes]
    for part in PARTS:
        for path in (PROJECT / part).rglob("*.*"):
            inner = path.relative_to(PROJECT / part).parts
            if path.suffix in suffixes and not any(name.startswith(".") for name in inner):
                found.append(path)
    return sorted(found)


def anchors(text: str) -> set[str]:
    """Return the anchors of a page, which its headings give."""
    headings = re.findall(r"^#+ (.+)$", _CODE_BLOCK.sub("", text), re.MULTILINE)
    words = [re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings]
    return {text.replace(" ", "-") for text in words}


def links(text: str) -> Iterator[str]:
    """Yield the targets of a page's links that lead to files of the project."""
    for link in re.findall(r"\]\(([^)]+)\)", _CODE_BLOCK.sub("", text)):
        if "://" not in link:
            yield link


@pytest.mark.parametrize("page", files(".md"), ids=lambda path: str(path.relative_to(PROJECT)))
def test_links_of_a_page_lead_to_files_and_headings(page: Path) -> None:
    for link in links(page.read_text(encoding="utf-8")):
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(target.read_text(encoding="utf-8")), link


def test_files_named_in_pages_and_sources_exist() -> None:
    wrong = []
    for path in files(".md", ".py", ".c", ".h"):
        if "vendor" in path.parts or path.parent in _WITH_INVENTED_NAMES:
            continue
        text = path.read_text(encoding="utf-8")
        for name in set(_PATH.findall(text)):
            first = name.split("/")[0]
            is_test = path.relative_to(PROJECT).parts[0] == "tests"
            if first in _ROOTS or (first in _folders() and not is_test):  # tests create files
                homes = (PROJECT, PACKAGE, path.parent)
                if not any((home / name).exists() for home in homes):
                    wrong.append(f"{path.relative_to(PROJECT)}: {name}")
    assert not wrong


@cache
def _folders() -> frozenset[str]:
    """The folders of the package, which docs/design.md names without the package."""
    return frozenset(path.name for path in PACKAGE.iterdir() if path.is_dir())


@cache
def _names() -> dict[str, set[str]]:
    """The names that each class of the package defines, and of each module under its file name.

    The names of a class include the inherited ones.
    """
    found: dict[str, set[str]] = {}
    bases: dict[str, set[str]] = {}
    for path in PACKAGE.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        module = found.setdefault(str(path.relative_to(PACKAGE)), set())
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                module.add(node.name)
                found.setdefault(node.name, set()).update(_members(node))
                named = {base.id for base in node.bases if isinstance(base, ast.Name)}
                bases.setdefault(node.name, set()).update(named)
            elif isinstance(node, ast.FunctionDef):
                module.add(node.name)
        module.update(_members(tree))
    for name in bases:
        for base in _ancestors(name, bases):
            found[name] |= found.get(base, set())
    return found


def _ancestors(name: str, bases: dict[str, set[str]]) -> Iterator[str]:
    for base in bases.get(name, ()):
        yield base
        yield from _ancestors(base, bases)


def _members(tree: ast.AST) -> Iterator[str]:
    """Yield the functions, variables and attributes that a class or a module defines."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.Name(id=name, ctx=ast.Store()):
                yield name
            case ast.Attribute(value=ast.Name(id="self"), attr=name, ctx=ast.Store()):
                yield name


def _is_defined(file: str, name: str) -> bool:
    """Return whether a file, or any file if it is "", defines a function or Class.method."""
    owner, _, member = name.rpartition(".")
    if file.endswith(".c"):
        homes = [path for path in PACKAGE.rglob("*.[ch]") if str(path).endswith(f"/{file}")]
        return any(re.search(rf"\b{name}\(", path.read_text(encoding="utf-8")) for path in homes)
    if file.startswith("tests/"):
        return f"\ndef {name}(" in (PROJECT / file).read_text(encoding="utf-8")
    known = _names()
    if owner:
        return member in known.get(owner, set())
    homes_in_python = [path for path in known if f"/{path}".endswith(f"/{file}")]
    return any(member in known[path] for path in homes_in_python)


def test_functions_named_in_the_design_exist() -> None:
    pages = [PROJECT / "docs" / name for name in ("design.md", "decisions.md", "recipes.md")]
    text = _CODE_BLOCK.sub("", "".join(page.read_text(encoding="utf-8") for page in pages))
    text = re.sub(r"\s+", " ", text)
    references = [(file, name) for file, name in _FUNCTION.findall(text) if file or "." in name]
    is_code = re.compile(r"_?[A-Z]\w+\.\w+")
    checked = [(file, name) for file, name in references if file or is_code.fullmatch(name)]
    checked.remove(("", "Bus.send"))  # of python-can
    assert len(checked) > 58
    assert not [f"{file}: {name}" for file, name in checked if not _is_defined(file, name)]


def test_wrong_references_are_found() -> None:
    assert _is_defined("runtime/loop.py", "Loop.turn")
    assert _is_defined("core.c", "kcg_receive")
    assert not _is_defined("runtime/loop.py", "Loop.turns")
    assert not _is_defined("core.c", "kcg_receives")
    assert not _is_defined("loop.py", "poller_for")
    assert list(links("[a](b.md#c) [d](https://e) ```\n[f](g)\n```")) == ["b.md#c"]
    assert anchors("# A `b`: c\n```\n# d\n```\n") == {"a-b-c"}
