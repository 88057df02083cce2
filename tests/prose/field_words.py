"""Finds words of our own in prose that the field has a term for.

    python tests/prose/field_words.py [PATH ...]

Prose is every comment, docstring and text of a message, every paragraph of Markdown, and the texts
in TOML files. Names of signals, keys, metrics, topics and fields in `code` are left out.
"""

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from plain_english import PROJECT, Measure, prose_of, source_files


class Term(NamedTuple):
    """A word of our own, as a pattern, and the term of the field."""

    old: re.Pattern[str]
    term: str
    folders: tuple[str, ...] = ("",)
    """The pattern applies below these folders only."""


def _term(old: str, term: str, *folders: str) -> Term:
    return Term(re.compile(old, re.IGNORECASE), term, folders or ("",))


_TURN = (
    r"\bturns? of (?:its|the|a) (?:main )?loop\b|\bloop turns\b"
    r"|\b(?:turns|a turn) in (?:C|Python)\b"
    r"|\b(?:in|of|during) (?:a|one|the|that|this|each|every|several|many) turns?\b"
    r"|\b(?:same|last|first|late|whole) turns?\b|\bmakes (?:a turn|turns)\b"
)
_DBC_FOLDERS = tuple(
    f"{top}/{name}"
    for top in ("kontronik_can_gw", "tests")
    for name in ("core", "dbc", "signals", "native", "gateway", "proofs")
)
_PAGE = r"(?<![\w.>])(?<!struct )(?<!page )(?<!This )pages?\b(?!:)"
_DELAYS = r"(?:longest|median|mean|shortest) delay|\bdelays? of (?:the )?\d+ ?%"
_PAGES = tuple(str(path.relative_to(PROJECT)) for path in (PROJECT / "docs").glob("*.md"))
TERMS = (
    _term(r"\bSDO answer", "SDO response"),
    _term(r"\btime-outs?\b", "timeout"),
    _term(r"(?<!transmission )\btype 25[45]\b", "transmission type 254"),
    _term(r"\bminimum distance", "minimum delay time (DBC), inhibit time (PDO)"),
    _term(r"\b(?:output )?opening of the output\b|\boutput opening\b", "duty cycle"),
    _term(_PAGE, "multiplexer value, multiplexed group", *_DBC_FOLDERS),
    _term(r"\bpages? of (?:an? |the )?(?:multiplexed )?messages?\b", "multiplexer value"),
    Term(re.compile(r"\b[Dd]ata ids?\b"), "data ID"),
    _term(r"(?<!data ID )\blist of 16\b(?! with)", "data ID list"),
    _term(r"\btransfer numbers?\b|\bnumbers? of transfers\b", "transfer ID"),
    _term(r"\ballocators?\b", "node-ID allocation server"),
    _term(r"\bin front of the driver\b", "socket queue, TX queue (qdisc), driver queue"),
    _term(r"\b99 ?%", "p99"),
    _term(_DELAYS, "latency, maximum", "docs", "tests/benchmarks"),
    _term(_TURN, "iteration"),
    _term(r"\bloss(?:es)? of power\b", "power loss"),
    _term(r"\bparcels?\b", "support bundle"),
    _term(r"\b(?:the|of a|by the|vendor's) sheets?\b", "protocol specification"),
    _term(r"\bobvious (?:program|gateway|one)\b", "baseline program"),
    _term(r"\b(?:the|an|its|their|missed) aims?\b|\baims? (?:is|are|was)\b", "target"),
    _term(r"\b1/min\b", "rpm", "README.md", *_PAGES, "examples"),
    _term(r"\bhalves (?:are )?(?:rounded )?(?:up|down)\b", "round half up"),
    _term(r"\btroubles?\b", "fault"),
)
LEFT_OUT = frozenset(
    {
        "docs/reference/conformance.md",  # written by make conformance
        "docs/reference/objects.md",  # has the names of the EDS
        "tests/prose/field_words.py",
        "tests/prose/test_field_words.py",
    }
)
WITH_CODE_SPANS = re.compile(r"``[^`]*``|`[^`]*`|\"\"|\[[^\]]*\]\([^)]*\)|#[\w-]+")


class Found(NamedTuple):
    """A word of our own at a line of a file."""

    path: str
    line: int
    word: str
    term: str

    def __str__(self) -> str:
        return f'{self.path}:{self.line}: "{self.word}". Write: {self.term}.'


def find(paths: list[str]) -> Iterator[Found]:
    """Yield the old words of these files and folders, relative to the project."""
    for path in _files(paths):
        if str(path) not in LEFT_OUT:
            text = (PROJECT / path).read_text(encoding="utf-8")
            yield from find_in_text(text, path)


def _files(paths: list[str]) -> list[Path]:
    chosen = [(PROJECT / path).resolve() for path in paths]
    texts = [path for path in PROJECT.rglob("*.toml") if path.name != "golden.toml"]
    found = source_files(paths)
    for path in sorted(texts):
        relative = path.relative_to(PROJECT)
        if any(part.startswith(".") for part in relative.parts):
            continue
        if any(path.is_relative_to(each) for each in chosen):
            found.append(relative)
    return found


def find_in_text(text: str, path: Path) -> Iterator[Found]:
    """Yield the old words of a text. Its kind and the terms that apply follow from its path."""
    terms = [term for term in TERMS if str(path).startswith(term.folders)]
    for number, line in sorted(set(_prose(text, path.suffix))):
        plain = WITH_CODE_SPANS.sub(" x ", line)
        for term in terms:
            for match in term.old.finditer(plain):
                yield Found(str(path), number, match[0], term.term)


def _prose(text: str, suffix: str) -> Iterator[tuple[int, str]]:
    """Yield each line of prose with its number. Messages count as prose."""
    if suffix == ".toml":
        yield from _toml_texts(text)
        return
    yield from prose_of(text, suffix, Measure())
    if suffix == ".py":
        yield from _messages(text)


def _messages(source: str) -> Iterator[tuple[int, str]]:
    """Yield the texts of several words in a Python file, except docstrings."""
    nodes = list(ast.walk(ast.parse(source)))
    docstrings = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    for node in nodes:
        match node:
            case ast.Constant(value=str(text)) if id(node) not in docstrings:
                words = text.split()
                if len(words) > 2:
                    yield node.lineno, " ".join(words)


def _toml_texts(source: str) -> Iterator[tuple[int, str]]:
    """Yield the comments and the texts of several words of a TOML file."""
    tomllib.loads(source)
    for number, line in enumerate(source.split("\n"), 1):
        comment = line.partition("#")[2]
        texts = re.findall(r'"([^"]+ [^"]+ [^"]+)"', line)
        yield from ((number, part) for part in (comment, *texts) if part)


if __name__ == "__main__":
    for each in find(sys.argv[1:] or ["."]):
        print(each)
