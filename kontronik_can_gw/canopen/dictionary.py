"""The object dictionary of one node: values by index and sub-index, and the checks of CiA 301.

It is built from an EDS. A variable either stores its value or is bound to a service or an ESC. Then
``read`` returns its value at each access.
"""

from collections.abc import Callable, Container, Iterator, Mapping
from enum import IntEnum

from kontronik_can_gw.canopen.eds import CODECS, DOMAIN_TYPE, Eds, EdsEntry
from kontronik_can_gw.canopen.objects import Bound

Value = int | float | bytes
Read = Callable[[int], Value]
"""Returns a value at ``now``. SdoAbort if there is no value."""
Check = Callable[[int], None]
"""Raises SdoAbort for a value that must be refused."""
Written = Callable[[int], bool | None]
"""Acts on a download at ``now``. Returns False if it is confirmed later."""

_MAX_TEXT = 255
_MAX_DOMAIN = 0x10000


def key(index: int, sub: int) -> int:
    """Return index and sub-index as one number, as in the upper 24 bits of a PDO mapping."""
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
"""Values of objects that the EDS lacks, if not 0. They are the defaults of the shipped EDS."""


class Abort(IntEnum):
    """Reasons for refusing or ending an SDO transfer (CiA 301, 7.2.4.3.17, table 22)."""

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
    """The refusal of an access. The SDO server answers it with an abort frame."""

    def __init__(self, code: Abort) -> None:
        super().__init__(f"{code:08X}h {code.name}")
        self.code = code


class Variable:
    """One entry with its value. ``check`` may refuse a new value, and ``written`` acts on it."""

    __slots__ = ("bound", "check", "codec", "entry", "power_on", "read", "value", "written")

    def __init__(self, entry: EdsEntry) -> None:
        self.entry = entry
        self.codec = CODECS.get(entry.data_type)
        self.bound: Bound | None = None
        """The value of the ESC or the gateway that the object shows."""
        self.read: Read | None = None
        self.check: Check | None = None
        self.written: Written | None = None
        empty: Value = b"" if self.codec is None else 0
        self.power_on = empty if entry.default is None else entry.default
        self.value: Value = self.power_on

    @property
    def size(self) -> int | None:
        """Number of bytes of the type. None for texts and domains."""
        return None if self.codec is None else self.codec.size

    @property
    def max_size(self) -> int:
        """Maximum number of bytes that can be written."""
        if self.size is not None:
            return self.size
        return _MAX_DOMAIN if self.entry.data_type == DOMAIN_TYPE else _MAX_TEXT

    @property
    def is_readable(self) -> bool:
        return self.entry.access != "wo"

    @property
    def is_writable(self) -> bool:
        return "w" in self.entry.access

    def encode(self, value: Value) -> bytes:
        """Return the little-endian bytes of a value."""
        if self.codec is None:
            assert isinstance(value, bytes)
            return value
        return self.codec.pack(value)

    def decode(self, data: bytes) -> Value:
        """Return the value of bytes, which must have the right size."""
        if self.codec is None:
            return data
        value: Value = self.codec.unpack(data)[0]
        return value

    def check_limits(self, value: Value) -> None:
        """SdoAbort 06090031h or 06090032h for a number outside the limits of the EDS."""
        if isinstance(value, bytes):
            return
        low = self.entry.low
        high = self.entry.high
        if high is not None and not value <= high:
            raise SdoAbort(Abort.TOO_HIGH)
        if low is not None and not value >= low:
            raise SdoAbort(Abort.TOO_LOW)

    def default(self, node_id: int) -> Value:
        """Return the power-on value of a node with this node-ID, which replaces ``$NODEID``."""
        if self.entry.is_relative and isinstance(self.power_on, int):
            return self.power_on + node_id
        return self.power_on


def signature(word: bytes) -> Check:
    """Return a check that refuses any number except these four letters with 08000020h."""

    def check(value: int) -> None:
        if value != int.from_bytes(word, "little"):
            raise SdoAbort(Abort.TRANSFER)

    return check


def only(allowed: Container[int]) -> Check:
    """Return a check that refuses any other number with 06090030h."""

    def check(value: int) -> None:
        if value not in allowed:
            raise SdoAbort(Abort.VALUE)

    return check


def _ignore(_variable: Variable, _has_changed: bool, _now: int) -> None:
    """Do nothing after a download."""


class Dictionary:
    """All variables of one node.

    Reads and writes over the bus use ``upload`` and ``download``.
    """

    def __init__(self, eds: Eds) -> None:
        self.variables: dict[int, Variable] = {}
        """All variables by ``key``."""
        for entry in eds.entries:
            self.variables[key(entry.index, entry.sub)] = Variable(entry)
        self._indices = frozenset(entry.index for entry in eds.entries)
        self.read_only = False
        """True if all writes over the bus are refused."""
        self.written: Callable[[Variable, bool, int], None] = _ignore
        """Called after each download with the variable, True if its value changed, and the time."""

    def get(self, index: int, sub: int = 0) -> Variable | None:
        """Return the variable, or None if there is none."""
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
        """Bind an object to a service.

        ``read`` returns its value, ``check`` may refuse a new value, and ``written`` acts on a
        download. Nothing happens if the EDS lacks the object.
        """
        variable = self.get(index, sub)
        if variable is not None:
            variable.read = read
            variable.check = check
            variable.written = written

    def number(
        self,
        index: int,
        sub: int = 0,
        otherwise: int | None = None,
    ) -> int:
        """Return the whole number that a variable stores.

        Without such a variable it is ``otherwise``, or the shipped EDS's default if that is None.
        """
        variable = self.get(index, sub)
        if variable is not None and isinstance(variable.value, int):
            return variable.value
        if otherwise is not None:
            return otherwise
        return _IF_ABSENT.get(key(index, sub), 0)

    def subs(self, index: int) -> Iterator[Variable]:
        """Yield the variables of an array or record, beginning at sub-index 1."""
        for sub in range(1, 255):
            variable = self.get(index, sub)
            if variable is not None:
                yield variable

    def find(self, index: int, sub: int) -> Variable:
        """Return the variable. SdoAbort 06020000h or 06090011h if there is none."""
        variable = self.variables.get(key(index, sub))
        if variable is None:
            raise SdoAbort(Abort.NO_SUB_INDEX if index in self._indices else Abort.NO_OBJECT)
        return variable

    def value(self, variable: Variable, now: int) -> Value:
        """Return the present value of a variable. SdoAbort if its source has none."""
        return variable.value if variable.read is None else variable.read(now)

    # --- access of the SDO server

    def upload(self, index: int, sub: int, now: int) -> bytes:
        """Return the bytes of a variable. SdoAbort if it is absent, write only or has no value."""
        variable = self.find(index, sub)
        if not variable.is_readable:
            raise SdoAbort(Abort.WRITE_ONLY)
        return variable.encode(self.value(variable, now))

    def check_download(self, index: int, sub: int, size: int | None) -> int:
        """Check that ``size`` bytes (None: an unknown number) may be written, before the transfer.

        SdoAbort with the reason if not (CiA 301, 7.2.4.3.17). Returns the maximum number of bytes.
        """
        variable = self.find(index, sub)
        if self.read_only:
            raise SdoAbort(Abort.DEVICE_STATE)
        if not variable.is_writable:
            raise SdoAbort(Abort.READ_ONLY)
        if size is not None and size > variable.max_size:
            raise SdoAbort(Abort.TOO_LONG)
        if size is not None and size < (variable.size or 0):
            raise SdoAbort(Abort.TOO_SHORT)
        return variable.max_size

    def download(
        self,
        index: int,
        sub: int,
        data: bytes,
        now: int,
    ) -> bool:
        """Write a value. Returns False if it is confirmed later. SdoAbort if it is refused."""
        self.check_download(index, sub, len(data))
        variable = self.find(index, sub)
        value = variable.decode(data)
        variable.check_limits(value)
        if variable.check is not None:
            assert isinstance(value, int)
            variable.check(value)
        has_changed = self.value(variable, now) != value
        variable.value = value
        is_confirmed_later = variable.written is not None and variable.written(now) is False
        self.written(variable, has_changed, now)
        return not is_confirmed_later

    # --- power-on and storage

    def reset(
        self,
        indices: Container[int],
        node_id: int,
        stored: Mapping[int, bytes],
    ) -> list[int]:
        """Set the variables of these indices to their stored values, or else to their defaults.

        Returns the keys of stored values that were rejected because they do not fit this EDS.
        """
        held = self.variables
        rejected = [key for key in stored if key >> 8 in indices and key not in held]
        for number, variable in held.items():
            if number >> 8 not in indices:
                continue
            variable.value = variable.default(node_id)
            data = stored.get(number)
            if data is None:
                continue
            has_wrong_size = variable.size is not None and len(data) != variable.size
            if not variable.is_writable or has_wrong_size:
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

    def to_store(self, indices: Container[int], node_id: int) -> dict[int, bytes]:
        """Return the raw bytes of the variables that differ from their defaults.

        The others need not be stored, and so continue to follow ``$NODEID``.
        """
        changed = {}
        for number, variable in self.variables.items():
            if number >> 8 not in indices or variable.read is not None:
                continue
            if "rw" in variable.entry.access and variable.value != variable.default(node_id):
                changed[number] = variable.encode(variable.value)
        return changed
