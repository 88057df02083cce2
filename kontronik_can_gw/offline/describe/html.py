"""A document as one HTML page: nothing is fetched, it works without script; a script only adds the search."""

import re
from base64 import b64encode
from collections.abc import Iterator
from hashlib import sha256
from html import escape

from kontronik_can_gw.offline.describe.document import Code, Document, Section, Table

_STYLE = """
:root { color-scheme: light dark; --ground: #fff; --text: #1a1c1f; --soft: #5b6470; --line: #d5dae1; --band: #f3f5f8; --link: #0b57a4; }
@media (prefers-color-scheme: dark) {
  :root { --ground: #14171b; --text: #e4e7eb; --soft: #9aa4b1; --line: #343b44; --band: #1d2127; --link: #7db7f2; }
}
* { box-sizing: border-box; }
html { scroll-padding-top: 4rem; }
body { margin: 0 auto; padding: 1rem; max-width: 90rem; background: var(--ground); color: var(--text);
  font: 16px/1.5 system-ui, sans-serif; overflow-wrap: break-word; }
h1 { font-size: 1.6rem; line-height: 1.25; }
h2 { margin: 2.5rem 0 .5rem; padding-bottom: .25rem; border-bottom: 2px solid var(--line); font-size: 1.35rem; }
h3 { margin: 1.75rem 0 .5rem; font-size: 1.1rem; }
a { color: var(--link); }
p { max-width: 60rem; }
.lead { margin: .15rem 0; color: var(--soft); }
nav { margin: 1.25rem 0; padding: .5rem 1rem; background: var(--band); border-radius: .5rem; }
nav ul { margin: .25rem 0; padding-left: 1.2rem; }
nav ul ul { padding: 0; font-size: .9rem; }
nav ul ul li { display: inline-block; margin-right: .9rem; }
#search { position: sticky; top: 0; z-index: 1; padding: .5rem 0; background: var(--ground); }
#search input { width: 100%; padding: .5rem .75rem; border: 1px solid var(--line); border-radius: .5rem; background: var(--band);
  color: inherit; font: inherit; }
table { width: 100%; margin: .75rem 0; border-collapse: collapse; font-size: .9rem; }
th, td { padding: .35rem .6rem; border-bottom: 1px solid var(--line); text-align: left; vertical-align: top; }
th { background: var(--band); font-weight: 600; }
td { min-width: 3.5rem; }
code { font: .92em ui-monospace, monospace; }
summary { color: var(--soft); font-size: .9rem; cursor: pointer; }
[hidden] { display: none !important; }
@media screen and (max-width: 60rem) {
  thead { position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%); }
  table, tbody, tr, td { display: block; }
  tr { margin: .6rem 0; padding: .4rem .6rem; border: 1px solid var(--line); border-radius: .5rem; }
  td { display: grid; grid-template-columns: minmax(5.5rem, 26%) 1fr; gap: .6rem; padding: .15rem 0; border: 0; }
  td::before { content: attr(data-label); color: var(--soft); }
  td:empty { display: none; }
}
@media print {
  :root { color-scheme: light; --ground: #fff; --text: #000; --soft: #444; --line: #999; --band: #eee; --link: #000; }
  html { font-size: 9pt; }
  body { max-width: none; padding: 0; font-size: 1rem; }
  #search, nav summary { display: none; }
  table { font-size: 8pt; }
  th, td { padding: .15rem .3rem; }
  td { min-width: 0; }
  a { text-decoration: none; }
  h2, h3 { break-after: avoid; }
  thead { display: table-header-group; }
  tr { break-inside: avoid; }
}
"""
_SCRIPT = """
const box = document.querySelector("#search"), input = box.querySelector("input");
const sections = [...document.querySelectorAll("section")].map(part => ({
  part, head: part.querySelector("h2, h3").textContent.toLowerCase(), rows: [...part.querySelectorAll(":scope > table > tbody > tr")] }));
const texts = new Map(sections.flatMap(({ rows }) => rows).map(row => [row, row.textContent.toLowerCase()]));
function search() {
  const words = input.value.toLowerCase().split(/\\s+/).filter(Boolean);
  const has = text => words.every(word => text.includes(word));
  for (const { part, head, rows } of sections) {
    let shown = has(head);
    const all = shown;
    for (const row of rows) {
      row.hidden = !all && !has(texts.get(row));
      shown ||= !row.hidden;
    }
    for (const table of part.querySelectorAll(":scope > table")) table.hidden = !table.querySelector("tbody > tr:not([hidden])");
    part.hidden = words.length > 0 && !shown;
  }
}
box.hidden = false;
input.addEventListener("input", search);
search();
"""


_BREAK = re.compile(r"(?<=_)(?=\w)|(?<=[a-z])(?=[A-Z])|(?<=\.)(?=\w)")
"""Where a long name may go on in the next line."""
_MOST_OPEN = 20


def html(document: Document) -> str:
    """The page."""
    return "\n".join(_lines(document)) + "\n"


def _lines(document: Document) -> Iterator[str]:
    title = escape(document.title)
    yield '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">'
    yield f'<meta http-equiv="Content-Security-Policy" content="{_policy()}">'
    yield '<meta name="viewport" content="width=device-width, initial-scale=1">'
    yield f"<title>{title}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n<h1>{title}</h1>"
    yield from (f'<p class="lead">{escape(line)}</p>' for line in document.lead)
    yield from _contents(document)
    yield (
        '<div id="search" hidden><input type="search" aria-label="Search" placeholder="Search: name, meaning, id" autocomplete="off"></div>'
    )
    yield "<main>"
    for section in document.sections:
        yield from _section(section)
    yield f"</main>\n<script>{_SCRIPT}</script>\n</body>\n</html>"


def _policy() -> str:
    """Nothing is fetched, and no script runs but ours: whatever a DBC brings in."""
    digest = b64encode(sha256(_SCRIPT.encode()).digest()).decode()
    return f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"


def _contents(document: Document) -> Iterator[str]:
    """Chapters, each with its parts, which are folded away where they are many."""
    yield '<nav aria-label="Contents">\n<ul>'
    chapters: list[tuple[Section, list[Section]]] = []
    for section in document.sections:
        if section.level == 2:
            chapters.append((section, []))
        else:
            chapters[-1][1].append(section)
    for chapter, parts in chapters:
        yield f"<li>{_link(chapter)}"
        if parts:
            links = "".join(f"<li>{_link(part)}</li>" for part in parts)
            unfolded = " open" if len(parts) <= _MOST_OPEN else ""
            yield f"<details{unfolded}><summary>{len(parts)} part{'s' * (len(parts) > 1)}</summary><ul>{links}</ul></details>"
        yield "</li>"
    yield "</ul>\n</nav>"


def _link(section: Section) -> str:
    return f'<a href="#{escape(section.anchor)}">{escape(section.title)}</a>'


def _section(section: Section) -> Iterator[str]:
    yield f'<section id="{escape(section.anchor)}">'
    yield f"<h{section.level}>{escape(section.title)}</h{section.level}>"
    for block in section.blocks:
        if isinstance(block, Table):
            yield from _table(block)
        else:
            yield f"<p>{escape(block)}</p>"
    yield "</section>"


def _table(table: Table) -> Iterator[str]:
    yield (
        "<table>\n<thead><tr>"
        + "".join(f'<th scope="col">{escape(name)}</th>' for name in table.head)
        + "</tr></thead>"
    )
    yield "<tbody>"
    for row in table.rows:
        cells = (
            f'<td data-label="{escape(name)}">{_cell(cell)}</td>' for name, cell in zip(table.head, row, strict=True)
        )
        yield f"<tr>{''.join(cells)}</tr>"
    yield "</tbody>\n</table>"


def _cell(content: str) -> str:
    return f"<code>{_BREAK.sub('<wbr>', escape(content))}</code>" if isinstance(content, Code) else escape(content)
