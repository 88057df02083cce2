"""The machine on which outputs are configured: its identity, files and stored parameters."""

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from kontronik_can_gw import __version__
from kontronik_can_gw.config.keys import Config
from kontronik_can_gw.core.output_setup import StoredFile
from kontronik_can_gw.runtime.system.machine import (
    identity_digest,
    machine_identity,
    serial_number,
    state_folder,
)

if TYPE_CHECKING:
    from kontronik_can_gw.runtime.files.store import ParameterStore

_Content = TypeVar("_Content")


def parameter_folder(config: Config) -> Path:
    """Return the folder of the stored parameters."""
    if config.canopen.store is None:
        return state_folder()
    return Path(config.file).parent / config.canopen.store


class ThisMachine:
    """The ``core.output_setup.Machine`` of this process.

    With a store, the files of parameters are locked. Without one, they are only read.
    """

    def __init__(self, config: Config, store: "ParameterStore | None") -> None:
        self._config = config
        self._store = store
        self.identity = identity_digest()
        major, minor, *_ = map(int, re.findall(r"\d+", __version__))
        self.version = (major, minor)

    def random_number(self) -> int:
        """Return a random number of 64 bits."""
        return int.from_bytes(os.urandom(8), "big")

    def serial_number(self, number: int, name: str) -> int:
        """Return the serial number of an ESC, which is the same at each start."""
        return serial_number(number, name, machine_identity())

    def read_file(self, path: Path, limit: int) -> bytes:
        """Return at most ``limit`` bytes of a file. Raises OSError."""
        with path.open("rb") as file:
            return file.read(limit)

    def stored(self, name: str, decode: Callable[[bytes], _Content]) -> StoredFile[_Content]:
        """Read the parameters that a master stored for the ESC of this name.

        Raises RunError if another gateway uses the file.
        """
        if self._store is None:
            return self._read_only(name, decode)
        warning = None
        lock_problem = self._store.lock(name)
        if lock_problem:
            warning = f"{name}: parameters could not be stored: {lock_problem}"
        content, fault = self._store.load(name, decode)
        return StoredFile(content, fault, warning)

    def _read_only(self, name: str, decode: Callable[[bytes], _Content]) -> StoredFile[_Content]:
        # The module is not needed without stored parameters.
        from kontronik_can_gw.runtime.files.store import parameter_file

        path = parameter_file(parameter_folder(self._config), name)
        try:
            return StoredFile(decode(path.read_bytes()), None, None)
        except FileNotFoundError:
            return StoredFile(None, None, None)
        except OSError as error:
            fault = f"{path}: cannot be read: {error.strerror}"
        except ValueError as error:
            fault = f"{path}: {error}"
        return StoredFile(None, fault, f"{name}: stored parameters: {fault}")
