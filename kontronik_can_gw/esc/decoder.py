"""The seam of an ESC protocol: a decoder from bytes to readings, and tables that describe readings.

A protocol is one ``EscProtocol``, listed in protocols.py. Its frames, fields and error bits are
private to its folder. All other code reads names, steps, texts and codes from these tables.
Standard library only, no I/O, no clock.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from functools import cached_property
from typing import Any, NamedTuple, Protocol, Self

SECOND_NS = 1_000_000_000
Data = Any
"""The fields of a reading in steps: a Sequence[int] whose type is private to the protocol."""


@dataclass(eq=False)
class FrameForm:
    """One form of a protocol's frames."""

    length: int
    """In bytes."""
    is_info: bool = False
    """True for a frame about the device, False for a frame with live data."""
    layout_number: int = 1
    """Position of the frame layout in EscProtocol.layouts, counted from 1."""


class Reading(NamedTuple):
    """An accepted frame."""

    form: FrameForm
    offset: int
    """Position of the frame's first byte in the stream."""
    data: Data
    """The fields in steps."""

    @property
    def is_suspect(self) -> bool:
        """True if data that the frame's checksum does not cover has an impossible value."""
        return False


class Counters(Protocol):
    """Counts of one stream, as a dataclass. They never decrease.

    ``dropped_bytes`` counts only bytes that are certainly not part of a frame.
    """

    @property
    def bytes(self) -> int: ...
    @property
    def live(self) -> int: ...
    @property
    def info(self) -> int: ...
    @property
    def crc_errors(self) -> int: ...
    @property
    def dropped_bytes(self) -> int: ...
    def copy(self) -> Self: ...

    def as_dict(self) -> dict[str, int]:
        """Return all counters by name, including the five above."""

    def diagnosis(self, since: Self | None = None) -> str | None:
        """Explain in words why no frame was received since the earlier state ``since``.

        Without ``since``, since the start of the stream. None if a frame was received.
        """


class Decoder(Protocol):
    """Finds the frames of one byte stream, however it is cut into chunks.

    No method raises. Bytes that are not part of a frame are counted and dropped.
    """

    @property
    def counters(self) -> Any:
        """Counters of the whole stream."""

    @property
    def pending(self) -> int:
        """Number of bytes held because they may be part of a frame that is still incomplete."""

    def feed(self, data: bytes, now: int = 0) -> Sequence[Reading]:
        """Take the next bytes and return the readings that are now certain, in stream order.

        ``now`` is the time of the read in ns. Protocols whose frames have no header use it to find
        the gap between two frames.
        """

    def flush(self) -> Sequence[Reading]:
        """End the stream: return the readings in the pending bytes and drop the rest.

        The next call of ``feed`` starts a new stream. The counters continue.
        """

    def adopt_counters(self, counters: Any) -> None:
        """Replace the counters. They must agree with the bytes that are held.

        A position in the stream is counted by ``counters.bytes``.
        """


class Severity(Enum):
    """Class of an error bit. A status is not an alarm."""

    ERROR = "error"
    WARNING = "warning"
    STATUS = "status"


class ErrorBit(IntEnum):
    """The bits of an error word. A protocol derives a class from this for each of its words.

    A member is written ``NAME = (bit, severity, meaning, remedy, code, is_summary, is_normal)``.
    The last three may be left out.
    """

    severity: Severity
    meaning: str
    remedy: str
    """Instruction for the user."""
    code: int | None
    """CANopen emergency error code. None: a manufacturer-specific code is used."""
    is_summary: bool
    """True if the bit only reports that another bit of its severity is set."""
    is_normal: bool
    """True if the bit is set in normal operation, so that displays leave it out."""

    def __new__(
        cls,
        bit: int,
        severity: Severity,
        meaning: str,
        remedy: str,
        code: int | None = None,
        is_summary: bool = False,
        is_normal: bool = False,
    ) -> Self:
        member = int.__new__(cls, bit)
        member._value_ = bit
        member.severity = severity
        member.meaning = meaning
        member.remedy = remedy
        member.code = code
        member.is_summary = is_summary
        member.is_normal = is_normal
        return member

    @property
    def text(self) -> str:
        """The name in tables, and the name to which DBC signals bind."""
        return self.name.lower()


def bit_texts(word: int, names: type[ErrorBit] | Sequence[ErrorBit]) -> list[str]:
    """Return the names of the bits that are set in a 32-bit error word, lowest bit first.

    A bit without a name is called ``bit24`` or similar.
    """
    if not word:
        return []
    known = {int(bit): bit.text for bit in names}
    return [known.get(bit, f"bit{bit}") for bit in range(32) if word >> bit & 1]


class StateText(NamedTuple):
    """An operating state of the ESC."""

    text: str
    """Name in value tables."""
    meaning: str
    """The name in words."""
    remedy: str
    """Instruction for the user."""
    kind: str | None = None
    """``idle``, ``start``, ``run``, ``brake`` or ``fault``. None if unknown."""
    phase: str = ""
    """Label of the group of states that a report draws alike."""


NO_NAMES: Mapping[int, str] = {}
"""Names of a field that is not an enumeration."""


class Field(NamedTuple):
    """A value that readings supply: ``data[word] >> shift & mask``."""

    name: str
    unit: str
    word: int
    """Index in the reading's data."""
    low: int
    """Smallest possible value in steps. A DBC signal that cannot hold low..high gets a note."""
    high: int
    """Greatest possible value in steps."""
    per_unit: int = 1
    """Steps that make one ``unit``."""
    is_info: bool = False
    shift: int = 0
    mask: int = -1
    not_on: frozenset[int] = frozenset()
    """Numbers of the devices that do not supply the value."""
    names: Mapping[int, str] = NO_NAMES
    """Names of an enumeration's numbers."""

    def of(self, data: Sequence[int]) -> int:
        """Return the value in a reading's data, in steps."""
        return data[self.word] >> self.shift & self.mask


@dataclass(frozen=True, eq=False)
class EscProtocol:
    """An ESC protocol: line settings, decoder, and tables that describe readings.

    These field names have a fixed meaning; each may be missing:

    - ``electrical_speed``, ``battery_voltage`` and ``battery_current`` are whole words of live
      data. Run time and energy are computed from them.
    - ``operating_state_raw`` and ``operating_errors`` are in live data.
    - ``device_raw``, ``variant``, ``firmware_main``, ``firmware_sub``, ``cell_count`` and
      ``selftest_errors`` are in info data.

    Arguments named ``data`` are the data of a live or an info reading, or None if there is none.
    """

    name: str
    """Name in configuration files."""
    make: Callable[[], Decoder]
    """Creates a decoder at the start of a stream."""
    fields: tuple[Field, ...]
    maker: str = "unknown"
    """Manufacturer of the ESCs, for display."""
    baud_rate: int = 115_200
    even_parity: bool = False
    """The line always has 8 data bits and 1 stop bit."""
    layouts: tuple[str, ...] = ("1",)
    """Names of the frame layouts, beginning with number 1."""
    errors: Mapping[str, Sequence[ErrorBit]] = field(default_factory=dict)
    """Maps the name of an error word to its bits."""
    states: Mapping[int, StateText] = field(default_factory=dict)
    backward_states: frozenset[int] = frozenset()
    """Values of ``operating_state_raw`` in which the motor turns backward."""
    devices: Mapping[int, str] = field(default_factory=dict)
    """Maps the number of a device to its name."""
    peak_current_of: Mapping[int, str] = field(default_factory=dict)
    """Maps the number of a device to the origin of its peak current: ``motor`` or ``battery``."""
    wire: tuple[tuple[str, type[tuple[int, ...]]], ...] | None = None
    """struct codes in wire order, and data type, of live data and then of info data.

    None if the C core cannot decode the protocol. It decodes only the frames that
    ``esc/kontronik/c_header.py`` describes.
    """

    @cached_property
    def by_name(self) -> Mapping[str, Field]:
        """The fields by name."""
        return {each.name: each for each in self.fields}

    @cached_property
    def bits(self) -> Mapping[str, ErrorBit]:
        """The bits of all error words by name."""
        return {bit.text: bit for bits in self.errors.values() for bit in bits}

    @cached_property
    def byte_ns(self) -> int:
        """Time of one byte on the wire in ns."""
        bits = 11 if self.even_parity else 10
        return bits * SECOND_NS // self.baud_rate

    @cached_property
    def line(self) -> str:
        """The line's settings, for example "115200 8E1"."""
        parity = "E" if self.even_parity else "N"
        return f"{self.baud_rate} 8{parity}1"

    def value(self, name: str, data: Data | None) -> int | None:
        """Return a field in steps. None without data, or if the protocol does not supply it."""
        found = self.by_name.get(name)
        if found is None or data is None:
            return None
        return found.of(data)

    def state_text(self, data: Data | None) -> str | None:
        """Return the operating state's name, or its number as text if it has no name."""
        number = self.value("operating_state_raw", data)
        if number is None:
            return None
        state = self.states.get(number)
        return str(number) if state is None else state.text

    def device_name(self, data: Data | None) -> str | None:
        """Return the device's name. None if the device is unknown or has no name."""
        number = self.value("device_raw", data)
        if number is None:
            return None
        return self.devices.get(number)

    def device_text(self, data: Data | None) -> str | None:
        """Return the device's name, or its number as text if it has no name."""
        number = self.value("device_raw", data)
        if number is None:
            return None
        return self.devices.get(number, str(number))

    def firmware_text(self, data: Data | None) -> str | None:
        """Return main and sub version of the firmware, for example "1.14"."""
        main = self.value("firmware_main", data)
        sub = self.value("firmware_sub", data)
        if main is None:
            return None
        if sub is None:
            return str(main)
        return f"{main}.{sub}"

    def peak_current_text(self, data: Data | None) -> str | None:
        """Return the origin of the device's peak current, ``motor`` or ``battery``.

        The peak current is a held maximum. None if its origin is unknown.
        """
        number = self.value("device_raw", data)
        if number is None:
            return None
        return self.peak_current_of.get(number)

    def layout_text(self, layout: int) -> str | None:
        """Return the name of a frame layout. None for 0, which means unknown."""
        if layout == 0:
            return None
        return self.layouts[layout - 1]
