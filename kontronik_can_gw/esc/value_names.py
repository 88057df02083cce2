"""How users' names of values are compared: only their letters and digits count."""

from kontronik_can_gw.esc.values import VALUES


def normalize(name: str) -> str:
    """Return the letters and digits of a name, in lower case."""
    return "".join(c for c in name.casefold() if c.isalnum())


VALUES_BY_KEY = {normalize(name): value for name, value in VALUES.items()}
"""Every value by its normalized name."""
