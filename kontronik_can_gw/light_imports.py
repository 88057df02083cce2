"""Import python-can and cantools without the heavy libraries that they pull in.

If asammdf is installed, python-can imports it for MF4 files, and with it numpy and pandas. That
takes half a second, 90 MB and threads. The package cantools imports python-can for its tester,
which its database does not need.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec, module_from_spec
from types import ModuleType
from typing import Any


@contextmanager
def without_asammdf() -> Iterator[None]:
    """Import modules in this block without asammdf, and only the requested part of cantools.

    If asammdf is loaded already, it stays available.
    """
    hide = "asammdf" not in sys.modules
    if hide:
        # This is the documented way to make an import fail.
        sys.modules["asammdf"] = None  # type: ignore[assignment]
    _prepare_cantools()
    try:
        yield
    finally:
        if hide:
            del sys.modules["asammdf"]
        if (
            isinstance(sys.modules.get("cantools"), _Package)
            and "cantools.database" not in sys.modules
        ):
            del sys.modules["cantools"]


class _Package(ModuleType):
    """A package whose ``__init__`` runs at the first access to a missing attribute.

    Its modules can be imported before that.
    """

    def __getattr__(self, name: str) -> Any:
        if self.__spec__ is None or self.__spec__.loader is None:
            raise AttributeError(name)
        # From now on it is an ordinary module.
        self.__class__ = ModuleType  # type: ignore[assignment]
        self.__spec__.loader.exec_module(self)
        return getattr(self, name)


def _prepare_cantools() -> None:
    if "cantools" not in sys.modules and (spec := find_spec("cantools")) is not None:
        package = module_from_spec(spec)
        package.__class__ = _Package
        sys.modules["cantools"] = package
