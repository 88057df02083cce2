"""Command lines and their results, as text (see README.md).

``play`` runs the command lines of a file and returns it with the current results.
"""

import difflib
import io
import logging
import os
import re
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path

import drive
import meaning
import scenario

HERE = Path(__file__).parent
LINES = 25
"""Most lines of standard error that are recorded."""
SURROUNDINGS = (
    "LISTEN_FDS",
    "NOTIFY_SOCKET",
    "JOURNAL_STREAM",
    "STATE_DIRECTORY",
    "RUNTIME_DIRECTORY",
    "NO_COLOR",
)
"""Environment variables that are removed because they change the output."""
_SHOWN_ONCE = {"configuration", "dcf", "signals"}
"""Forms that are shown whole at their first use in a file, and as changes after that."""
_RESULT = re.compile(r"(\||!|=>) ?")
_WORD = re.compile(r"'([^']*)'|(\S+)")


def cases(text: str) -> dict[str, list[str]]:
    """Return the lines of each case by its title.

    The lines before the first title are found under "".
    """
    found: dict[str, list[str]] = {"": []}
    title = ""
    for line in text.removesuffix("\n").split("\n"):
        if line.startswith("## "):
            title = line[3:]
            assert title not in found, f"two cases are called {title!r}"
        found.setdefault(title, []).append(line)
    return found


class _Shown:
    """Shows the content of outputs. Long forms are shown whole once in a file, then as changes."""

    def __init__(self) -> None:
        self._first: dict[str, list[str]] = {}

    def lines(self, form: str, data: bytes) -> Sequence[str]:
        content = meaning.FORMS[form](data)
        if form not in _SHOWN_ONCE:
            return content
        if form not in self._first:
            self._first[form] = content
            return content
        changes = _changes(self._first[form], content)
        if len(changes) * 2 > len(content):
            return content
        return [f"the first {form} of this file, except {len(changes)} lines", *changes]


def _changes(old: list[str], new: list[str]) -> list[str]:
    """Return the removed lines with "-" and the added ones with "+"."""
    changes = []
    for line in difflib.unified_diff(old, new, n=0, lineterm=""):
        if not line.startswith(("---", "+++", "@@")):
            changes.append(f"{line[0]} {line[1:]}")
    return changes


def play(text: str) -> str:
    """Return the file's text with the current results."""
    out: list[str] = []
    shown = _Shown()
    for lines in cases(text).values():
        with _place() as folder:
            out += _play_case(lines, folder, shown)
    return "\n".join(out) + "\n"


def _play_case(lines: list[str], folder: Path, shown: _Shown) -> Iterator[str]:
    name = ""
    source = ""
    body: list[str] = []
    for line in [*lines, "$"]:
        if line.startswith(("--- ", "$")):
            if name:
                while body and not body[-1]:
                    body.pop()
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).write_bytes(_content(source, body))
            name = ""
            source = ""
            body = []
            if line.startswith("--- "):
                name, _, source = line[4:].partition(" < ")
                yield line
            elif line != "$":
                yield line
                yield from _run(line[2:], folder, shown)
        elif name:
            body.append(line)
            yield line
        elif not _RESULT.match(line):
            yield line


def _content(source: str, body: list[str]) -> bytes:
    """Return the content of a file that a case describes.

    It consists of its lines, of hexadecimal bytes, of the bytes of a flight, or of a file in
    inputs/ or captures/, which may have been edited.
    """
    if not source:
        return ("\n".join(body) + "\n").encode()
    if source == "hex":
        return bytes.fromhex("".join(body))
    if source == "shipped.eds":
        base = drive.shipped_eds().encode("latin-1")
    elif source.startswith("flights/"):
        file, _, esc = source.partition(" ")
        return flight_bytes(HERE / file, int(esc or 1))
    else:
        base = (HERE / source).read_bytes()
    if not body:
        return base
    return _edited(base.decode("latin-1"), body).encode("latin-1")


def flight_bytes(file: Path, esc: int) -> bytes:
    """Return all bytes that an ESC sends in a flight."""
    _, lines = scenario.split(file.read_text(encoding="utf-8"))
    found = b""
    for line in lines:
        words = line.split()
        if words[1:3] == ["uart", str(esc)]:
            found += scenario.uart_bytes(words[3:])
    return found


def _edited(text: str, edits: list[str]) -> str:
    """Apply edits to a text.

    ``@ line`` goes behind the next line with this text, ``- line`` removes the next line with this
    text, and ``+ line`` inserts a line.
    """
    newline = "\r\n" if "\r\n" in text else "\n"
    lines = text.split(newline)
    at = 0
    for edit in edits:
        mark = edit[0]
        content = edit[2:]
        if mark == "+":
            lines.insert(at, content)
            at += 1
            continue
        at = lines.index(content, at)
        if mark == "-":
            del lines[at]
        else:
            at += 1
    return newline.join(lines)


def _run(line: str, folder: Path, shown: _Shown) -> Iterator[str]:
    line, _, how = line.partition(" | ")
    words = [quoted or plain for quoted, plain in _WORD.findall(line)]
    out = io.TextIOWrapper(io.BytesIO(), "utf-8")
    err = io.StringIO()
    code = 0
    if words[0] == "cat":
        if not (folder / words[1]).is_file():
            yield "! does not exist"
            return
        out.buffer.write((folder / words[1]).read_bytes())
    else:
        with redirect_stdout(out), redirect_stderr(err):
            try:
                code = drive.command(words)
            except Exception as error:  # a defect, which is recorded as any other answer
                code = 1
                print(f"Traceback: {error!r}", file=err)
    out.flush()
    data = out.buffer.getvalue()
    if how and data and code == 0:
        content = shown.lines(how, data)
    else:
        content = data.decode("utf-8").splitlines()
    lines = err.getvalue().splitlines()
    talk = [text for text in lines if not text.startswith(("usage: ", "  "))]
    if len(talk) > LINES:
        talk[LINES:] = [f"... and {len(talk) - LINES} more lines"]
    yield from (f"| {_neutral(text, folder)}".rstrip() for text in content)
    yield from (f"! {_neutral(text, folder)}".rstrip() for text in talk)
    yield f"=> {code}"


def _neutral(text: str, folder: Path) -> str:
    """Return the text without names and numbers that depend on this machine or on the version."""
    replacements = {f"{folder}/": "", str(folder): ".", **drive.FOLDERS}
    for real, neutral in replacements.items():
        text = text.replace(real, neutral)
    # argparse of some Python versions puts the choices in quotes
    text = re.sub(r"\(choose from .*\)", lambda found: found[0].replace("'", ""), text)
    text = re.sub(r", in [\d.]+ s\b", ", in TIME", text)
    return re.sub(rf"\b{re.escape(drive.VERSION)}\b", "VERSION", text)


@contextmanager
def _place() -> Iterator[Path]:
    """Work in an empty folder, with an environment that is the same on all machines."""
    before = dict(os.environ)
    folder_before = Path.cwd()
    argv = sys.argv
    stdin = sys.stdin
    handlers = logging.root.handlers
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        for key in SURROUNDINGS:
            os.environ.pop(key, None)
        os.environ |= {"HOME": name, "XDG_STATE_HOME": f"{name}/state", "COLUMNS": "100"}
        os.environ |= {"TZ": "UTC0", "LC_ALL": "C"}
        time.tzset()
        os.chdir(folder)
        sys.argv = ["kontronik-can-gw"]
        logging.root.handlers = []  # pytest has handlers, a new process has none
        try:
            yield folder
        finally:
            os.chdir(folder_before)
            os.environ.clear()
            os.environ.update(before)
            time.tzset()
            sys.argv = argv
            sys.stdin = stdin
            logging.root.handlers = handlers
