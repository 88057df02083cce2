"""An output before it is made: its settings, its CAN ids and the traffic that it causes."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from kontronik_can_gw.core.output import Output, OutputHost
from kontronik_can_gw.esc.telemetry import EscSettings

_Content = TypeVar("_Content")

OUTPUTS = ("canopen", "dronecan")
"""The outputs besides the DBC. Each is a folder that is imported only if the output is enabled.

Its module ``setup`` is a ``SetupModule``. Its table in the configuration has the same name and a
key ``enabled``. The first output gets its slots and sends its frames first.
"""


class StoredFile(NamedTuple, Generic[_Content]):
    """The stored parameters of one ESC's node."""

    content: _Content | None
    """None if nothing is stored, or if it cannot be read."""
    fault: str | None
    """The reason why it cannot be read, or None."""
    warning: str | None
    """A line for the user, or None."""


class HostMachine(Protocol):
    """The machine on which an output is configured, and the files there."""

    identity: bytes
    """A digest of the numbers that identify the machine. It is empty if there are none."""
    version: tuple[int, int]
    """Major and minor version of the program."""

    def random_number(self) -> int:
        """Return a random number of 64 bits."""

    def serial_number(self, number: int, name: str) -> int:
        """Return a serial number for an ESC, or 0 if the machine has no identity.

        ``number`` is 1 for the first ESC.
        """

    def read_file(self, path: Path, limit: int) -> bytes:
        """Return at most ``limit`` bytes of a file. Raises OSError."""

    def stored(self, name: str, decode: Callable[[bytes], _Content]) -> StoredFile[_Content]:
        """Read the parameters that a master stored for the ESC of this name.

        A ValueError of ``decode`` means that the file is damaged.
        """


class OutputMaker(Protocol):
    """Makes one output of a gateway."""

    @property
    def slots(self) -> int:
        """The number of slots of each ESC that the core in C shall have for this output.

        If the output takes more, the rest run in Python.
        """

    def make(self, host: OutputHost, now: int) -> Output:
        """Return a new output. ``now`` is the time at which the gateway is made."""


class ReadyOutput:
    """Gives a gateway an output that exists already."""

    slots = 0

    def __init__(self, output: Output) -> None:
        self._output = output

    def make(self, host: OutputHost, now: int) -> Output:
        """As in ``OutputMaker``."""
        return self._output


class OutputSetup(ABC):
    """An output that can be made, and facts about it. Instances do not change."""

    name: str
    """The name in OUTPUTS."""
    title: str
    """The nodes as the subject of a sentence, for example "the DroneCAN nodes"."""
    changes_escs = False
    """True if the output can change settings of ESCs while it runs."""
    faults: Sequence[tuple[int, str]] = ()
    """Pairs of ESC and reason for stored parameters that cannot be read."""

    @property
    @abstractmethod
    def slots(self) -> int:
        """As in ``OutputMaker``."""

    @abstractmethod
    def make(self, host: OutputHost, now: int) -> Output:
        """As in ``OutputMaker``."""

    @abstractmethod
    def header(self) -> dict[str, Any]:
        """Return the JSON object from which ``SetupModule.recorded`` makes an equal setup."""

    @abstractmethod
    def taken_ids(self) -> Mapping[int, str]:
        """Return the ids and blocks of ids that no message may have, with the user of each."""

    @abstractmethod
    def traffic(self, is_worst: bool = False) -> tuple[float, float]:
        """Return the expected frames and bits per second, with the most stuffing.

        ``is_worst`` means that everything sent on change changes all the time.
        """

    def esc_settings(self, escs: Sequence[EscSettings]) -> list[EscSettings]:
        """Return the settings of the ESCs that are in effect with this output."""
        return list(escs)

    def with_stored(self, machine: HostMachine) -> "OutputSetup":
        """Return the setup with the parameters that masters stored."""
        return self

    def fitted(self, message_ids: Mapping[int, str]) -> "OutputSetup":
        """Return the setup without stored parameters that clash with a message.

        ``message_ids`` has the names of the messages by 11-bit id.
        """
        return self

    def warnings(self, file: str, bitrate: int) -> list[str]:
        """Return warnings for the user of this configuration file on a bus with this bit rate."""
        return []

    @abstractmethod
    def summary(self, escs: Sequence[EscSettings]) -> list[str]:
        """Return the lines of ``check``, at most 78 characters each.

        The output's name fills the first 10 columns.
        """

    def lines(self) -> list[str]:
        """Return one line for each fact that ``check --verbose`` shows."""
        return []


class SetupModule(Protocol):
    """The module ``setup`` in an output's folder."""

    def configured(self, config: Any, machine: HostMachine) -> OutputSetup:
        """Make the setup from a ``config.keys.Config``, without stored parameters.

        Raises UserError with every mistake.
        """

    def recorded(self, found: Mapping[str, Any], escs: Sequence[EscSettings]) -> OutputSetup:
        """Make the setup from ``OutputSetup.header``. Raises HeaderError or UserError."""


def setup_module(name: str) -> SetupModule:
    """Import the module ``setup`` of an output."""
    module: Any = import_module(f"kontronik_can_gw.{name}.setup")
    found: SetupModule = module
    return found
