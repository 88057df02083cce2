"""How names are compared."""


def normalize(name: str) -> str:
    """A name as it is compared: letters and digits only, lower case."""
    return "".join(c for c in name.casefold() if c.isalnum())
