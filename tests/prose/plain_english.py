"""Measures how plain the project's English is and how dense its code is.

    python tests/prose/plain_english.py                      figures of each group
    python tests/prose/plain_english.py --hits [PATH ...]    every pattern, with file and line
    python tests/prose/plain_english.py --worst 12           files with most patterns per 1000 words

Three groups are measured: the product (Python and C below `kontronik_can_gw`), the tests (also the
Debian packaging and the build hook) and the docs (Markdown). Prose is every
comment, every docstring and every paragraph of Markdown. The patterns mark phrases that make
readers stop. They find places to read again, not mistakes: a few hits are good English.
"""

import argparse
import ast
import io
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2]
FOLDERS = ("kontronik_can_gw", "tests", "deb", "docs", "examples", "dbc", "eds")
SUFFIXES = {".py", ".c", ".h", ".md"}
MAX_COLUMNS = 100
"""Longest line of prose. Tables are exempt."""
MIN_WORDS = 60
"""Files with less prose are not ranked."""

PATTERNS = {
    "what-as-noun": re.compile(
        r"\b[Ww]hat (?:is|was|has|have|had|comes|came|come|waits|waited|they|it|we|follows|holds"
        r"|others|only|an?|the|no|nobody|must|may|can|needs|happens|happened|this|these|does|did"
        r"|goes|stands|belongs|concerns|there)\b"
    ),
    "that-of": re.compile(
        r"\b(?:[Tt]hat|[Tt]hose) (?:of|that|which)\b|\bof (?:which|what|whom)\b"
        r"|\bwith (?:which|what)\b|\bby (?:which|what)\b"
        r"|\bin (?:which|what)\b(?= (?:is|are|was|it|the|a|they))"
    ),
    "where-for-if": re.compile(
        r"\b[Ww]here (?:it|that|there|nothing|one|none|no|not|a|an|the|they|this|both|such|needed"
        r"|possible)\b"
    ),
    "fragment-of": re.compile(
        r"(?:^|[.:;] )Of (?:a|an|the|all|each|its|those|what|which|one|how)\b"
    ),
    "animated": re.compile(
        r"\b(?:come|comes|came|coming|goes|went|gone|say|says|said|speak|speaks|spoke|tells?|told"
        r"|knows?|stands?|stood|belongs?|wants?|lives?)\b"
    ),
    "nobody-none": re.compile(
        r"\b(?:[Nn]obody|[Ss]omebody|[Nn]one of|is none|is no|are no|[Ww]hoever|[Ww]homever"
        r"|whose is)\b"
    ),
    "but-for": re.compile(
        r"\b(?:[Bb]ut for|for there|as far as|so long|so that nobody|at the latest|by now|anew"
        r"|as a rule|no more\b(?! than)|any more|once more|of its own|of their own|in words"
        r"|a moment ago|gives way|is over|stays away|the last word|besides|from now on|from then on"
        r"|from there on|holds true|in front of|looked at|looks at)\b"
    ),
}
_WORD = re.compile(r"[A-Za-z][A-Za-z'-]+")
_C_COMMENT = re.compile(r"/\*(?P<block>.*?)\*/|//(?P<line>[^\n]*)", re.DOTALL)
_INLINE_CODE = re.compile(r"`[^`]*`|\([^)]*://[^)]*\)")
_LINK_TARGET = re.compile(r"\]\([^)]*\)")
_LAYOUT_TOKENS = {
    tokenize.NEWLINE,
    tokenize.NL,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}
_FSTRING_START = "FSTRING_START"
_FSTRING_END = "FSTRING_END"
"""Python 3.12 splits an f-string into several tokens. It is counted as one, as in Python 3.11."""


@dataclass
class Measure:
    """Counts of one file or of several added up."""

    words: int = 0
    patterns: Counter[str] = field(default_factory=Counter)
    tokens: int = 0
    code_lines: int = 0
    conditional_expressions: int = 0
    tuple_assignments: int = 0
    starred_literals: int = 0
    """Calls such as f(*(a, b), *(c, d))."""
    long_lines: int = 0
    """Lines of prose longer than MAX_COLUMNS."""

    def add(self, other: "Measure") -> None:
        """Add another file's counts."""
        self.words += other.words
        self.patterns += other.patterns
        self.tokens += other.tokens
        self.code_lines += other.code_lines
        self.conditional_expressions += other.conditional_expressions
        self.tuple_assignments += other.tuple_assignments
        self.starred_literals += other.starred_literals
        self.long_lines += other.long_lines

    def figures(self) -> dict[str, float]:
        """Return the figures that the limits refer to.

        Patterns are per 1000 words, expressions and assignments per 1000 lines of code. Starred
        literals and long lines are counts.
        """
        words = max(1, self.words)
        found = {"all patterns": 1000 * self.patterns.total() / words}
        for name in PATTERNS:
            found[name] = 1000 * self.patterns[name] / words
        found["lines over 100 columns"] = self.long_lines
        if self.code_lines:
            found["tokens a code line"] = self.tokens / self.code_lines
            per_1000 = 1000 / self.code_lines
            found["conditional expressions"] = per_1000 * self.conditional_expressions
            found["tuple assignments"] = per_1000 * self.tuple_assignments
            found["starred literals"] = self.starred_literals
        return found


@dataclass(frozen=True)
class Hit:
    """One phrase that matches a pattern."""

    line: int
    pattern: str
    text: str


def source_files(paths: list[str]) -> list[Path]:
    """Return the Python, C and Markdown files of the project, relative to its folder.

    Folders that tests and tools fill (names that begin with a dot) and other people's files are
    left out. ``paths`` restricts the result to these files and folders.
    """
    chosen = [(PROJECT / path).resolve() for path in paths]
    candidates = list(PROJECT.glob("*.*"))
    for folder in FOLDERS:
        candidates += (PROJECT / folder).rglob("*.*")
    found = []
    for path in sorted(candidates):
        relative = path.relative_to(PROJECT)
        is_left_out = any(part.startswith(".") or part == "vendor" for part in relative.parts)
        is_chosen = any(path.is_relative_to(each) for each in chosen)
        if path.suffix in SUFFIXES and is_chosen and not is_left_out:
            found.append(relative)
    return found


def group_of(path: Path) -> str:
    """Return "docs", "tests" or "product"."""
    if path.suffix == ".md":
        return "docs"
    if path.parts[0] == "kontronik_can_gw":
        return "product"
    return "tests"


def measure_file(path: Path) -> tuple[Measure, list[Hit]]:
    """Count one file. The path is relative to the project."""
    source = (PROJECT / path).read_text(encoding="utf-8")
    return measure_text(source, path.suffix)


def measure_text(source: str, suffix: str) -> tuple[Measure, list[Hit]]:
    """Count a text whose kind follows from its suffix: .py, .c, .h or .md."""
    measure = Measure()
    prose = prose_of(source, suffix, measure)
    if suffix == ".md":
        measure.long_lines = _long_markdown_lines(source)
    elif suffix != ".py":
        lines = source.split("\n")
        numbers = {number for number, _ in prose}
        measure.long_lines = sum(len(lines[number - 1]) > MAX_COLUMNS for number in numbers)
    hits = []
    for number, line in prose:
        measure.words += len(_WORD.findall(line))
        for name, pattern in PATTERNS.items():
            for _ in pattern.finditer(line):
                measure.patterns[name] += 1
                hits.append(Hit(number, name, line.strip()))
    return measure, hits


def prose_of(source: str, suffix: str, measure: Measure) -> list[tuple[int, str]]:
    """Return the lines of prose of a text, each with its number. Counts the code of Python."""
    if suffix == ".py":
        return _count_python(source, measure)
    return _markdown_prose(source) if suffix == ".md" else _c_prose(source)


def _count_python(source: str, measure: Measure) -> list[tuple[int, str]]:
    """Count the code of a Python file and return its lines of prose, each with its number."""
    prose: list[tuple[int, str]] = []
    code_lines: set[int] = set()
    is_statement_start = True
    fstring_depth = 0
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        name = tokenize.tok_name[token.type]
        if name == _FSTRING_END:
            fstring_depth -= 1
        is_inside_fstring = fstring_depth > 0 or name == _FSTRING_END
        if name == _FSTRING_START:
            fstring_depth += 1
        if is_inside_fstring:
            continue
        if token.type == tokenize.COMMENT:
            prose.append((token.start[0], token.string.lstrip("#:! ")))
        elif token.type in _LAYOUT_TOKENS:
            if token.type in (tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT):
                is_statement_start = True
        elif token.type == tokenize.STRING and is_statement_start:
            parts = token.string.strip("rbuRBU\"'").split("\n")
            prose += enumerate(parts, token.start[0])
            is_statement_start = False
        else:
            measure.tokens += 1
            code_lines.add(token.start[0])
            is_statement_start = False
    measure.code_lines = len(code_lines)
    _count_expressions(ast.parse(source), measure)
    lines = source.split("\n")
    numbers = {number for number, _ in prose}
    measure.long_lines = sum(len(lines[number - 1]) > MAX_COLUMNS for number in numbers)
    return prose


def _count_expressions(tree: ast.Module, measure: Measure) -> None:
    """Count the expressions that pack several thoughts into one line."""
    for node in ast.walk(tree):
        if isinstance(node, ast.IfExp):
            measure.conditional_expressions += 1
        elif isinstance(node, ast.Assign):
            is_tuple = isinstance(node.targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple)
            measure.tuple_assignments += is_tuple
        elif isinstance(node, ast.Call):
            starred = [each for each in node.args if isinstance(each, ast.Starred)]
            is_literal = any(isinstance(each.value, ast.Tuple) for each in starred)
            measure.starred_literals += is_literal


def _c_prose(source: str) -> list[tuple[int, str]]:
    """Return the lines of comments of a C file, each with its number."""
    prose: list[tuple[int, str]] = []
    for match in _C_COMMENT.finditer(source):
        first = source.count("\n", 0, match.start()) + 1
        comment = match["block"] or match["line"] or ""
        parts = (part.strip(" *") for part in comment.split("\n"))
        prose += enumerate(parts, first)
    return prose


def _markdown_lines(source: str) -> Iterator[tuple[int, str]]:
    """Yield the lines of a Markdown file that are not inside a block of code."""
    is_code = False
    for number, line in enumerate(source.split("\n"), 1):
        if line.lstrip().startswith(("```", "~~~")):
            is_code = not is_code
        elif not is_code and not line.startswith("    "):
            yield number, line


def _markdown_prose(source: str) -> list[tuple[int, str]]:
    """Return the lines of a Markdown file without code, each with its number."""
    return [(number, _INLINE_CODE.sub(" x ", line)) for number, line in _markdown_lines(source)]


def _long_markdown_lines(source: str) -> int:
    """Count lines that are too long. Tables, headings and the targets of links do not count."""
    count = 0
    for _, line in _markdown_lines(source):
        is_exempt = line.lstrip().startswith(("|", "#", "!["))
        text = _LINK_TARGET.sub("]", line)
        count += not is_exempt and len(text) > MAX_COLUMNS
    return count


def measure_groups(paths: list[str]) -> dict[str, Measure]:
    """Return the counts of each group, added up over its files."""
    groups: dict[str, Measure] = {}
    for path in source_files(paths):
        measure, _ = measure_file(path)
        groups.setdefault(group_of(path), Measure()).add(measure)
    return groups


def _print_hits(paths: list[str]) -> None:
    for path in source_files(paths):
        for hit in measure_file(path)[1]:
            print(f"{path}:{hit.line}: {hit.pattern}: {hit.text}")


def _print_worst(paths: list[str], count: int) -> None:
    ranked = []
    for path in source_files(paths):
        measure, _ = measure_file(path)
        if measure.words >= MIN_WORDS:
            rate = 1000 * measure.patterns.total() / measure.words
            ranked.append((rate, str(path)))
    for rate, name in sorted(ranked, reverse=True)[:count]:
        print(f"{rate:6.1f} per 1000 words: {name}")


def main() -> int:
    """Print what the options ask for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hits", action="store_true", help="print every pattern found")
    parser.add_argument("--worst", type=int, metavar="N", help="rank the files")
    parser.add_argument("paths", nargs="*", default=["."], help="default: the whole project")
    args = parser.parse_args()
    if args.hits:
        _print_hits(args.paths)
    if args.worst:
        _print_worst(args.paths, args.worst)
    if not args.hits and not args.worst:
        for group, measure in sorted(measure_groups(args.paths).items()):
            print(f"{group}: {measure.words} words, {measure.code_lines} lines of code")
            for name, value in measure.figures().items():
                print(f"    {name}: {value:.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
