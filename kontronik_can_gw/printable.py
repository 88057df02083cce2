"""Text of files, buses and people as it may be shown: a terminal obeys control characters, and a reader is deceived by some others."""

import json


def printable(text: str, keep: str = "") -> str:
    """The text with a ``?`` for each character that is not shown as such: escape sequences, controls, directions, but those of ``keep``."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else "?" for c in text)


def printable_json(
    document: object, indent: int | None = None, ascii_only: bool = False, allow_nan: bool = True
) -> str:
    """JSON with what is not printable written as escapes: it reads back as it was."""
    text = json.dumps(document, indent=indent, ensure_ascii=ascii_only, allow_nan=allow_nan)
    return "".join(c if c.isprintable() or c == "\n" else json.dumps(c)[1:-1] for c in text)
