"""Markdown and HTML hold everything, and whatever is in a DBC or EDS is shown as text. Read back by parsers that know nothing of us."""

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import pytest
from described import NASTY, NASTY_NAME, NASTY_UNIT, TWO_ESCS, configuration, described, nasty
from hypothesis import example, given
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from kontronik_can_gw.offline.describe.document import Code, Document, Section, Table
from kontronik_can_gw.offline.describe.html import html
from kontronik_can_gw.offline.describe.markdown import markdown
from kontronik_can_gw.protocol.states import OperatingError, OperatingState, SelfTestError

_VOID = {"meta", "wbr", "input", "br"}
_CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
Rows = list[list[str]]


class Page(HTMLParser):
    """Titles, paragraphs and tables of a page, with every mistake in its tags."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.mistakes: list[str] = []
        self.tags: dict[str, int] = {}
        self.titles: list[str] = []
        self.paragraphs: list[str] = []
        self.tables: list[Rows] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.attributes: set[str] = set()
        self._text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] = self.tags.get(tag, 0) + 1
        self.attributes |= {name for name, _ in attrs}
        values = {name: value or "" for name, value in attrs}
        if "id" in values:
            self.ids.append(values["id"])
        if tag == "a":
            self.links.append(values["href"])
        if tag not in _VOID:
            self.open.append(tag)
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in ("td", "th", "p", "h1", "h2", "h3"):
            self._text = ""

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open[-1] != tag:
            self.mistakes.append(f"</{tag}> in {self.open[-2:]}")
            return
        self.open.pop()
        if tag in ("td", "th"):
            self.tables[-1][-1].append(self._text)
        if tag == "p":
            self.paragraphs.append(self._text)
        if tag in ("h1", "h2", "h3"):
            self.titles.append(self._text)

    def handle_data(self, data: str) -> None:
        self._text += data


def page(text: str) -> Page:
    found = Page()
    found.feed(text)
    found.close()
    assert found.mistakes == []
    assert found.open == []
    return found


def read_markdown(text: str) -> Page:
    """Markdown as markdown-it makes HTML of it; nothing that is HTML in the source may come through."""
    parser = MarkdownIt("commonmark").enable("table").enable("strikethrough")
    tokens = parser.parse(text)
    raw = [t.content for token in tokens for t in (token, *(token.children or ())) if t.type.startswith("html")]
    assert set(raw) <= {"<!-- -->"}
    return page(parser.render(text).replace("<!-- -->", ""))


def one_line(text: str) -> str:
    return " ".join(text.split())


# --- content


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


@pytest.mark.parametrize("kind", ["md", "html"])
def test_each_message_signal_object_error_and_state_is_in_the_document(kind: str) -> None:
    found = (read_markdown if kind == "md" else page)(described("--format", kind))
    cells = {cell for table in found.tables for row in table for cell in row}
    facts = json.loads(described("--format", "json"))
    for message in facts["dbc"]["messages"]:
        assert f"{message['name']} {message['id']:03X}h" in found.titles
        assert {signal["name"] for signal in message["signals"]} <= cells
    for item in facts["canopen"]["objects"]:
        assert f"{item['index']:04X}h {item['name']}" in found.titles
        assert {entry["name"] for entry in item["entries"]} <= cells
    for bit in (*OperatingError, *SelfTestError):
        assert any(
            row[:1] == [str(int(bit))] and row[1:] == [bit.text, bit.severity.value, bit.meaning, bit.remedy]
            for row in rows(found)
        )
    for state in OperatingState:
        assert [str(int(state)), state.text, state.meaning, state.remedy] in rows(found)
    for emergency in facts["canopen"]["emergencies"]:
        assert any(row[0] == f"{emergency['code']:04X}h" and emergency["remedy"] in row for row in rows(found))
    whole = "\n".join([*found.titles, *found.paragraphs, *sorted(cells)])
    del facts["sources"]  # those that only objects show are with the objects
    for text in everything(facts):
        assert one_line(text) in whole, text


def rows(found: Page) -> Rows:
    return [row for table in found.tables for row in table]


def test_a_row_says_what_a_signal_needs() -> None:
    found = read_markdown(described())
    row = next(row for row in rows(found) if row[0] == "BatteryVoltage" and row[2] == "V")
    assert row[1:] == [
        *("24+16 unsigned", "V", "0.01", "0 … 655.33", "65535 (FFFFh), 65534 (FFFEh)", "battery_voltage"),
        "Battery voltage at the ESC.",
    ]
    state = next(row for row in rows(found) if row[0] == "OperatingState")
    assert "12 MotorOff, 13 StandBy" in state[-1]
    temperature = next(row for row in rows(found) if row[0] == "PowerStageTemperature")
    assert temperature[5] == "-128 (80h), -127 (81h)"
    voltage = next(row for row in rows(found) if row[:2] == ["02", "Battery voltage"])
    assert voltage[2:9] == ["UNSIGNED16", "ro", "yes", "", "", "0.01 V", "battery_voltage"]
    cob_id = next(row for row in rows(found) if row[1] == "TPDO 1 COB-ID")
    assert cob_id[5] == "$NODEID + 40000180h"


def test_of_two_escs_a_source_is_told_with_its_esc(tmp_path: Path) -> None:
    found = read_markdown(described("-c", configuration(tmp_path, TWO_ESCS)))
    sources = {row[6] for row in rows(found) if len(row) == 8}
    assert {"left.battery_voltage", "right.battery_voltage", "uptime"} <= sources
    assert {"Node 20 (left)", "Node 21 (right)"} <= set(found.titles)


@pytest.mark.parametrize("kind", ["md", "html"])
def test_each_link_of_the_contents_leads_to_one_place(kind: str) -> None:
    text = described("--format", kind)
    found = (read_markdown if kind == "md" else page)(text)
    targets = [link.removeprefix("#") for link in found.links]
    assert len(targets) > 10
    assert all(link.startswith("#") for link in found.links)
    if kind == "html":
        assert len(set(found.ids)) == len(found.ids)
        assert set(targets) <= set(found.ids)
    else:  # as GitHub makes anchors
        anchors = [re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in found.titles]
        assert len(set(anchors)) == len(anchors)
        assert set(targets) <= set(anchors)


# --- what somebody else wrote


@pytest.mark.parametrize("kind", ["md", "html"])
def test_markup_in_a_dbc_or_eds_is_shown_as_text(tmp_path: Path, kind: str) -> None:
    plain, other = described("--format", kind), described("-c", nasty(tmp_path), "--format", kind)
    read = read_markdown if kind == "md" else page
    expected, found = read(plain), read(other)
    assert set(found.tags) == set(expected.tags)
    assert found.attributes == expected.attributes
    assert found.tags.get("script") == expected.tags.get("script")
    comment = one_line(NASTY.replace("\\", "/"))
    assert comment in found.paragraphs
    cells = {cell for row in rows(found) for cell in row}
    assert comment in cells
    assert any(cell.startswith(f"{comment} second line") for cell in cells)
    assert NASTY_UNIT in cells
    assert f"2000h {NASTY_NAME}" in found.titles
    assert any("13 <i>|Stand</i>" in cell for cell in cells)
    assert any(paragraph.startswith("</table>|<script>") for paragraph in found.paragraphs)
    assert "Foreign" not in " ".join(found.titles)
    for table in found.tables:
        assert {len(row) for row in table} == {len(table[0])}


texts = st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs", "Zl", "Zp"]), max_size=40)
markup = st.text(st.sampled_from("|`*_[]()<>&\\#-+.!~=$:/1a \n\t\"'"), max_size=24)
words = st.one_of(texts, markup)


@given(words, words, words, words)
@example("a|b", "`|`", "``", "www.x.org")
@example("1.", "1) x", "- x", "# x")
@example("#", "x ##", " #", "#")
@example("_a_", "a_b_c", "\\", "\\|")
@example("&lt;", "<!--", "]]>", "***")
def test_any_text_comes_back_as_it_is(title: str, paragraph: str, cell: str, name: str) -> None:
    code = Code(name)
    table = Table(("one", "two"), ((cell, code), (paragraph, "end")))
    blocks = (f"x {paragraph}", table) if not paragraph.strip() else (paragraph, table)
    document = Document("All", ("lead",), (Section(f"T {title}", 2, "t", blocks),))
    for found in (read_markdown(markdown(document)), page(html(document))):
        assert list(map(one_line, found.titles)) == ["All", one_line(f"T {title}")]
        assert one_line(blocks[0] if isinstance(blocks[0], str) else "") in map(one_line, found.paragraphs)
        assert [[one_line(text) for text in row] for row in found.tables[0]] == [
            ["one", "two"],
            [one_line(cell), one_line(name)],
            [one_line(paragraph), "end"],
        ]


# --- the page


def test_the_page_needs_nothing_from_outside_and_no_script_but_its_own() -> None:
    text = described("--format", "html")
    found = page(text)
    assert not found.attributes & {"src", "srcset", "action", "onclick", "onload"}
    assert "url(" not in text
    assert "@import" not in text
    assert not re.search(r"https?://", text)
    assert found.tags["script"] == found.tags["style"] == 1
    for promise in ("prefers-color-scheme: dark", "@media print", 'name="viewport"', "default-src 'none'"):
        assert promise in text


@pytest.mark.extended
@pytest.mark.skipif(_CHROMIUM is None, reason="no Chromium")
@pytest.mark.parametrize("sought", ["", "undervoltage bec", "fff0h0"])
def test_the_search_shows_the_rows_that_hold_every_word(tmp_path: Path, sought: str) -> None:
    """In a browser: the policy lets our script run, and it hides what does not fit."""
    file = tmp_path / "page.html"
    text = described("--format", "html").replace('<input type="search"', f'<input type="search" value="{sought}"')
    file.write_text(text, encoding="utf-8")
    assert _CHROMIUM is not None
    done = subprocess.run(
        [
            *(_CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"),
            *(f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", file.as_uri()),
        ],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    body = done.stdout
    assert '<div id="search">' in body
    shown = [re.sub("<[^>]*>", "", row).lower() for row in re.findall("<tr><td.*?</tr>", body, re.DOTALL)]
    hidden = re.findall('<tr hidden=""><td', body)
    assert len(shown) + len(hidden) == sum(len(table) - 1 for table in page(text).tables)
    assert all(word in row for row in shown for word in sought.split())
    assert {"": len(shown) > 400 and not hidden, "undervoltage bec": 3 < len(shown) < 30, "fff0h0": not shown}[sought]
