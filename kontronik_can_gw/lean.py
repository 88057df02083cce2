"""Import python-can and cantools without what a gateway has no use for.

Where asammdf is installed python-can imports it for its MF4 files, and with it numpy and pandas: half a second, 90 MB and threads. And
cantools as a whole imports python-can, for its tester; its database alone needs nothing of that.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec, module_from_spec
from types import ModuleType
from typing import Any


@contextmanager
def without_asammdf() -> Iterator[None]:
    """What is imported inside does not find asammdf, unless it was imported before; of cantools the part that is asked for comes alone."""
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
    """A package whose own code is run when something is asked for that it has not got yet; its modules can be imported before."""

    def __getattr__(self, name: str) -> Any:
        if self.__spec__ is None or self.__spec__.loader is None:
            raise AttributeError(name)
        self.__class__ = ModuleType  # type: ignore[assignment]  # from now on one as all others
        self.__spec__.loader.exec_module(self)
        return getattr(self, name)


def _prepare_cantools() -> None:
    if "cantools" not in sys.modules and (spec := find_spec("cantools")) is not None:
        package = module_from_spec(spec)
        package.__class__ = _Package
        sys.modules["cantools"] = package
