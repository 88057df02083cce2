"""Emergencies: codes, error register 1001h, history 1003h, inhibit time 1015h (CiA 301, 7.2.7 and 7.5.2.2/4/17/18).

::

    byte  0..1          2       3                                4..7
    error code   1001h   ESC bit number, FFh: gateway   ESC's error word; gateway: byte 4 tells which, see GatewayError
"""

from collections import deque
from collections.abc import Callable
from enum import Enum
from typing import NamedTuple, Self

from kontronik_can_gw.canopen.heartbeat import NEVER
from kontronik_can_gw.esc.kontronik.states import OperatingError, Severity

GENERIC, CURRENT, VOLTAGE, TEMPERATURE, COMMUNICATION, MANUFACTURER = (
    0x01,
    0x02,
    0x04,
    0x08,
    0x10,
    0x80,
)
_REGISTER_OF_CLASS = {
    0x2: CURRENT,
    0x3: VOLTAGE,
    0x4: TEMPERATURE,
    0x8: COMMUNICATION,
    0xF: MANUFACTURER,
}
_FROM_GATEWAY = 0xFF
_MAX_PENDING = 64

_CODES = {
    OperatingError.UNDERVOLTAGE: 0x3220,
    OperatingError.OVERVOLTAGE: 0x3210,
    OperatingError.OVERCURRENT_INTEGRAL_ERROR: 0x2350,
    OperatingError.OVERCURRENT_INTEGRAL_WARNING: 0x2351,
    OperatingError.POWER_STAGE_OVERTEMP_ERROR: 0x4210,
    OperatingError.BEC_UNDERVOLTAGE: 0x5114,
    OperatingError.BEC_OVERVOLTAGE: 0x5115,
    OperatingError.BEC_OVERCURRENT: 0x2220,
    OperatingError.BEC_OVERTEMPERATURE: 0x4410,
    OperatingError.OPERATING_ERROR_FOUND: 0x1000,
    OperatingError.SELFTEST_ERROR: 0x5000,
    OperatingError.EEPROM_ERROR: 0x5530,
    OperatingError.WATCHDOG_ERROR_TRIPPED: 0x6010,
}
_ERROR_BITS = sum(1 << bit for bit in OperatingError if bit.severity is Severity.ERROR)
_WARNING_BITS = sum(1 << bit for bit in OperatingError if bit.severity is Severity.WARNING)
_SUMMARIES = (
    (1 << OperatingError.OPERATING_ERROR_FOUND, _ERROR_BITS),
    (1 << OperatingError.OPERATING_WARNING_FOUND, _WARNING_BITS),
)
_SUMMARY_BITS = sum(bit for bit, _ in _SUMMARIES)


class GatewayError(Enum):
    """What the gateway itself finds. ``value``: error code, byte 4."""

    meaning: str
    remedy: str
    """What a person should do."""

    def __new__(cls, code: int, detail: int, meaning: str, remedy: str) -> Self:
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
        "Check the USB adapter and its plug. It is tried again for ever; kontronik-can-gw doctor says more.")
    OTHER_DEVICE = (0x7510, 4, "another device than [esc].device says",
        "Check which ESC is plugged in where, or correct device in the configuration.")
    RECEIVE_OVERRUN = (0x8110, 0, "received CAN frames were lost",
        "Let masters send less at once; look for somebody who floods the bus.")
    CAN_PASSIVE = (0x8120, 0, "CAN controller error passive",
        "Check bit rate, termination (120 ohm at both ends) and cables of the bus, and that another node is switched on.")
    HEARTBEAT_LOST = (0x8130, 0, "a watched heartbeat stayed away; byte 4: the node-ID",
        "Check that node, its supply and its bus cable, and the time in 1016h.")
    BUS_OFF_LEFT = (0x8140, 0, "back from bus-off",
        "Look for a short, a wrong bit rate or a bad cable on the bus.")
    ID_COLLISION = (0x8150, 0, "somebody else sends with an id of this node: two nodes with one node-ID?",
        "Give each node of the bus another node-ID, and each message another id.")
    SYNC_LENGTH = (0x8240, 0, "SYNC of a wrong length",
        "Let the master send SYNC as 1019h says: without data, or with one byte where it has a counter.")
    PARAMETER_FILE = (0x6300, 0, "the parameter file could not be read: defaults",
        "Let the master store its parameters anew, or restore the file. Check the disk.")
    # fmt: on


_OF_COMMUNICATION = frozenset(
    error.value[0] for error in (GatewayError.HEARTBEAT_LOST, GatewayError.SYNC_LENGTH)
)


class Condition(NamedTuple):
    """Something that is wrong."""

    code: int
    source: int
    """ESC bit number, FFh: gateway."""
    detail: int
    """Byte 4 of a gateway error; 0 for an ESC's bit, whose word is told."""


def code_of_bit(bit: int) -> int:
    """The emergency code of an ESC's error bit: a standard one where there is one, else FF00h + bit."""
    return _CODES.get(bit, 0xFF00 + bit)  # type: ignore[call-overload, no-any-return]


def told_bits(word: int, mask: int) -> int:
    """The bits of an ESC's error word that get an emergency: those in the mask, a summary bit only where it is not explained by another."""
    bits = word & mask
    for summary, explained_by in _SUMMARIES:
        if word & explained_by & ~_SUMMARY_BITS:
            bits &= ~summary
    return bits


def register_of(code: int) -> int:
    """The bits of 1001h that an error code sets: the generic one and that of its class."""
    return GENERIC | _REGISTER_OF_CLASS.get(code >> 12, 0)


class Emergencies:
    """State of one node's errors. ``send`` is called with the 8 bytes of each emergency; False: none is sent."""

    def __init__(self, send: Callable[[bytes], bool], history_size: int) -> None:
        self._send = send
        self.history: deque[int] = deque(maxlen=history_size)
        """1003h, newest first: bits 15..0 code, 23..16 byte 3, 31..24 byte 4."""
        self.mask = 0xFFFFFFFF
        self.inhibit_ns = 0
        self.word = 0
        """The ESC's error word."""
        self._word_register = 0
        self._active: dict[Condition, None] = {}
        self._untold: dict[Condition, None] = {}
        self._told = False  # what was sent last is an error, not 0000h
        self._pending: deque[tuple[Condition | None, bytes]] = deque(maxlen=_MAX_PENDING)
        self._open = False
        self._last_ns = -NEVER
        self._risen = False  # since the last reset something was wrong

    @property
    def register(self) -> int:
        """1001h."""
        register = self._word_register
        for condition in self._active:
            register |= register_of(condition.code)
        return register

    @property
    def code(self) -> int:
        """The newest error's code that is still there, 0 without one (603Fh)."""
        return next(reversed(self._active)).code if self._active else 0

    @property
    def due(self) -> int:
        return self._last_ns + self.inhibit_ns if self._pending else NEVER

    def set_word(self, word: int, now: int, force: bool = False) -> None:
        """The ESC's error word of a new live frame (or, with ``force``, a new mask)."""
        if word == self.word and not force:
            return
        self.word = word
        bits = told_bits(word, self.mask)
        self._word_register = 0
        registered = word & (_ERROR_BITS & ~_SUMMARY_BITS) | bits
        for bit in range(32):
            if registered >> bit & 1:
                self._word_register |= register_of(code_of_bit(bit))
        wanted = {Condition(code_of_bit(bit), bit, 0): None for bit in range(32) if bits >> bit & 1}
        gone = [c for c in self._active if c.source != _FROM_GATEWAY and c not in wanted]
        for condition in gone:
            del self._active[condition]
        for condition in wanted:
            if condition not in self._active:
                self._rise(condition, now)
        self._end(now)

    def set(self, error: GatewayError, present: bool, now: int, detail: int | None = None) -> None:
        """One of the gateway's own findings begins or ends."""
        code, which = error.value
        condition = Condition(code, _FROM_GATEWAY, which if detail is None else detail)
        if present and condition not in self._active:
            self._rise(condition, now)
        elif not present and condition in self._active:
            del self._active[condition]
            self._end(now)

    def pulse(self, error: GatewayError, now: int) -> None:
        """A finding that is over as soon as it is told."""
        self.set(error, True, now)
        self.set(error, False, now)

    def open(self, now: int) -> None:
        """Emergencies may be sent (PRE-OPERATIONAL, OPERATIONAL): what rose and is still there is told."""
        self._open = True
        for condition in self._untold:
            if condition in self._active:
                self._tell(condition)
        self._untold = {}
        self._end(now)
        self.advance(now)

    def close(self) -> None:
        """No emergencies (STOPPED): what waits is told later, if it is still true then."""
        self._open = False
        self._untold |= {condition: None for condition, _ in self._pending if condition is not None}
        self._pending.clear()

    def reset(self) -> None:
        """Reset communication: what is wrong counts as untold and is all that the history holds; heartbeats and SYNC are watched anew."""
        self.close()
        self._active = {
            condition: None for condition in self._active if condition.code not in _OF_COMMUNICATION
        }
        self.history.clear()
        for condition in self._active:
            self._note(condition)
        self._told = False
        self._untold = dict(self._active)
        self._risen = bool(self._active)
        self._last_ns = -NEVER

    def tell_again(self, now: int) -> None:
        """After an outage in which emergencies were lost: tell all that is wrong once more, or that nothing is."""
        was_open = self._open
        self.close()
        self._untold = dict(self._active)
        self._told = self._risen
        if was_open:
            self.open(now)

    def advance(self, now: int) -> None:
        """Send what waits, no closer than the inhibit time."""
        while self._pending and now >= self._last_ns + self.inhibit_ns:
            condition, data = self._pending.popleft()
            if self._send(data):
                self._told = condition is not None
                self._last_ns = now

    def _rise(self, condition: Condition, now: int) -> None:
        self._active[condition] = None
        self._risen = True
        self._note(condition)
        if self._open:
            self._tell(condition)
            self.advance(now)
        else:
            self._untold[condition] = None

    def _note(self, condition: Condition) -> None:
        self.history.appendleft(condition.detail << 24 | condition.source << 16 | condition.code)

    def _end(self, now: int) -> None:
        """Take back what was told, or still waits to be, when nothing is wrong any more."""
        owed = self._pending[-1][0] is not None if self._pending else self._told
        if owed and self._open and not self._active:
            self._tell(None)
            self.advance(now)

    def _tell(self, condition: Condition | None) -> None:
        if condition is None:
            head, tail = bytes((0, 0, self.register, _FROM_GATEWAY)), bytes(4)
        else:
            head = condition.code.to_bytes(2, "little") + bytes((self.register, condition.source))
            from_gateway = condition.source == _FROM_GATEWAY
            tail = (condition.detail if from_gateway else self.word).to_bytes(4, "little")
        # the newest is never the one that finds no room
        self._pending.append((condition, head + tail))
