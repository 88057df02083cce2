"""The frames that a DBC defines, derived from its physical values as exact fractions.

This is the specification of the proof. The rest of the package supplies only the user's input: the
DBC as cantools reads it, the names to which signals bind, the roles of counters and CRCs, E2E
profiles and data IDs, and the spellings of units. Limits, codes, factors and bit positions are
derived here a second time, from the text of docs/dbc.md and docs/your-own-dbc.md. Messages, CAN ids
and the ESC of each copy are derived in messages.py.
"""

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from specification.quantities import QUANTITIES, size
from specification.rule import Described, Rule, Shape

from dbc_proof.end_to_end import COUNTERS, CrcRule, expected_rule
from dbc_proof.messages import SentMessage, sent_messages
from dbc_proof.sending import Sending, attribute_of, has_own_attribute, sending_of
from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.dbc.e2e_attributes import role_of
from kontronik_can_gw.dbc.names import Binder, is_data_id, protection
from kontronik_can_gw.dbc.protection import assumed_data_ids, stated_data_ids, stated_profile
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.signals import units
from kontronik_can_gw.signals.plan import Role

if TYPE_CHECKING:
    from cantools.database.can import Database, Signal


@dataclass(frozen=True)
class ExpectedSignal:
    """A signal on one group."""

    name: str
    source: str
    """Name of its value, or "" without a source."""
    unit: str
    page: int | None
    bits: tuple[int, ...]
    """Position in the frame of each bit of the raw value, counted from bit 0 of byte 0."""
    rule: Rule | None
    """None if the specification does not cover the signal."""
    reason: str = ""
    """The reason in that case."""


@dataclass(frozen=True)
class ExpectedMessage:
    """A message on the bus."""

    name: str
    can_id: int
    extended: bool
    length: int
    pages: tuple[int | None, ...]
    crc: CrcRule | None
    """None without a CRC."""
    multiplexer: tuple[int, ...]
    """Bits of the multiplexer. Empty without one."""
    signals: tuple[ExpectedSignal, ...]
    sending: Sending | None
    """None if the specification does not cover one of its values."""


def expected_messages(
    database: "Database", escs: Sequence[EscSettings], settings: DbcConfig
) -> Iterator[ExpectedMessage]:
    """Yield the messages of the gateway in the order of the file."""
    binder = Binder(escs, settings.bind)
    for sent in sent_messages(database, escs, settings):
        yield _message(database, sent, binder, settings)


def _message(
    database: "Database", sent: SentMessage, binder: Binder, settings: DbcConfig
) -> ExpectedMessage:
    message = sent.message
    pages: set[int] = set()
    for signal in message.signals:
        pages.update(signal.multiplexer_ids or ())
    multiplexer: tuple[int, ...] = ()
    signals = []
    protection = _protection(database, sent, binder, settings)
    for signal in message.signals:
        if signal.is_multiplexer:
            multiplexer = bits_of(signal)
            continue
        for page in signal.multiplexer_ids or (None,):
            made = _Signal(database, sent, signal, binder, settings, protection).made(page)
            signals.append(made)
    return ExpectedMessage(
        name=sent.name,
        can_id=sent.can_id,
        extended=message.is_extended_frame,
        length=message.length,
        pages=tuple(sorted(pages)) or (None,),
        crc=None if protection is None else expected_rule(*protection),
        multiplexer=multiplexer,
        signals=tuple(signals),
        sending=_sending(database, sent, settings, signals, len(pages) or 1),
    )


def _sending(
    database: "Database",
    sent: SentMessage,
    settings: DbcConfig,
    signals: Sequence[ExpectedSignal],
    pages: int,
) -> Sending | None:
    paces = set()
    escs = set()
    alive_values = 1
    for signal in signals:
        if signal.rule is None:
            return None
        if signal.rule.quantity is not None:
            paces.add(signal.rule.quantity.pace)
        if signal.rule.esc is not None:
            escs.add(signal.rule.esc)
        if signal.rule.shape is Shape.ALIVE:
            alive_values = signal.rule.modulus
    return sending_of(database, sent.message, settings, paces, pages, escs, alive_values)


def _protection(
    database: "Database",
    sent: SentMessage,
    binder: Binder,
    settings: DbcConfig,
) -> tuple[str, tuple[int, ...]] | None:
    """Return E2E profile and data IDs of a message. None without a CRC."""
    if not _has_crc(database, sent, binder):
        return None
    profile, _ = stated_profile(settings, database, sent.for_binder)
    if profile is None:
        return "1A", assumed_data_ids(settings, database, sent.for_binder)
    return profile.name, stated_data_ids(settings, database, sent.for_binder, profile)


def _has_crc(database: "Database", sent: SentMessage, binder: Binder) -> bool:
    for signal in sent.message.signals:
        bound = binder.bound(sent.for_binder, signal.name)
        name = signal.name if bound is None else bound
        if not isinstance(name, str):
            continue
        stated = role_of(signal, database) if bound is None else None
        if stated is None and binder.by_name(name, sent.esc) is not None:
            continue
        if (stated or protection(name)) is Role.CRC and not signal.is_multiplexer:
            return True
    return False


def bits_of(signal: "Signal") -> tuple[int, ...]:
    """Return the position in the frame of each bit of a raw value, from the least significant.

    A DBC gives the least significant bit of an Intel signal and the most significant bit of a
    Motorola signal. Both number bits from the least significant bit of byte 0.
    """
    if signal.byte_order == "little_endian":
        return tuple(range(signal.start, signal.start + signal.length))
    byte, bit = divmod(signal.start, 8)
    found = []
    for _ in range(signal.length):
        found.append(8 * byte + bit)
        bit -= 1
        if bit < 0:
            byte += 1
            bit = 7
    return tuple(reversed(found))


class _Signal:
    """Makes the specification of one signal of the file."""

    def __init__(
        self,
        database: "Database",
        sent: SentMessage,
        signal: "Signal",
        binder: Binder,
        settings: DbcConfig,
        protection: tuple[str, tuple[int, ...]] | None,
    ) -> None:
        self.database = database
        self.sent = sent
        self.signal = signal
        self.binder = binder
        self.settings = settings
        self.protection = protection
        """E2E profile and data IDs of the message. None without a CRC."""
        self.unit = _unit(signal, settings)
        start, has_own_start = self._start_value()
        self.described = Described(
            length=signal.length,
            signed=signal.is_signed,
            is_float=signal.is_float,
            factor=_exact(signal.scale),
            offset=_exact(signal.offset),
            limits=(_exact(signal.minimum or 0), _exact(signal.maximum or 0)),
            texts=[(int(raw), str(text)) for raw, text in (signal.choices or {}).items()],
            start=start,
            has_own_start=has_own_start,
        )

    def made(self, page: int | None) -> ExpectedSignal:
        """Return the specification on a group."""
        name = self.sent.prefix + self.signal.name
        bits = bits_of(self.signal)
        source = ""
        rule: Rule | None = None
        reason = ""
        bound = self.binder.bound(self.sent.for_binder, self.signal.name)
        if isinstance(bound, (int, float)):
            offset, factor = self.described.offset, self.described.factor
            rule = self._constant((_exact(bound) - offset) / factor)
        else:
            role = role_of(self.signal, self.database) if bound is None else None
            known_name = bound or self.signal.name
            found = None if role else self.binder.by_name(known_name, self.sent.esc)
            if found is not None:
                value, esc = found
                source = value.name
                if not value.supplied:
                    reason = "its protocol does not supply the value"
                elif value.name not in QUANTITIES:
                    reason = f"{value.name} is not in the protocol specification of the proof"
                else:
                    quantity = QUANTITIES[value.name]
                    conversion = _conversion(quantity.unit, self.unit)
                    on_loss = self.settings.flags_on_loss
                    rule = self.described.of_quantity(quantity, esc, conversion, on_loss)
            elif self._has_data_id_nibble and is_data_id(known_name):
                assert self.protection is not None
                rule = self._constant(self.protection[1][0] >> 8 & 0xF)
            else:
                rule = self._without_source(role or protection(known_name))
        return ExpectedSignal(name, source, self.unit, page, bits, rule, reason)

    @property
    def _has_data_id_nibble(self) -> bool:
        """True if the frame contains 4 bits of the data ID."""
        return self.protection is not None and self.protection[0] in ("1C", "11C")

    def _start_value(self) -> tuple[int | None, bool]:
        """Return the raw start value, and True if this signal has one of its own.

        None if there is none, or if the signal cannot hold it.
        """
        start = attribute_of(self.signal, "GenSigStartValue", self.database)
        own = has_own_attribute(self.signal, "GenSigStartValue")
        if not isinstance(start, (int, float)):
            return None, own
        if self.signal.is_float:
            return _float_bits(start, self.signal.length), own
        raw = _exact(start)
        lowest = -(1 << self.signal.length - 1) if self.signal.is_signed else 0
        fits = raw.denominator == 1 and 0 <= raw - lowest < 1 << self.signal.length
        return (int(raw) if fits else None), own

    def _constant(self, raw: Fraction | int | None) -> Rule:
        """Return the rule of a constant with an exact raw value."""
        if self.signal.is_float:
            bits = raw if isinstance(raw, int) else _float_bits(raw or 0, self.signal.length)
        else:
            assert raw is None or raw == int(raw)
            bits = int(raw or 0)
        base = self.described.base()
        return replace(base, shape=Shape.CONSTANT, constant=bits, codes=frozenset())

    def _without_source(self, role: Role | None) -> Rule:
        """Return the rule of a counter of frames, a CRC, or a signal that is bound to nothing."""
        described = self.described
        if role is Role.CRC:
            return replace(described.base(), shape=Shape.CRC)
        if role is Role.ALIVE:
            most = None if self.protection is None else COUNTERS[self.protection[0]]
            return described.counted(Shape.ALIVE, most)
        named = described.named_not_available
        if named and not described.has_own_start:
            if self.signal.is_float:
                return self._constant(_float_bits(named[0], self.signal.length))
            return self._constant(named[0])
        return self._constant(described.start)


def _exact(number: Any) -> Fraction:
    """Return the decimal number that the file has."""
    return Fraction(str(number))


def _float_bits(number: Any, length: int) -> int:
    packed = struct.pack("<f" if length == 32 else "<d", float(number))
    return int.from_bytes(packed, "little")


def _unit(signal: "Signal", settings: DbcConfig) -> str:
    text = (signal.unit or "").strip()
    return settings.units.get(text, text)


def _conversion(source: str, target: str) -> tuple[Fraction, Fraction]:
    """Return (m, b), so that ``value in target = value in source * m + b``."""
    if units.says_nothing(target):
        return Fraction(1), Fraction(0)
    targets = units.shown(target)
    for quantity, unit in units.shown(source or "1").items():
        if quantity in targets:
            scale, shift = size(quantity, unit)
            target_scale, target_shift = size(quantity, targets[quantity])
            return scale / target_scale, (shift - target_shift) / target_scale
    raise KeyError(target)
