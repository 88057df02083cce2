"""Error codes of emergencies, and the register bits they set.

See CiA 301, 7.2.7.1 and 7.5.2.2, table 26. The 8 bytes of an emergency::

    byte 0..1   error code
    byte 2      error register 1001h
    byte 3      bit number in the ESC's error word, FFh: detected by the gateway
    byte 4..7   the ESC's error word, or the detail of a gateway error in byte 4
"""

from collections.abc import Iterator, Sequence
from enum import Enum, IntFlag
from typing import NamedTuple, Self

from kontronik_can_gw.esc.decoder import ErrorBit, Severity


class Register(IntFlag):
    """Bits of the error register 1001h."""

    GENERIC = 0x01
    CURRENT = 0x02
    VOLTAGE = 0x04
    TEMPERATURE = 0x08
    COMMUNICATION = 0x10
    MANUFACTURER = 0x80


_REGISTER_OF_CLASS = {
    0x2: Register.CURRENT,
    0x3: Register.VOLTAGE,
    0x4: Register.TEMPERATURE,
    0x8: Register.COMMUNICATION,
    0xF: Register.MANUFACTURER,
}
FROM_GATEWAY = 0xFF
"""Byte 3 of an error that the gateway detected."""


class GatewayError(Enum):
    """An error that the gateway detects. Its ``value`` is the error code and byte 4."""

    meaning: str
    remedy: str
    """Advice for the user."""

    def __new__(
        cls,
        code: int,
        detail: int,
        meaning: str,
        remedy: str,
    ) -> Self:
        member = object.__new__(cls)
        member._value_ = code, detail
        member.meaning = meaning
        member.remedy = remedy
        return member

    # fmt: off
    TELEMETRY_LOST = (0x7510, 1, "telemetry lost",
        "Check that the ESC is switched on, its telemetry setting, and the cable to the gateway.")
    CRC_RATE = (0x7510, 2, "telemetry degraded: many CRC errors or dropped bytes",
        "Keep the telemetry cable short and away from the motor's wires. Check plugs and ground.")
    PORT_GONE = (0x7510, 3, "serial port gone",
        ("Check the USB adapter and its plug. The gateway retries by itself. "
         "kontronik-can-gw doctor shows details."))
    OTHER_DEVICE = (0x7510, 4, "not the device of esc.device",
        "Check which ESC is connected to which port, or correct esc.device in the configuration.")
    RECEIVE_OVERRUN = (0x8110, 0, "received CAN frames were lost",
        "Let masters send fewer frames at once, and look for a device that floods the bus.")
    CAN_PASSIVE = (0x8120, 0, "CAN controller error passive",
        ("Check bit rate, termination (120 ohm at both ends) and cables of the bus. "
         "Check that another node is switched on."))
    HEARTBEAT_LOST = (0x8130, 0, "a watched heartbeat is missing (byte 4: the node-ID)",
        "Check that node, its supply and its bus cable, and the time in 1016h.")
    BUS_OFF_LEFT = (0x8140, 0, "back from bus-off",
        "Look for a short, a wrong bit rate or a bad cable on the bus.")
    ID_COLLISION = (0x8150, 0,
        "another device sends with an id of this node: two nodes with one node-ID?",
        "Give each node on the bus its own node-ID, and each message its own id.")
    SYNC_LENGTH = (0x8240, 0, "SYNC with a wrong length",
        ("Configure the master to send SYNC as 1019h defines it: "
         "without data, or with one byte if it has a counter."))
    PARAMETER_FILE = (0x6300, 0, "the parameter file could not be read, so defaults are used",
        "Let the master store its parameters again, or restore the file. Check the disk.")
    # fmt: on


OF_COMMUNICATION = frozenset(
    error.value[0] for error in (GatewayError.HEARTBEAT_LOST, GatewayError.SYNC_LENGTH)
)
"""Error codes that a reset of communication ends."""


class PresentError(NamedTuple):
    """An error while it is present."""

    code: int
    source: int
    """Bit number in the ESC's error word, or FROM_GATEWAY."""
    detail: int
    """Byte 4 of a gateway error. 0 for a bit of the ESC, whose whole word is sent instead."""


def register_of(code: int) -> int:
    """Return the bits of 1001h that an error code sets: the generic bit and its class's bit."""
    class_bit = _REGISTER_OF_CLASS.get(code >> 12, 0)
    return int(Register.GENERIC | class_bit)


class BitCodes:
    """The emergency codes of an ESC's error word, whose bits the ESC's protocol lists."""

    def __init__(self, bits: Sequence[ErrorBit]) -> None:
        self._codes: dict[int, int] = {}
        self._summaries: list[tuple[int, int]] = []
        """Each summary bit with all bits of its severity, which explain it."""
        for bit in bits:
            if bit.code is not None:
                self._codes[int(bit)] = bit.code
            if bit.is_summary:
                explained_by = _mask_of(bits, bit.severity)
                self._summaries.append((1 << bit, explained_by))
        self._summary_bits = sum(bit for bit, _ in self._summaries)
        self._error_bits = _mask_of(bits, Severity.ERROR)

    def code(self, bit: int) -> int:
        """Return the emergency code of a bit: a standard code if there is one, else FF00h + bit."""
        return self._codes.get(bit, 0xFF00 + bit)

    def of(self, word: int, mask: int) -> tuple[tuple[PresentError, ...], int]:
        """Return the errors of an error word that cause emergencies, and the bits of 1001h.

        Each bit in the mask causes an emergency, a summary bit only if no other bit explains it.
        1001h shows all errors, and the warnings in the mask.
        """
        summary_free = word & ~self._summary_bits
        bits = word & mask
        for summary, explained_by in self._summaries:
            if summary_free & explained_by:
                bits &= ~summary
        register = 0
        for bit in _bits_of(summary_free & self._error_bits | bits):
            register |= register_of(self.code(bit))
        conditions = tuple(PresentError(self.code(bit), bit, 0) for bit in _bits_of(bits))
        return conditions, register


def _mask_of(bits: Sequence[ErrorBit], severity: Severity) -> int:
    """Return the mask of all bits of this severity."""
    return sum(1 << bit for bit in bits if bit.severity is severity)


def _bits_of(word: int) -> Iterator[int]:
    return (bit for bit in range(32) if word >> bit & 1)
