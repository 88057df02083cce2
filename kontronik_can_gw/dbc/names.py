"""Names in a DBC: their length, and how they are compared."""

MAX_NAME = 32
"""Characters that every tool takes."""


def normalize(name: str) -> str:
    """Letters and digits of a name, in lower case."""
    return "".join(c for c in name.casefold() if c.isalnum())
