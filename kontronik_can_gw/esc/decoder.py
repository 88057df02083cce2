"""The seam of an ESC protocol: a stateful decoder from bytes to readings, and tables that say what the readings hold.

A protocol is one ``EscProtocol`` in the tuple of protocols.py. Nothing outside its folder knows its frames, fields or error bits: all
others take names, steps, texts and codes from these tables. Standard library only, no I/O, no clock.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from functools import cached_property
from typing import Any, NamedTuple, Protocol, Self

SECOND_NS = 1_000_000_000
Data = Any
"""The fields of a reading as whole steps: a Sequence[int], of a type that is the protocol's own."""


@dataclass(eq=False)
class FrameForm:
    """A form of a protocol's frames. ``layout_number``: of the frame layout, 1 ... as listed in EscProtocol.layouts."""

    length: int
    """In bytes."""
    is_info: bool = False
    """True for a frame with information of the device, False for one with live data."""
    layout_number: int = 1


class Reading(NamedTuple):
    """An accepted frame: its form, the stream position of its first byte, its fields as whole steps."""

    form: FrameForm
    offset: int
    data: Data

    @property
    def suspect(self) -> bool:
        """True where data outside the frame's checksum is impossible."""
        return False


class Counters(Protocol):
    """What one stream held; all numbers only grow. ``dropped_bytes`` are certain to belong to no frame."""

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
        """All counters by name, those above among them."""

    def diagnosis(self, since: Self | None = None) -> str | None:
        """Why no frame has come (since an earlier state), in words; None where one has."""


class Decoder(Protocol):
    """Finds the frames of one byte stream, however it is cut. Never raises: what is no frame is counted and dropped."""

    @property
    def counters(self) -> Any:
        """Counters of the whole stream."""

    @property
    def pending(self) -> int:
        """How many bytes are held, undecided."""

    def feed(self, data: bytes, now: int = 0) -> Sequence[Reading]:
        """The next bytes, read at ``now`` (ns; for protocols without a header, which synchronise on the gap): what is certain by then."""

    def flush(self) -> Sequence[Reading]:
        """The stream ended or was interrupted: what is left of it; ready for a new start."""


class Severity(Enum):
    """Class of an error bit: an error, a warning, or a mere status that is no alarm."""

    ERROR = "error"
    WARNING = "warning"
    STATUS = "status"


class ErrorBit(IntEnum):
    """The bits of an error word; a protocol derives one for each of its words.

    A member is written ``NAME = (bit, severity, meaning, remedy, code, is_summary, is_normal)``; the last three may be left out.
    ``remedy``: what a person should do. ``code``: of a CANopen emergency, None for one of the manufacturer's. ``is_summary``: set with
    any other bit of its severity, which explains it. ``is_normal``: set in normal operation, nothing to show.
    """

    severity: Severity
    meaning: str
    remedy: str
    code: int | None
    is_summary: bool
    is_normal: bool

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
        """The name as decode prints it and DBC signals bind to it."""
        return self.name.lower()


def bit_texts(word: int, names: type[ErrorBit] | Sequence[ErrorBit]) -> list[str]:
    """Names of the bits set in a 32-bit error word, lowest first; a bit without a name is ``bit24`` and the like."""
    if not word:
        return []
    known = {int(bit): bit.text for bit in names}
    return [known.get(bit, f"bit{bit}") for bit in range(32) if word >> bit & 1]


class State(NamedTuple):
    """An operating state.

    ``meaning``: its name in words. ``remedy``: what a person should do. ``kind``: ``idle``, ``start``, ``run``, ``brake`` or ``fault``.
    ``phase``: what it is shown alike with, in words.
    """

    text: str
    meaning: str
    remedy: str
    kind: str | None = None
    phase: str = ""


class Field(NamedTuple):
    """A value that readings supply, as ``data[word] >> shift & mask``; ``per_unit`` steps make one ``unit``.

    ``low``..``high``: possible values in steps, a signal that cannot hold them is checked. ``not_on``: numbers of the devices that do not
    supply it. ``names``: of an enumeration.
    """

    name: str
    unit: str
    word: int
    low: int
    high: int
    per_unit: int = 1
    is_info: bool = False
    shift: int = 0
    mask: int = -1
    not_on: frozenset[int] = frozenset()
    names: Mapping[int, str] = {}

    def of(self, data: Sequence[int]) -> int:
        """The value in a reading, in steps."""
        return data[self.word] >> self.shift & self.mask


@dataclass(frozen=True, eq=False)
class EscProtocol:
    """An ESC protocol: how its line is set, its decoder, and what its readings hold.

    Fields with a meaning of their own, by name: ``electrical_speed``, ``battery_voltage``, ``battery_current`` (live, whole words; run time
    and energy come of them), ``operating_state_raw``, ``operating_errors``, ``selftest_errors``, ``cell_count``, ``device_raw``,
    ``variant``, ``firmware_main``, ``firmware_sub``. Any may be missing.
    """

    name: str
    """As a configuration has it."""
    make: Callable[[], Decoder]
    """A decoder at the start of a stream."""
    fields: tuple[Field, ...]
    maker: str = "unknown"
    """Who makes the ESCs, as people write it."""
    baud_rate: int = 115_200
    even_parity: bool = False
    """With 8 data bits and 1 stop bit."""
    layouts: tuple[str, ...] = ("1",)
    """Names of the frame layouts, from number 1 on."""
    errors: Mapping[str, Sequence[ErrorBit]] = field(default_factory=dict)
    """Name of an error word to its bits."""
    states: Mapping[int, State] = field(default_factory=dict)
    backward_states: frozenset[int] = frozenset()
    """Values of ``operating_state_raw`` in which the motor turns backward."""
    devices: Mapping[int, str] = field(default_factory=dict)
    peak_current_of: Mapping[int, str] = field(default_factory=dict)
    """Number of a device to whose peak current it reports: ``motor`` or ``battery``."""
    wire: tuple[tuple[str, type[tuple[int, ...]]], ...] | None = None
    """struct codes, as they are sent, and type of live data and of information; None where the core in C does not decode it."""

    @cached_property
    def by_name(self) -> Mapping[str, Field]:
        """The fields by name."""
        return {found.name: found for found in self.fields}

    @cached_property
    def bits(self) -> Mapping[str, ErrorBit]:
        """The bits of all error words by name."""
        return {bit.text: bit for bits in self.errors.values() for bit in bits}

    @cached_property
    def byte_ns(self) -> int:
        """Wire time of a byte, ns."""
        return (11 if self.even_parity else 10) * SECOND_NS // self.baud_rate

    @cached_property
    def line(self) -> str:
        """The line's settings as people write them."""
        return f"{self.baud_rate} {'8E1' if self.even_parity else '8N1'}"

    def value(self, name: str, data: Data | None) -> int | None:
        """A field of a reading, in steps; None without a reading, and where the protocol does not supply it."""
        found = self.by_name.get(name)
        return None if found is None or data is None else found.of(data)

    def state_text(self, data: Data | None) -> str | None:
        """The operating state of live data: its name, the number of one without."""
        number = self.value("operating_state_raw", data)
        if number is None:
            return None
        return self.states[number].text if number in self.states else str(number)

    def device_name(self, data: Data | None) -> str | None:
        """The name of the device of information; None where it is not known, and for one without a name."""
        number = self.value("device_raw", data)
        return None if number is None else self.devices.get(number)

    def device_text(self, data: Data | None) -> str | None:
        """The device of information: its name, the number of one without."""
        number = self.value("device_raw", data)
        return None if number is None else self.devices.get(number, str(number))

    def firmware_text(self, data: Data | None) -> str | None:
        """Main and sub version of the firmware, as "1.14"."""
        main, sub = self.value("firmware_main", data), self.value("firmware_sub", data)
        if main is None:
            return None
        return str(main) if sub is None else f"{main}.{sub}"

    def peak_current_text(self, data: Data | None) -> str | None:
        """Whose peak current the device reports (a held maximum): ``motor``, ``battery``, or None where unknown."""
        number = self.value("device_raw", data)
        return None if number is None else self.peak_current_of.get(number)

    def layout_text(self, layout: int) -> str | None:
        """The name of a frame layout; None for 0, unknown."""
        return self.layouts[layout - 1] if layout else None
