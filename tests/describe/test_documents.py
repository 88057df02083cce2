"""The document holds everything, and whatever is in a DBC or EDS is shown as text: read back by a parser that knows nothing of us."""

import json
import shutil
import subprocess
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import pytest
from command_line import run
from described import NASTY, NASTY_NAME, NASTY_UNIT, described, nasty
from hypothesis import example, given
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from kontronik_can_gw.cli import COMMANDS
from kontronik_can_gw.desk.describe.markdown import Code, Section, Table, markdown

Rows = list[list[str]]


class Page(HTMLParser):
    """Titles, paragraphs and tables of a page whose tags are right, and the names of its tags."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self._open: list[str] = []
        self.tags: set[str] = set()
        self.titles: list[str] = []
        self.paragraphs: list[str] = []
        self.tables: list[Rows] = []
        self._text = ""
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag not in {"meta", "wbr", "input", "br"}:
            self._open.append(tag)
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in ("td", "th", "p", "h1", "h2", "h3"):
            self._text = ""

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag
        if tag in ("td", "th"):
            self.tables[-1][-1].append(self._text)
        if tag == "p":
            self.paragraphs.append(self._text)
        if tag in ("h1", "h2", "h3"):
            self.titles.append(self._text)

    def handle_data(self, data: str) -> None:
        self._text += data

    @property
    def cells(self) -> set[str]:
        return {cell for table in self.tables for row in table for cell in row}


def read_markdown(text: str) -> Page:
    """Markdown as markdown-it makes HTML of it; nothing that is HTML in the source may come through."""
    parser = MarkdownIt("commonmark").enable("table").enable("strikethrough")
    raw = [
        t.content
        for token in parser.parse(text)
        for t in (token, *(token.children or ()))
        if "html" in t.type
    ]
    assert set(raw) <= {"<!-- -->"}
    return Page(parser.render(text).replace("<!-- -->", ""))


def one_line(text: str) -> str:
    return " ".join(text.split())


def everything(facts: dict[str, object]) -> Iterator[str]:
    """Every text and name of the description that people should find in a document."""
    for key, value in facts.items():
        if key in ("format", "version", "byte_order", "send_type", "source", "role", "esc", "kind"):
            continue
        for item in value if isinstance(value, list) else [value]:
            if isinstance(item, dict):
                yield from everything(item)
            elif isinstance(item, str) and item:
                yield item


def test_everything_that_the_facts_hold_is_in_the_document() -> None:
    found = read_markdown(described())
    facts = json.loads(described("--format", "json"))
    whole = "\n".join([*found.titles, *found.paragraphs, *sorted(found.cells)])
    del facts["sources"]  # those that only objects show are with the objects
    for text in everything(facts):
        assert one_line(text) in whole, text


def test_markup_in_a_dbc_or_eds_is_shown_as_text(tmp_path: Path) -> None:
    found = read_markdown(described("-c", nasty(tmp_path)))
    assert found.tags == read_markdown(described()).tags
    comment = one_line(NASTY.replace("\\", "/"))
    assert comment in found.paragraphs
    assert {comment, NASTY_UNIT} <= found.cells
    assert f"2000h {NASTY_NAME}" in found.titles
    assert "Foreign" not in " ".join(found.titles)
    assert all({len(row) for row in table} == {len(table[0])} for table in found.tables)


texts = st.text(
    st.characters(codec="utf-8", exclude_categories=["Cc", "Cs", "Zl", "Zp"]), max_size=40
)
markup = st.text(st.sampled_from("|`*_[]()<>&\\#-+.!~=$:/1a \n\t\"'"), max_size=24)
words = st.one_of(texts, markup)


@given(words, words, words, words)
@example("a|b", "`|`", "``", "www.x.org")
@example("1.", "1) x", "- x", "# x")
@example("#", "x ##", " #", "#")
@example("_a_", "a_b_c", "\\", "\\|")
@example("&lt;", "<!--", "]]>", "***")
def test_any_text_comes_back_as_it_is(title: str, paragraph: str, cell: str, name: str) -> None:
    table = Table(("one", "two"), ((cell, Code(name)), (paragraph, "end")))
    blocks = (f"x {paragraph}", table) if not paragraph.strip() else (paragraph, table)
    found = read_markdown(markdown("All", ["lead"], [Section(f"T {title}", 2, blocks)]))
    assert list(map(one_line, found.titles)) == ["All", one_line(f"T {title}")]
    assert one_line(blocks[0] if isinstance(blocks[0], str) else "") in map(
        one_line, found.paragraphs
    )
    assert [[one_line(text) for text in row] for row in found.tables[0]] == [
        ["one", "two"],
        [one_line(cell), one_line(name)],
        [one_line(paragraph), "end"],
    ]


# --- completion, of the command line's parser


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The script for bash, in a folder with some files."""
    done = run("completion", "bash")
    assert (done.code, done.err) == (0, "")
    folder = tmp_path_factory.mktemp("completion")
    for name in ("car.toml", "car.dbc", "car.bin"):
        (folder / name).touch()
    (folder / "script.bash").write_bytes(done.data)
    return folder / "script.bash"


ASKED = r"""
    source "$0"
    function=$(complete -p kontronik-can-gw | sed 's/.*-F \([^ ]*\).*/\1/')
    COMP_WORDS=(kontronik-can-gw $1); COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); COMP_LINE="kontronik-can-gw $1"; COMP_POINT=${#COMP_LINE}
    "$function" kontronik-can-gw "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD-1]}"
    printf '%s\n' "${COMPREPLY[@]}"
"""


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("des", {"describe"}),
        ("service st", {"status"}),
        ("service status --l", {"--lines"}),
        ("describe --dbc car.dbc --format j", {"json"}),
        ("describe --dbc car", {"car.dbc"}),
        ("run -c car", {"car.toml"}),
        ("decode car", {"car.toml", "car.dbc", "car.bin"}),
    ],
)
def test_bash_completes_commands_options_choices_and_files_of_the_right_kind(
    script: Path, typed: str, offered: set[str]
) -> None:
    command = ["bash", "--norc", "-c", ASKED, str(script), typed]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=True, cwd=script.parent
    )
    assert set(done.stdout.split()) == offered


@pytest.mark.parametrize("shell", ["bash", "zsh", "tcsh"])
def test_there_is_a_script_for_each_shell(shell: str) -> None:
    done = run("completion", shell)
    assert (done.code, done.err) == (0, "")
    assert all(command in done.out for command in COMMANDS)
    if interpreter := shutil.which(shell):
        subprocess.run([interpreter, "-n"], input=done.data, check=True, timeout=60)
