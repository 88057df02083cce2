"""Files by meaning: what stands in a DBC, an EDS, a table or a CAN log, however it is laid out. Nothing of the product is used."""
from collections.abc import Callable
FORMS: dict[str, Callable[[bytes], list[str]]] = {}
