"""What the shipped DBCs keep so that every tool reads them alike, each rule as what breaks it.

`parse` is cantools' reading in a form that tests compare with those of other tools (test_dbc_in_other_tools.py).
"""

import re
from collections.abc import Callable, Iterator
from decimal import Decimal
from typing import Any, NamedTuple

import cantools.database
from esc import sheet
from packer_oracle import CAN_STATES, GATEWAY_STATES, LAYOUTS, LINKS

CODES = {"Error", "NotAvailable"}
ENUMS = {
    "OperatingState": {
        number: text.replace("_", "").replace("RPM", "Rpm")
        for number, text in sheet.OPERATING_STATES.items()
    },
    "Device": {1: "Kosmik", 2: "Kolibri", 3: "JivePro", 4: "KontrolX", 5: "Uhv"},
    "Layout": LAYOUTS,
    "LinkState": LINKS,
    "GatewayState": GATEWAY_STATES,
    "CanState": CAN_STATES,
}


class Signal(NamedTuple):
    """One signal. `minimum` and `maximum` are physical."""

    message_id: int
    name: str
    start: int
    length: int
    signed: bool
    factor: Decimal
    offset: Decimal
    minimum: Decimal
    maximum: Decimal
    unit: str
    receivers: tuple[str, ...]

    @property
    def key(self) -> tuple[int, str]:
        return self.message_id, self.name

    @property
    def has_codes(self) -> bool:
        """All but flags and alive counters have codes for not available and error."""
        return self.length > 1 and not self.name.endswith("Alive")

    @property
    def not_available(self) -> int:
        """The raw value of not available: all ones, or only the sign bit."""
        return -(1 << (self.length - 1)) if self.signed else (1 << self.length) - 1

    @property
    def error(self) -> int:
        """The raw value of error: the code next to not available."""
        return self.not_available + (1 if self.signed else -1)


class Message(NamedTuple):
    """One message with its signals."""

    id: int
    name: str
    dlc: int
    sender: str
    signals: list[Signal]


class Database:
    """What a DBC says. Owners of comments: ("",), ("BU_", name), ("BO_", id), ("SG_", id, name)."""

    def __init__(self, data: bytes) -> None:
        read: Any = cantools.database.load_string(
            data.decode("ascii"), "dbc", strict=True, sort_signals=None
        )
        owners: dict[tuple[str | int, ...], Any] = {("BU_", node.name): node for node in read.nodes}
        for m in read.messages:
            owners["BO_", m.frame_id] = m
            owners |= {("SG_", m.frame_id, s.name): s for s in m.signals}
        self.nodes: list[str] = [node.name for node in read.nodes]
        self.messages = [
            Message(m.frame_id, m.name, m.length, m.senders[0], [_signal(m, s) for s in m.signals])
            for m in read.messages
        ]
        self.signals = [signal for message in self.messages for signal in message.signals]
        self.comments = [(key, str(owner.comment)) for key, owner in owners.items()]
        self.comments.append((("",), read.buses[0].comment))
        self.tables = {
            (m.frame_id, s.name): {int(number): str(text) for number, text in s.choices.items()}
            for m in read.messages
            for s in m.signals
            if s.choices
        }
        """Texts of values, by id of the message and name of the signal."""
        self._owners = owners | {("",): read}

    def named(self, signal: Signal) -> dict[int, str]:
        """Texts of a signal's values, without the codes."""
        table = self.tables.get(signal.key, {})
        return {number: text for number, text in table.items() if text not in CODES}

    def attribute(self, name: str, *key: str | int) -> Any:
        """An attribute's value; None where it is not given."""
        owner = self._owners[key or ("",)]
        found = owner.dbc.attributes.get(name) if owner.dbc else None
        return None if found is None else found.value

    def number(self, name: str, message: Message) -> int:
        """A whole-number attribute of a message; 0 where it is not given."""
        return int(self.attribute(name, "BO_", message.id) or 0)

    def send_type(self, message: Message) -> str:
        return str(self._owners["BO_", message.id].send_type)


def _signal(message: Any, signal: Any) -> Signal:
    scale = (signal.scale, signal.offset, signal.minimum, signal.maximum)
    factor, offset, low, high = (Decimal(str(number)) for number in scale)
    place = (message.frame_id, signal.name, signal.start, signal.length, signal.is_signed)
    receivers = tuple(signal.receivers)
    return Signal(*place, factor, offset, low, high, signal.unit or "", receivers)


def parse(data: bytes) -> Database:
    return Database(data)


# --- the rules ----------------------------------------------------------------------------------------------------------


def limits_leave_out_the_codes(db: Database) -> Iterator[str]:
    """[min|max] is the whole type less the two codes, of an enum 0 to its greatest name. It always contains 0: canmatrix
    checks the default start value against it."""
    for signal in (signal for signal in db.signals if signal.has_codes):
        named = db.named(signal)
        if signal.signed:
            raw = (signal.error + 1, (1 << (signal.length - 1)) - 1)
        else:
            raw = (0, max(named) if named else signal.error - 1)
        expected = tuple(number * signal.factor + signal.offset for number in raw)
        if (signal.minimum, signal.maximum) != expected or not expected[0] <= 0 <= expected[1]:
            yield f"{signal.name} has [{signal.minimum}|{signal.maximum}], not [{expected[0]}|{expected[1]}]"


def enums_are_closed(db: Database) -> Iterator[str]:
    """Every value that the gateway can send has a name, and nothing else has: one unknown sample costs all names."""
    found = {signal.name: db.named(signal) for signal in db.signals if db.named(signal)}
    if found != ENUMS:
        yield f"{found}, not {ENUMS}"
    for signal in db.signals:
        if signal.name in found and (signal.signed or signal.unit or signal.factor != 1):
            yield f"{signal.name} is an enum with scale, sign or unit"


def everything_has_a_comment(db: Database) -> Iterator[str]:
    for key, text in db.comments:
        if len(text) < 10 or not text.endswith(".") or re.search(r"[;\\]|\b[A-Z]+_\B", text):
            yield f"{key}: {text!r} is no sentence, or has what a parser may take for syntax"


RULES: dict[str, Callable[[Database], Iterator[str]]] = {
    rule.__name__: rule
    for rule in (
        limits_leave_out_the_codes,
        enums_are_closed,
        everything_has_a_comment,
    )
}


def findings(data: bytes) -> list[str]:
    """Every violation of every rule, as `rule: what`."""
    db = parse(data)
    return [f"{name}: {finding}" for name, rule in RULES.items() for finding in rule(db)]
