"""The rules of a DBC that every tool reads, checked on the text of the file alone.

`findings(data)` takes the bytes of a DBC and returns one line per violation, each beginning with the name of the rule.
It never raises on a broken file: a line that is not understood is a finding of `every_line_is_understood`.
No DBC library is used, so that a mistake in one of them cannot hide a mistake in the file.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from itertools import pairwise
from typing import Any, NamedTuple

LONGEST_NAME = 32
LONGEST_SIGNAL_NAME = 28
"""Leaves four characters for the prefix of further ESCs, as `Esc2`."""

SECTIONS = ("VERSION", "NS_", "BS_", "BU_", "BO_", "CM_", "BA_DEF_", "BA_DEF_DEF_", "BA_", "VAL_")
CODES = {"Error", "NotAvailable"}
ENUMS: dict[str, dict[int, str]] = {
    # The telemetry sheet's states; 0, 4, 5, 6, 8 have no name and are sent as Error.
    "OperatingState": {
        1: "WaitForSignal", 2: "WaitForMotorOff", 3: "WaitForMotorOn", 7: "Selftest", 9: "ErrorSelftest",
        10: "CutOffDuringOperation", 11: "AcousticSignal", 12: "MotorOff", 13: "StandBy", 14: "Brake",
        15: "BrakeTargetBackward", 16: "BrakeTargetForward", 17: "Programming", 18: "SyncForward", 19: "SyncBackward",
        20: "SyncStandBy", 21: "Forward", 22: "Backward", 23: "SpoolUpFromStill", 24: "SpoolUpFromTurn",
        25: "SpoolUpQuick", 26: "RpmControl",
    },
    "Device": {1: "Kosmik", 2: "Kolibri", 3: "JivePro", 4: "KontrolX", 5: "Uhv"},
    "Layout": {0: "Unknown", 1: "V4", 2: "Legacy"},
    "LinkState": {0: "NeverSeen", 1: "Searching", 2: "Ok", 3: "Degraded", 4: "Lost", 5: "PortError"},
    "GatewayState": {0: "Starting", 1: "Running", 2: "Stopping", 3: "Replay"},
    "CanState": {0: "Unknown", 1: "ErrorActive", 2: "ErrorWarning", 3: "ErrorPassive", 4: "BusOff", 5: "Down"},
}  # fmt: skip


class Signal(NamedTuple):
    """One SG_ line. `minimum` and `maximum` are physical."""

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
    """One BO_ line with its signals."""

    id: int
    name: str
    dlc: int
    sender: str
    signals: list[Signal]


@dataclass
class Database:
    """What the lines of a DBC say. Comment and value keys: ("",), ("BU_", name), ("BO_", id), ("SG_", id, name)."""

    data: bytes
    sections: list[str] = field(default_factory=list)
    not_understood: list[str] = field(default_factory=list)
    nodes: list[str] = field(default_factory=list)
    messages: list[Message] = field(default_factory=list)
    comments: list[tuple[tuple[str | int, ...], str]] = field(default_factory=list)
    definitions: dict[str, list[str]] = field(default_factory=dict)
    """Attribute name to the texts of an ENUM."""
    attributes: dict[tuple[str | int, ...], str] = field(default_factory=dict)
    """Without quotes, by name and key; never a default."""
    tables: dict[tuple[int, str], dict[int, str]] = field(default_factory=dict)

    @property
    def signals(self) -> list[Signal]:
        return [signal for message in self.messages for signal in message.signals]

    def named(self, signal: Signal) -> dict[int, str]:
        """Texts of a signal's values, without the codes."""
        table = self.tables.get(signal.key, {})
        return {number: text for number, text in table.items() if text not in CODES}

    def attribute(self, name: str, *key: str | int) -> str | None:
        """The value that a BA_ line gives."""
        return self.attributes.get((name, *(key or ("",))))

    def number(self, name: str, message: Message) -> int:
        """A whole-number attribute of a message; -1 if it is missing or no number."""
        value = self.attribute(name, "BO_", message.id)
        return int(value) if value is not None and value.isdigit() else -1

    def send_type(self, message: Message) -> str:
        """The send type of a message by its index; empty if there is none."""
        index = self.number("GenMsgSendType", message)
        return dict(enumerate(self.definitions.get("GenMsgSendType", []))).get(index, "")


NUMBER = r"[-+]?[0-9]+(?:\.[0-9]+)?"
NAME = r"[A-Za-z_][A-Za-z0-9_]*"
OBJECT = rf"(?:(BU_|BO_|SG_) ((?:[0-9]+ )?{NAME}|[0-9]+) )?"
LINES = {
    "VERSION": r'VERSION ""',
    "NS_": r"NS_ :",
    "BS_": r"BS_:",
    "BU_": rf"BU_:((?: {NAME})*)",
    "BO_": rf"BO_ ([0-9]+) ({NAME}): ([0-9]+) ({NAME})",
    "SG_": rf" SG_ ({NAME}) : ([0-9]+)\|([0-9]+)@1([-+]) \(({NUMBER}),({NUMBER})\) \[({NUMBER})\|({NUMBER})\]"
    rf' "([^"]*)" ({NAME}(?:,{NAME})*)',
    "CM_": rf'CM_ {OBJECT}"([^"]*)";',
    "BA_DEF_": r'BA_DEF_ (?:(?:BU_|BO_|SG_) )?"([^"]+)" (?:INT|FLOAT|STRING|ENUM|HEX) ?(.*);',
    "BA_DEF_DEF_": r'BA_DEF_DEF_ "[^"]+" .+;',
    "BA_": rf'BA_ "([^"]+)" {OBJECT}("[^"]*"|{NUMBER});',
    "VAL_": rf'VAL_ ([0-9]+) ({NAME})((?: -?[0-9]+ "[^"]*")+) ;',
}
"""Each kind of line that the rules allow."""


def _key(kind: str | None, place: str | None) -> tuple[str | int, ...]:
    words = (place or "").split()
    return (kind or "", *(int(word) if word.isdigit() else word for word in words))


def parse(data: bytes) -> Database:
    """Read the bytes of a DBC line by line; what does not fit goes to `not_understood`."""
    db = Database(data)
    for number, line in enumerate(data.decode("latin-1").split("\n"), 1):
        if not line:
            continue
        keyword = re.split(r"[ :]", line.lstrip(), maxsplit=1)[0]
        match = re.fullmatch(LINES.get(keyword, "(?!)"), line)
        if match is None or (keyword == "SG_" and not db.messages):
            db.not_understood.append(f"line {number}: {line}")
            continue
        if keyword != "SG_":
            db.sections.append(keyword)
        _add(db, keyword, match.groups())
    return db


def _add(db: Database, keyword: str, found: Sequence[Any]) -> None:
    match keyword, *found:
        case "BU_", names:
            db.nodes += names.split()
        case "BO_", number, name, dlc, sender:
            db.messages.append(Message(int(number), name, int(dlc), sender, []))
        case "SG_", name, start, length, sign, *numbers, unit, receivers:
            factor, offset, low, high = map(Decimal, numbers)
            of, start, length, signed = db.messages[-1], int(start), int(length), sign == "-"
            scale = (factor, offset, low, high, unit, tuple(receivers.split(",")))
            of.signals.append(Signal(of.id, name, start, length, signed, *scale))
        case "CM_", kind, place, text:
            db.comments.append((_key(kind, place), text))
        case "BA_DEF_", name, rest:
            db.definitions[name] = re.findall(r'"([^"]*)"', rest)
        case "BA_", name, kind, place, value:
            db.attributes[name, *_key(kind, place)] = value.strip('"')
        case "VAL_", number, name, pairs:
            texts = re.findall(r'(-?[0-9]+) "([^"]*)"', pairs)
            db.tables[int(number), name] = {int(n): text for n, text in texts}
        case _:
            pass


# --- the rules, in the order of the file -----------------------------------------------------------------------------


def text_is_ascii_with_line_feeds(db: Database) -> Iterator[str]:
    for number, line in enumerate(db.data.split(b"\n"), 1):
        strange = {byte for byte in line if not 0x20 <= byte <= 0x7E}
        if strange:
            yield f"line {number} has the bytes {', '.join(f'{byte:02X}h' for byte in sorted(strange))}"
        if line.endswith(b" "):
            yield f"line {number} ends with a blank"
    if not db.data.endswith(b"\n") or db.data.endswith(b"\n\n"):
        yield "the file does not end with exactly one line feed"


def every_line_is_understood(db: Database) -> Iterator[str]:
    """Keeps out BA_DEF_REL_, VAL_TABLE_, SIG_VALTYPE_ (floats), SG_MUL_VAL_, multiplexing marks and what else is odd."""
    yield from db.not_understood


def sections_are_in_order(db: Database) -> Iterator[str]:
    ranks = [SECTIONS.index(keyword) for keyword in db.sections]
    for before, after in pairwise(ranks):
        if after < before:
            yield f"{SECTIONS[after]} after {SECTIONS[before]}"
    for missing in set(SECTIONS) - set(db.sections):
        yield f"{missing} is missing"


def names_are_pascal_case(db: Database) -> Iterator[str]:
    names = [*db.nodes, *(message.name for message in db.messages), *db.definitions]
    for name in [*names, *(signal.name for signal in db.signals)]:
        if not re.fullmatch(r"[A-Z][A-Za-z0-9]*", name) or not re.search("[a-z]", name):
            yield f"{name} is not PascalCase"
        if "reserved" in name.lower():
            yield f"{name} is a reserved signal"
    for name in names:
        if len(name) > LONGEST_NAME:
            yield f"{name} is longer than {LONGEST_NAME}"
    for signal in db.signals:
        if len(signal.name) > LONGEST_SIGNAL_NAME:
            yield f"{signal.name} is longer than {LONGEST_SIGNAL_NAME}"
    for (_, name), table in db.tables.items():
        for text in table.values():
            if not re.fullmatch(r"[A-Z][A-Za-z0-9]*", text):
                yield f"{name}: the value text {text!r} is not PascalCase"


def names_are_unique(db: Database) -> Iterator[str]:
    """Also where case is ignored, as some tools do."""
    for what, names in (
        ("node", db.nodes),
        ("message", [message.name for message in db.messages]),
        ("signal", [signal.name for signal in db.signals]),
    ):
        for name, count in Counter(name.lower() for name in names).items():
            if count > 1:
                yield f"{count} {what}s are called {name}"


def limits_leave_out_the_codes(db: Database) -> Iterator[str]:
    """[min|max] is the whole type less the two codes, of an enum 0 to its greatest name. It always contains 0: canmatrix
    checks the default start value against it."""
    for signal in db.signals:
        if not signal.has_codes:
            continue
        named = db.named(signal)
        if signal.signed:
            raw = (signal.error + 1, (1 << (signal.length - 1)) - 1)
        else:
            raw = (0, max(named) if named else signal.error - 1)
        expected = tuple(number * signal.factor + signal.offset for number in raw)
        if (signal.minimum, signal.maximum) != expected:
            yield f"{signal.name} has [{signal.minimum}|{signal.maximum}], not [{expected[0]}|{expected[1]}]"
        if not signal.minimum <= 0 <= signal.maximum:
            yield f"{signal.name} leaves out 0"


def enums_are_closed(db: Database) -> Iterator[str]:
    """Every value that the gateway can send has a name, and nothing else has: one unknown sample costs all names."""
    found = set()
    for signal in db.signals:
        named = db.named(signal)
        if named or signal.name in ENUMS:
            found.add(signal.name)
            if named != ENUMS.get(signal.name):
                yield f"{signal.name} has {named}"
            if signal.signed or signal.unit or signal.factor != 1 or signal.offset:
                yield f"{signal.name} is an enum with scale, sign or unit"
    for missing in set(ENUMS) - found:
        yield f"{missing} is missing"


def everything_has_one_comment(db: Database) -> Iterator[str]:
    expected: list[tuple[str | int, ...]] = [("",), *(("BU_", node) for node in db.nodes)]
    expected += [("BO_", message.id) for message in db.messages]
    expected += [("SG_", *signal.key) for signal in db.signals]
    found = Counter(key for key, _ in db.comments)
    for key in expected:
        if found[key] != 1:
            yield f"{key} has {found[key]} comments"
    for key in set(found) - set(expected):
        yield f"{key} is commented but not there"
    for key, text in db.comments:
        if len(text) < 10 or not text.endswith("."):
            yield f"{key}: {text!r} is no sentence"
        if re.search(r"[;\\]|\b[A-Z]+_\B", text):
            yield f"{key}: {text!r} has what a parser may take for syntax"


def version_is_in_attribute_and_comment(db: Database) -> Iterator[str]:
    version = db.attribute("LayoutVersion") or ""
    if not re.fullmatch(r"[0-9]+\.[0-9]+\.[0-9]+", version):
        yield f"LayoutVersion is {version!r}"
    if not any(key == ("",) and f"layout version {version}." in text for key, text in db.comments):
        yield f"the comment of the database does not say {version}"


Rule = Callable[[Database], Iterator[str]]
RULES: dict[str, Rule] = {
    rule.__name__: rule
    for rule in (
        text_is_ascii_with_line_feeds, every_line_is_understood, sections_are_in_order, names_are_pascal_case, names_are_unique,
        limits_leave_out_the_codes, enums_are_closed, everything_has_one_comment, version_is_in_attribute_and_comment,
    )
}  # fmt: skip


def findings(data: bytes) -> list[str]:
    """Every violation of every rule, as `rule: what`."""
    db = parse(data)
    return [f"{name}: {finding}" for name, rule in RULES.items() for finding in rule(db)]
