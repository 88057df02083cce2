"""Import python-can, and cantools which imports it, without asammdf.

Where asammdf is installed python-can imports it for its MF4 files, and with it numpy and pandas: half a second, 90 MB and threads
that a gateway has no use for.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def without_asammdf() -> Iterator[None]:
    """What is imported inside does not find asammdf, unless it was imported before."""
    hide = "asammdf" not in sys.modules
    if hide:
        sys.modules["asammdf"] = None  # type: ignore[assignment]  # the documented way to make an import fail
    try:
        yield
    finally:
        if hide:
            del sys.modules["asammdf"]
