"""README.md and docs/ are true: tables are those of the sources, commands exist, links lead somewhere, examples are valid."""

import re
import tomllib
from pathlib import Path

import pytest
from pictures import SHOWN, VIEWS, main
from reference import FOLDER, pages
from report_browser import MISSING, PROGRAM
from shell_blocks import PAGES as BY_HAND

from kontronik_can_gw.cli import COMMANDS
from kontronik_can_gw.config.export import schema
from kontronik_can_gw.config.parse import parse

PROJECT = FOLDER.parents[1]
PAGES = {path: path.read_text(encoding="utf-8") for path in (*BY_HAND, *FOLDER.glob("*.md"))}
README = PAGES[PROJECT / "README.md"]
ALL = "\n".join(PAGES[path] for path in BY_HAND)


def test_the_reference_is_that_of_the_sources() -> None:
    made = {FOLDER / name: text for name, text in pages()}
    found = {path: text for path, text in PAGES.items() if path.parent == FOLDER}
    assert made == found, "run: make docs"


def test_the_reference_has_every_key_of_every_table() -> None:
    rows = set(re.findall(r"^\| (\w+) \|", PAGES[FOLDER / "configuration.md"], re.MULTILINE))
    tables = schema()["properties"].values()
    keys = {
        key
        for table in (table.get("items", table) for table in tables)
        for key, entry in table["properties"].items()
        if "deprecated" not in entry
    }
    assert rows - {"key"} == keys


def anchors(text: str) -> set[str]:
    """Those that a page has, as GitHub makes them of its headings."""
    headings = re.findall(
        r"^#+ (.+)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.MULTILINE
    )
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_links_lead_to_files_and_headings() -> None:
    for path, text in PAGES.items():
        for link in re.findall(r"\]\(([^)]+)\)", text):
            if "://" in link:
                continue
            name, _, anchor = link.partition("#")
            target = (path.parent / name).resolve() if name else path
            assert target.exists(), f"{path.name}: {link}"
            assert not anchor or anchor in anchors(PAGES[target]), f"{path.name}: {link}"


def test_every_page_is_found_from_the_front() -> None:
    linked = {
        (path.parent / link).resolve()
        for path, text in PAGES.items()
        for link in re.findall(r"\]\(([^):#]+\.md)", text)
    }
    assert set(PAGES) - {PROJECT / "README.md"} <= linked
    assert README.count("\n") <= 230


def test_configurations_are_valid() -> None:
    for block in re.findall(r"```toml\n(.*?)```", ALL, re.DOTALL):
        # some show a table alone
        parse({"esc": [{"port": "/dev/ttyUSB0"}]} | tomllib.loads(block), "README.md")


def test_every_command_is_named() -> None:
    assert all(f"`kontronik-can-gw {command}" in README for command in COMMANDS)


def test_every_command_that_is_named_exists() -> None:
    for command in re.findall(r"(?<!-u )kontronik-can-gw ([a-z]+)\b(?! gateway)", ALL):
        assert command in COMMANDS, command


def test_every_make_target_that_is_named_exists() -> None:
    makefile = (PROJECT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"`?make ([a-z]+)", ALL):
        if target not in ("an", "no", "sure"):
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_pages_by_hand_are_short() -> None:
    for path, text in PAGES.items():
        if path.parent == PROJECT / "docs":
            assert text.count("\n") <= 130, path.name


def test_pictures_are_those_that_pages_show_small_and_need_no_server() -> None:
    shown = {
        (path.parent / link).resolve()
        for path, text in PAGES.items()
        for link in re.findall(r"!\[[^]]+\]\(([^)]+)\)", text)
    }
    assert shown == set((PROJECT / "docs/pictures").iterdir())
    assert shown == {PROJECT / "docs/pictures" / name for name in SHOWN}
    for path in shown:
        assert path.stat().st_size < 150_000, path.name
        assert path.suffix == ".png" or "url(http" not in path.read_text(encoding="utf-8")


@pytest.mark.extended
def test_pictures_can_be_made_anew(tmp_path: Path) -> None:
    if PROGRAM is None:
        pytest.skip(MISSING)
    main(tmp_path)
    made = {path.name for path in tmp_path.iterdir()}
    assert made > set(SHOWN) and len(made) == 4 + len(VIEWS)
