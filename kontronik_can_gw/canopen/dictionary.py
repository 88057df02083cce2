"""The object dictionary of one node: values by index and sub-index, with every check that CiA 301 wants before one changes.

Built from an EDS. A variable is either plain storage or bound: ``read`` then gives its value at each access.
"""

from collections.abc import Callable, Iterator, Mapping
from enum import IntEnum

from kontronik_can_gw.canopen.eds import CODECS, DOMAIN_TYPE, Eds, Entry
from kontronik_can_gw.canopen.objects import Bound

Value = int | float | bytes
Read = Callable[[int], Value]
"""``now`` to value. Raises SdoAbort where there is none."""
Check = Callable[[int], None]
"""Raises SdoAbort for a value that is refused."""
Written = Callable[[int], bool | None]
"""What follows a download, given ``now``. False: its confirmation comes later."""

_MAX_TEXT = 255
_MAX_DOMAIN = 0x10000


def key(index: int, sub: int) -> int:
    """Index and sub-index as one number, as PDO mappings have them in their upper 24 bits."""
    return index << 8 | sub


_IF_ABSENT = {
    key(0x1005, 0): 0x80,
    key(0x1017, 0): 1000,
    key(0x1018, 2): 0x4B4F4E01,
    key(0x1018, 3): 0x00010000,
    key(0x1029, 2): 1,
    key(0x1F80, 0): 4,
    key(0x2100, 6): 0x00FDFFFF,
}
"""Defaults of the shipped EDS that are not 0: what holds for an object that the EDS in use has dropped."""


class Abort(IntEnum):
    """Why an SDO transfer is refused or ended: codes of CiA 301, 7.2.4.3.17, table 22."""

    TOGGLE = 0x05030000
    TIMEOUT = 0x05040000
    COMMAND = 0x05040001
    BLOCK_SIZE = 0x05040002
    SEQUENCE = 0x05040003
    CRC = 0x05040004
    UNSUPPORTED_ACCESS = 0x06010000
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_LENGTH = 0x06040042
    INCOMPATIBLE = 0x06040043
    HARDWARE = 0x06060000
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUB_INDEX = 0x06090011
    VALUE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    GENERAL = 0x08000000
    TRANSFER = 0x08000020
    LOCAL_CONTROL = 0x08000021
    DEVICE_STATE = 0x08000022
    NO_DATA = 0x08000024


class SdoAbort(Exception):
    """Raised by the dictionary, answered by the SDO server with an abort frame; never leaves the core."""

    def __init__(self, code: Abort) -> None:
        super().__init__(f"{code:08X}h {code.name}")
        self.code = code


class Variable:
    """One entry at work. ``check`` may refuse a new value; ``written`` follows one."""

    __slots__ = ("bound", "check", "codec", "entry", "power_on", "read", "value", "written")

    def __init__(self, entry: Entry) -> None:
        self.entry = entry
        self.codec = CODECS.get(entry.data_type)
        self.bound: Bound | None = None
        """The value of ESC or gateway that it shows."""
        self.read: Read | None = None
        self.check: Check | None = None
        self.written: Written | None = None
        empty: Value = b"" if self.codec is None else 0
        self.power_on = empty if entry.default is None else entry.default
        self.value: Value = self.power_on

    @property
    def size(self) -> int | None:
        """Bytes of the type; None for texts and domains."""
        return None if self.codec is None else self.codec.size

    @property
    def max_size(self) -> int:
        """The most bytes that can be written."""
        if self.size is not None:
            return self.size
        return _MAX_DOMAIN if self.entry.data_type == DOMAIN_TYPE else _MAX_TEXT

    @property
    def readable(self) -> bool:
        return self.entry.access != "wo"

    @property
    def writable(self) -> bool:
        return "w" in self.entry.access

    def encode(self, value: Value) -> bytes:
        """Little-endian bytes of a value."""
        if self.codec is None:
            assert isinstance(value, bytes)
            return value
        return self.codec.pack(value)

    def decode(self, data: bytes) -> Value:
        """The value of bytes of the right size."""
        if self.codec is None:
            return data
        value: Value = self.codec.unpack(data)[0]
        return value

    def check_limits(self, value: Value) -> None:
        """SdoAbort 06090031h or 06090032h for a number outside the limits of the EDS."""
        low, high = self.entry.low, self.entry.high
        if isinstance(value, bytes):
            return
        if high is not None and not value <= high:
            raise SdoAbort(Abort.TOO_HIGH)
        if low is not None and not value >= low:
            raise SdoAbort(Abort.TOO_LOW)

    def default(self, node_id: int) -> Value:
        """The power-on value of a node with this node-ID: ``$NODEID`` worked in."""
        if self.entry.relative and isinstance(self.power_on, int):
            return self.power_on + node_id
        return self.power_on


def signature(word: bytes) -> Check:
    """A check that refuses all numbers but that of these four letters: 08000020h."""

    def check(value: int) -> None:
        if value != int.from_bytes(word, "little"):
            raise SdoAbort(Abort.TRANSFER)

    return check


class Dictionary:
    """All variables of one node. What is read or written over the bus goes through ``upload`` and ``download``."""

    def __init__(self, eds: Eds) -> None:
        self.variables = {key(entry.index, entry.sub): Variable(entry) for entry in eds.entries}
        self._indices = frozenset(entry.index for entry in eds.entries)
        self.read_only = False
        """True: nothing may be written over the bus."""
        self.written: Callable[[Variable, bool, int], None] = lambda _variable, _changed, _now: None
        """Called after each download; the flag says whether the value is another one."""

    def get(self, index: int, sub: int = 0) -> Variable | None:
        """The variable, None where there is none."""
        return self.variables.get(key(index, sub))

    def bind(
        self,
        index: int,
        sub: int = 0,
        *,
        read: Read | None = None,
        check: Check | None = None,
        written: Written | None = None,
    ) -> None:
        """Give an object to its service: what it shows, which values it refuses, what follows a download.

        Does nothing where the EDS has no such object.
        """
        variable = self.get(index, sub)
        if variable is not None:
            variable.read, variable.check, variable.written = read, check, written

    def number(self, index: int, sub: int = 0, otherwise: int | None = None) -> int:
        """The whole number that a variable holds. Where the EDS has no such variable ``otherwise``, None: the shipped EDS's default."""
        variable = self.get(index, sub)
        if variable is not None and isinstance(variable.value, int):
            return variable.value
        return _IF_ABSENT.get(key(index, sub), 0) if otherwise is None else otherwise

    def subs(self, index: int) -> Iterator[Variable]:
        """Variables of an array or record, from sub-index 1 on."""
        for sub in range(1, 255):
            if (variable := self.get(index, sub)) is not None:
                yield variable

    def find(self, index: int, sub: int) -> Variable:
        """The variable. SdoAbort 06020000h or 06090011h where there is none."""
        variable = self.variables.get(key(index, sub))
        if variable is None:
            raise SdoAbort(Abort.NO_SUB_INDEX if index in self._indices else Abort.NO_OBJECT)
        return variable

    def value(self, variable: Variable, now: int) -> Value:
        """What a variable holds now. SdoAbort where its source has nothing."""
        return variable.value if variable.read is None else variable.read(now)

    # --- what the SDO server asks

    def upload(self, index: int, sub: int, now: int) -> bytes:
        """The bytes that are read over the bus."""
        variable = self.find(index, sub)
        if not variable.readable:
            raise SdoAbort(Abort.WRITE_ONLY)
        return variable.encode(self.value(variable, now))

    def check_download(self, index: int, sub: int, size: int | None) -> int:
        """Whether ``size`` bytes may be written there, before any is moved (CiA 301, 7.2.4.3.17: the abort code says why not).

        Returns how many may be written at most.
        """
        variable = self.find(index, sub)
        if self.read_only:
            raise SdoAbort(Abort.DEVICE_STATE)
        if not variable.writable:
            raise SdoAbort(Abort.READ_ONLY)
        if size is not None and size > variable.max_size:
            raise SdoAbort(Abort.TOO_LONG)
        if size is not None and size < (variable.size or 0):
            raise SdoAbort(Abort.TOO_SHORT)
        return variable.max_size

    def download(self, index: int, sub: int, data: bytes, now: int) -> bool:
        """Write. False where the confirmation comes later."""
        self.check_download(index, sub, len(data))
        variable = self.find(index, sub)
        value = variable.decode(data)
        variable.check_limits(value)
        if variable.check is not None:
            assert isinstance(value, int)
            variable.check(value)
        changed = self.value(variable, now) != value
        variable.value = value
        later = variable.written is not None and variable.written(now) is False
        self.written(variable, changed, now)
        return not later

    # --- power-on and storage

    def reset(self, profile: range, node_id: int, stored: Mapping[int, bytes]) -> list[int]:
        """Give the variables of these indices their power-on values: the stored one where there is one, else the default.

        Returns the keys of stored values that are rejected: they do not fit this EDS (any more).
        """
        rejected = [number for number in stored if number not in self.variables]
        for number, variable in self.variables.items():
            if number >> 8 not in profile:
                continue
            variable.value = variable.default(node_id)
            if (data := stored.get(number)) is None:
                continue
            if not variable.writable or (variable.size is not None and len(data) != variable.size):
                rejected.append(number)
                continue
            value = variable.decode(data)
            try:
                variable.check_limits(value)
            except SdoAbort:
                rejected.append(number)
            else:
                variable.value = value
        return rejected

    def to_store(self, profile: range, node_id: int) -> dict[int, bytes]:
        """What differs from the defaults: all that a parameter store needs to keep, so that $NODEID stays alive in the rest."""
        return {
            number: variable.encode(variable.value)
            for number, variable in self.variables.items()
            if number >> 8 in profile
            and "rw" in variable.entry.access
            and variable.read is None
            and variable.value != variable.default(node_id)
        }
