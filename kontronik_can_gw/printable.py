"""Makes text from files, buses and users safe to print: control characters can command a terminal, others mislead the reader."""

import json


def printable(text: str, keep: str = "") -> str:
    """The text with ``?`` for each unprintable character (escape sequences, controls, text direction), except those in ``keep``."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else "?" for c in text)


def printable_json(
    document: object, indent: int | None = None, ascii_only: bool = False, allow_nan: bool = True
) -> str:
    """JSON with unprintable characters as escapes, so that reading it back gives the same value."""
    text = json.dumps(document, indent=indent, ensure_ascii=ascii_only, allow_nan=allow_nan)
    return "".join(c if c.isprintable() or c == "\n" else json.dumps(c)[1:-1] for c in text)
