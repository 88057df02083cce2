"""Import python-can and cantools without the heavy libraries that they pull in.

If asammdf is installed, python-can imports it for MF4 files, and with it numpy and pandas: half a second, 90 MB and threads. The
top-level package of cantools imports python-can for its tester; its database does not need it.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec, module_from_spec
from types import ModuleType
from typing import Any


@contextmanager
def without_asammdf() -> Iterator[None]:
    """Imports inside this block do not find asammdf unless it is loaded already, and load only the requested part of cantools."""
    hide = "asammdf" not in sys.modules
    if hide:
        sys.modules["asammdf"] = None  # type: ignore[assignment]  # the documented way to make an import fail
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
    """A package whose ``__init__`` runs at the first access to an attribute that is missing; its modules can be imported before."""

    def __getattr__(self, name: str) -> Any:
        if self.__spec__ is None or self.__spec__.loader is None:
            raise AttributeError(name)
        self.__class__ = ModuleType  # type: ignore[assignment]  # an ordinary module from now on
        self.__spec__.loader.exec_module(self)
        return getattr(self, name)


def _prepare_cantools() -> None:
    if "cantools" not in sys.modules and (spec := find_spec("cantools")) is not None:
        package = module_from_spec(spec)
        package.__class__ = _Package
        sys.modules["cantools"] = package
