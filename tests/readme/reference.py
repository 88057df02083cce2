"""The pages of docs/reference, made from their sources, for ``make docs``."""

import re
from argparse import SUPPRESS
from collections.abc import Iterable, Iterator
from importlib import import_module
from pathlib import Path

import promises

from kontronik_can_gw.canopen.setup import shipped_canopen
from kontronik_can_gw.cli import COMMANDS
from kontronik_can_gw.cli.arguments import Option, Rows
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.describe.canopen_tables import emergencies, objects
from kontronik_can_gw.desk.describe.markdown import Code, MarkdownTable, Row, markdown
from kontronik_can_gw.desk.describe.tables import configuration, dbc, values
from kontronik_can_gw.desk.recordings.layouts import layout_of_dbc

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "reference"
LEAD = "Made by make docs: change the sources, not this page."


def pages() -> Iterator[tuple[str, str]]:
    """Yield the name and the text of each page."""
    bus = layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))
    canopen = shipped_canopen([1])
    made = {
        "configuration": ("Configuration", configuration()),
        "dbc": ("The shipped DBC", dbc(bus, bus.escs)),
        "objects": ("CANopen objects of the shipped EDS", objects(canopen, bus.escs)),
        "emergencies": ("CANopen emergencies", emergencies(canopen.eds, bus.escs)),
        "values": ("Values, errors and states", values(bus.escs)),
        "commands": ("Commands", list(_commands())),
    }
    for name, (title, tables) in made.items():
        yield f"{name}.md", markdown(title, [LEAD], tables)


def _commands() -> Iterator[MarkdownTable]:
    for name, line in COMMANDS.items():
        module = import_module(f"kontronik_can_gw.cli.{name}")
        parts = module.EPILOG.strip().split("\n\n")
        text = [_code_or_text(part) for part in parts]
        yield MarkdownTable(name, [_sentence(line), *text], list(_options(module.OPTIONS)))
        for action, (about, options) in getattr(module, "ACTIONS", {}).items():
            yield MarkdownTable(f"{name} {action}", [_sentence(about)], list(_options(options)))


def _code_or_text(part: str) -> Code | str:
    """Return a paragraph of help as code if it has columns or an indent."""
    if re.search(r"^  |   ", part, re.MULTILINE):
        return Code(part)
    return part


def _sentence(line: str) -> str:
    """Return a line of help as ``--help`` of its command shows it."""
    return f"{line[:1].upper()}{line[1:]}."


def _options(rows: Rows) -> Iterable[Row]:
    for row in rows:
        if isinstance(row, Option):
            if row.settings["help"] is SUPPRESS:
                continue
            typed = ", ".join(row.names)
            value = row.settings.get("metavar")
            if value:
                typed = f"{typed} {value}" if typed.startswith("-") else value
            yield {
                "option": typed,
                "choices": list(row.settings.get("choices") or ()),
                "required": bool(row.settings.get("required")),
                "meaning": row.settings["help"].replace("%%", "%"),
            }
        elif not isinstance(row, str):
            yield from _options(row)


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name, text in pages():
        (FOLDER / name).write_text(text, encoding="utf-8")
    promises.PAGE.write_text(promises.promises_page(), encoding="utf-8")
