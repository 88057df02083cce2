"""Proves each signal of a compiled DBC, or finds counter-examples."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from fractions import Fraction
from typing import TYPE_CHECKING

from specification.rule import Rule, Shape

from dbc_proof import words
from dbc_proof.end_to_end import CrcRule
from dbc_proof.expected import ExpectedMessage, ExpectedSignal, expected_messages
from dbc_proof.formulas import Settings, Verdict, compare, received
from dbc_proof.planned import (
    INT64_END,
    Planned,
    PlannedMessage,
    PlannedSignal,
    of_c,
    of_python,
    products,
    wrong_settings,
    wrong_tables,
)
from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.native.rows import NotInCore
from kontronik_can_gw.native.tables import Tables
from kontronik_can_gw.signals.packer import place
from kontronik_can_gw.signals.plan import MessageLayout, Piece

if TYPE_CHECKING:
    from cantools.database.can import Database

IS_FLOAT = "a float"
IS_CRC = "a CRC: only its place and its numbers are compared"
"""Reasons why a signal is not proven. The third one is that the solver gave up."""
_FLOAT_END = 1 << 62
"""The core in C divides smaller numbers for a float (core.c, quotient)."""


@dataclass
class Findings:
    """The result of a proof. Each text begins with the message and the signal."""

    proven: list[str] = field(default_factory=list)
    """Signals that are proven completely."""
    unproven: list[str] = field(default_factory=list)
    """Signals about which nothing is known, with the reason."""
    refuted: list[str] = field(default_factory=list)
    """Counter-examples."""
    refuted_signals: list[str] = field(default_factory=list)
    """Signals with a counter-example, and all signals of a message that is wrong or missing."""
    without_code: list[str] = field(default_factory=list)
    """Proven signals whose code for "not available" is also a value."""
    only_python: str = ""
    """The reason why only the core in Python can send the layout, or ""."""

    def add(self, other: "Findings") -> None:
        """Add the signals of other findings."""
        self.proven += other.proven
        self.unproven += other.unproven
        self.refuted += other.refuted
        self.refuted_signals += other.refuted_signals
        self.without_code += other.without_code


class Proof:
    """The proof of one layout.

    Iterate over ``messages``. Afterwards ``findings`` is complete.
    """

    def __init__(
        self,
        database: "Database",
        layout: MessageLayout,
        escs: Sequence[EscSettings],
        settings: DbcConfig,
        quiet_after_ns: int = 0,
    ) -> None:
        self.findings = Findings()
        self._layout = layout
        self._escs = escs
        self._expected = [*expected_messages(database, escs, settings)]
        self._prover = Prover(escs)
        is_silent = settings.silent_on_loss
        self._core_settings = CoreSettings(escs, layout, is_silent, quiet_after_ns)
        self._quiet_after_ns = quiet_after_ns
        self.tables: Tables | None = None
        """The numbers that the core in C gets. None if it cannot send the layout."""
        try:
            self.tables = Tables(self._core_settings)
        except NotInCore as error:
            self.findings.only_python = str(error)

    def messages(self) -> Iterator[str]:
        """Prove one message after the other. Yields the name of each before it is proven."""
        self.findings = Findings(only_python=self.findings.only_python)
        plans: dict[str, list[int]] = {}
        for number, plan in enumerate(self._layout.messages):
            plans.setdefault(plan.name, []).append(number)
        for expected in self._expected:
            yield expected.name
            numbers = plans.pop(expected.name, [])
            if not numbers:
                self.findings.refuted.append(f"{expected.name}: is in the DBC, but is never sent")
                self.findings.refuted_signals += _names(expected)
                continue
            if len(numbers) > 1:
                self.findings.refuted.append(f"{expected.name}: is sent {len(numbers)} times")
            number = numbers[0]
            plan = self._layout.messages[number]
            cores = [of_python(plan, self._core_settings)]
            if self.tables is not None:
                cores.append(of_c(plan, number, self.tables, expected.pages))
            self._prover.prove(expected, cores, self.findings)
        for name in plans:
            self.findings.refuted.append(f"{name}: is sent, but is not a message of the gateway")
        if self.tables is not None:
            by_name = {each.name: (len(each.pages), each.sending) for each in self._expected}
            known = [by_name[plan.name] for plan in self._layout.messages if plan.name in by_name]
            wrong = [*wrong_tables(known, self.tables, self._quiet_after_ns)]
            wrong += wrong_settings(self._escs, self.tables)
            self.findings.refuted += [f"tables of the core in C: {text}" for text in wrong]

    def complete(self) -> Findings:
        """Prove all messages, and return the findings."""
        for _ in self.messages():
            pass
        return self.findings


class Prover:
    """Compares messages with their plans. Equal problems are solved once."""

    def __init__(self, escs: Sequence[EscSettings]) -> None:
        self._escs = escs
        self._solved: dict[object, Verdict] = {}

    def prove(
        self, expected: ExpectedMessage, plans: Sequence[PlannedMessage], findings: Findings
    ) -> None:
        """Add the results of one message. ``plans`` has the plan of each core that can send it."""
        wrong = [
            f"{expected.name}: {problem}"
            for plan in plans
            for problem in _frame_problems(expected, plan)
        ]
        findings.refuted += dict.fromkeys(wrong)
        own = Findings()
        self._prove_signals(expected, plans, own)
        if wrong:
            own = Findings(refuted=own.refuted, refuted_signals=_names(expected))
        findings.add(own)

    def _prove_signals(
        self, expected: ExpectedMessage, plans: Sequence[PlannedMessage], findings: Findings
    ) -> None:
        by_name: dict[str, list[ExpectedSignal]] = {}
        for signal in expected.signals:
            by_name.setdefault(signal.name, []).append(signal)
        for name, signals in by_name.items():
            self._prove_signal(f"{expected.name}.{name}", signals, plans, findings)

    def _prove_signal(
        self,
        where: str,
        pages: Sequence[ExpectedSignal],
        plans: Sequence[PlannedMessage],
        findings: Findings,
    ) -> None:
        """Add the result of a signal on all of its groups, for each core."""
        refuted: list[str] = []
        reasons: list[str] = []
        for signal in pages:
            if signal.rule is None:
                reasons.append(signal.reason)
                continue
            for plan in plans:
                refuted += self._counter_examples(signal, signal.rule, plan, reasons)
            refuted += _shared_codes(signal, signal.rule)
        if refuted:
            findings.refuted += [f"{where}: {text}" for text in dict.fromkeys(refuted)]
            findings.refuted_signals.append(where)
        elif reasons:
            findings.unproven.append(f"{where}: {reasons[0]}")
        else:
            findings.proven.append(where)
            if any(signal.rule is not None and _lacks_code(signal.rule) for signal in pages):
                findings.without_code.append(where)

    def _counter_examples(
        self, signal: ExpectedSignal, rule: Rule, plan: PlannedMessage, reasons: list[str]
    ) -> Iterator[str]:
        """Yield counter-examples of one plan. Adds a line to ``reasons`` if nothing is known."""
        if rule.shape is Shape.CONSTANT:
            yield from _wrong_constant(signal, rule, plan)
            return
        if rule.shape is Shape.CRC:
            yield from _wrong_crc(signal, plan)
            reasons.append(IS_CRC)
            return
        found = [each for each in plan.signals if _is_on(each, signal)]
        if len(found) != 1:
            yield f"is sent {len(found)} times in a frame"
            return
        (planned,) = found
        yield from _wrong_bits(signal, rule, planned.pieces)
        if planned.planned is not None and planned.planned.length != rule.length:
            yield f"is sent as a number of {planned.planned.length} bits, not {rule.length}"
        if rule.shape is Shape.ALIVE:
            if planned.planned is not None or planned.modulus != rule.modulus:
                yield f"counts {planned.modulus} frames before it restarts, not {rule.modulus}"
            return
        if planned.planned is None:
            yield "is sent as a counter of frames"
            return
        if planned.planned.esc != rule.esc:
            wanted = self._name(rule.esc)
            yield f"contains a value of {self._name(planned.planned.esc)}, not of {wanted}"
            return
        overflow = _overflow(signal, planned.planned)
        if overflow is not None:
            yield overflow
            return
        if rule.shape is Shape.FLOAT:
            reasons.append(IS_FLOAT)
            return
        if planned.planned.is_float:
            yield "is sent as a float"
            return
        verdict = self._verdict(rule, planned.planned)
        if verdict.counter_example is not None:
            yield words.counter_example(signal, verdict.counter_example)
        elif verdict.reason:
            reasons.append(verdict.reason)

    def _name(self, esc: int | None) -> str:
        return "the gateway" if esc is None else f"ESC {self._escs[esc].name}"

    def _verdict(self, rule: Rule, plan: Planned) -> Verdict:
        """Return the verdict about a plan. Copies for other ESCs have the same."""
        esc = self._escs[rule.esc or 0]
        settings = Settings(esc.pole_pairs, esc.gear, esc.cell_count or 1)
        normal = replace(plan, esc=None)
        rule = replace(rule, esc=None)
        key = (repr(rule), repr(normal), settings)
        if key not in self._solved:
            self._solved[key] = compare(rule, normal, settings)
        return self._solved[key]


def _names(message: ExpectedMessage) -> list[str]:
    """Return the names of a message's signals as they are in the findings."""
    return list(dict.fromkeys(f"{message.name}.{signal.name}" for signal in message.signals))


def _is_on(planned: PlannedSignal, signal: ExpectedSignal) -> bool:
    return planned.name == signal.name and planned.page == signal.page


def _lacks_code(rule: Rule) -> bool:
    """Return True if the code for "not available" may also be sent for a value."""
    if rule.quantity is None or rule.has_code or rule.shape is Shape.COUNTER:
        return False
    if rule.shape is Shape.FLAG:
        return True
    if rule.shape is Shape.NAMES:
        return rule.not_available in rule.numbers.values()
    return replace(rule, codes=frozenset()).is_value(rule.not_available)


def _shared_codes(signal: ExpectedSignal, rule: Rule) -> Iterator[str]:
    """Yield the counter values that are codes of the value table."""
    if rule.shape in (Shape.ALIVE, Shape.COUNTER):
        for code in sorted(code for code in rule.codes if 0 <= code < rule.modulus):
            name = signal.source.replace("_", " ") or "the counter"
            yield f"{name} {code} is sent as {words.sent(signal, code)}"


def _frame_problems(expected: ExpectedMessage, plan: PlannedMessage) -> Iterator[str]:
    """Yield the differences in id, length and constant bits."""
    if (plan.can_id, plan.extended) != (expected.can_id, expected.extended):
        yield f"is sent with CAN id {_id(plan)}, not {_id(expected)}"
    if plan.length != expected.length:
        yield f"is sent with {plan.length} bytes, not {expected.length}"
    yield from plan.wrong_rows
    if expected.sending is not None:
        for name, wanted_number in asdict(expected.sending).items():
            number = getattr(plan.sending, name)
            if number != wanted_number:
                yield f"has {name.replace('_', ' ')} {number}, not {wanted_number}"
    if plan.crc is not None and expected.crc is not None:
        for name, number, wanted in zip(CrcRule._fields, plan.crc, expected.crc, strict=True):
            if number != wanted:
                words = name.replace("_", " ").replace("ids", "IDs")
                yield f"its CRC has {words} {number}, not {wanted}"
    known = {(signal.name, signal.page) for signal in expected.signals}
    for signal in plan.signals:
        if (signal.name, signal.page) not in known:
            yield f"{signal.name} is sent on group {signal.page}, where the DBC has no such signal"
    if tuple(plan.constants) != expected.pages:
        yield f"is sent with the groups {[*plan.constants]}, not {[*expected.pages]}"
    for page, bits in plan.constants.items():
        if expected.multiplexer:
            number = _read(expected.multiplexer, bits)
            if number != (page or 0):
                yield f"group {page} is sent as group {number}"
        own = set(expected.multiplexer)
        for each in expected.signals:
            is_constant = each.rule is not None and each.rule.shape is Shape.CONSTANT
            if is_constant and each.page in (None, page):
                own |= set(each.bits)
        for bit in range(bits.bit_length()):
            if bits >> bit & 1 and bit not in own:
                yield f"bit {bit % 8} of byte {bit // 8} is always 1, but no constant is there"


def _id(message: ExpectedMessage | PlannedMessage) -> str:
    return f"{message.can_id:08X}h" if message.extended else f"{message.can_id:03X}h"


def _wrong_constant(signal: ExpectedSignal, rule: Rule, plan: PlannedMessage) -> Iterator[str]:
    for page, bits in plan.constants.items():
        if signal.page not in (None, page):
            continue
        raw = received(rule, _read(signal.bits, bits))
        if raw != received(rule, rule.constant):
            want = words.sent(signal, received(rule, rule.constant))
            yield f"its constant is sent as {words.sent(signal, raw)}, not as {want}"


def _wrong_crc(signal: ExpectedSignal, plan: PlannedMessage) -> Iterator[str]:
    if plan.crc is None:
        yield "the message is sent without its CRC"
    elif set(signal.bits) != set(range(8 * plan.crc_at, 8 * plan.crc_at + plan.crc.bits)):
        yield f"its CRC is sent in byte {plan.crc_at}"


def _read(bits: Sequence[int], frame: int) -> int:
    """Return the unsigned number in these bits of a frame, least significant first."""
    return sum((frame >> at & 1) << number for number, at in enumerate(bits))


def _wrong_bits(signal: ExpectedSignal, rule: Rule, pieces: Sequence[Piece]) -> Iterator[str]:
    """Yield the first bit of the raw value that is not sent at its place.

    Each bit is placed by itself, so the places of all bits follow from the places of each.
    """
    for number, at in enumerate(signal.bits):
        raw = received(rule, 1 << number)
        frame = place(pieces, 1 << number)
        if frame == 1 << at:
            continue
        read = received(rule, _read(signal.bits, frame))
        if read != raw and rule.shape is not Shape.FLOAT:
            got = words.decimal(rule.physical(read))
            value = words.decimal(rule.physical(raw))
            yield f"{signal.source or 'the value'} {value} is sent as {got}".replace("_", " ")
        else:
            yield f"bit {number} of its raw value is not sent at bit {at % 8} of byte {at // 8}"
        return


def _overflow(signal: ExpectedSignal, plan: Planned) -> str | None:
    """Return the first product that leaves the 64 bits of the core in C. None if there is none."""
    rule = signal.rule
    assert rule is not None
    assert rule.quantity is not None
    limit = _FLOAT_END if plan.is_float else INT64_END
    most = max(abs(rule.quantity.low), abs(rule.quantity.high))
    for name, largest in products(plan, most):
        if largest >= limit:
            steps = words.decimal(Fraction(most, rule.quantity.steps))
            value = f"{signal.source.replace('_', ' ')} {steps} {rule.quantity.unit}".rstrip()
            return f"{value}: {name} is up to {largest}, which leaves {limit.bit_length()} bits"
    return None
