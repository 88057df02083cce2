"""Make text from files, buses and users safe to print.

Control characters can command a terminal, and others can mislead the reader.
"""

import json


def counted(count: int, noun: str) -> str:
    """Return a number with its noun: "1 row", "2 rows"."""
    if count == 1:
        return f"{count} {noun}"
    return f"{count} {noun}s"


def printable(text: str, keep: str = "") -> str:
    """Return the text with ``?`` for each unprintable character that is not in ``keep``.

    Unprintable are, for example, escape sequences, control characters and marks of text direction.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else "?" for c in text)


def printable_json(
    document: object,
    indent: int | None = None,
    ascii_only: bool = False,
    allow_nan: bool = True,
) -> str:
    """Return JSON with unprintable characters as escapes. Reading it gives the same value."""
    text = json.dumps(
        document,
        indent=indent,
        ensure_ascii=ascii_only,
        allow_nan=allow_nan,
    )
    parts = []
    for character in text:
        if character.isprintable() or character == "\n":
            parts.append(character)
        else:
            parts.append(json.dumps(character)[1:-1])
    return "".join(parts)
