"""The rules of a DBC that every tool reads, checked on the text of the file alone.

`findings(data)` takes the bytes of a DBC and returns one line per violation, each beginning with the name of the rule.
It never raises on a broken file: a line that is not understood is a finding of `every_line_is_understood`.
No DBC library is used, so that a mistake in one of them cannot hide a mistake in the file.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from decimal import Decimal
from itertools import pairwise

FIRST_GATEWAY_ID = 0x6D8
"""Each ESC has its own ids: those of the file plus 0..7."""

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


@dataclass(frozen=True)
class Signal:
    """One SG_ line. `minimum` and `maximum` are physical."""

    message_id: int
    name: str
    start: int
    length: int
    intel: bool
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
    def is_flag(self) -> bool:
        return self.length == 1

    @property
    def is_alive_counter(self) -> bool:
        return self.name.endswith("Alive")

    @property
    def not_available(self) -> int:
        """The raw value of not available: all ones, or only the sign bit."""
        return -(1 << (self.length - 1)) if self.signed else (1 << self.length) - 1

    @property
    def error(self) -> int:
        """The raw value of error: the code next to not available."""
        return self.not_available + (1 if self.signed else -1)


@dataclass(frozen=True)
class Message:
    """One BO_ line with its signals."""

    id: int
    name: str
    dlc: int
    sender: str
    signals: tuple[Signal, ...]

    @property
    def is_of_an_esc(self) -> bool:
        return self.id < FIRST_GATEWAY_ID


@dataclass
class Database:
    """What the lines of a DBC say. Comment and value keys: ("",), ("BU_", name), ("BO_", id), ("SG_", id, name)."""

    data: bytes
    lines: list[str]
    sections: list[str] = field(default_factory=list)
    not_understood: list[str] = field(default_factory=list)
    nodes: list[str] = field(default_factory=list)
    messages: list[Message] = field(default_factory=list)
    comments: list[tuple[tuple[str | int, ...], str]] = field(default_factory=list)
    definitions: dict[str, list[str]] = field(default_factory=dict)
    """Attribute name to the texts of an ENUM."""
    attributes: list[tuple[str, tuple[str | int, ...], str]] = field(default_factory=list)
    value_tables: list[tuple[tuple[int, str], list[tuple[int, str]]]] = field(default_factory=list)

    @property
    def signals(self) -> list[Signal]:
        return [signal for message in self.messages for signal in message.signals]

    @property
    def tables(self) -> dict[tuple[int, str], dict[int, str]]:
        return {key: dict(pairs) for key, pairs in self.value_tables}

    def attribute(self, name: str, *key: str | int) -> str | None:
        """The one value that a BA_ line gives, without quotes; None if there is none, never a default."""
        return next(
            (value.strip('"') for n, k, value in self.attributes if (n, k) == (name, key or ("",))),
            None,
        )

    def number(self, name: str, message: Message) -> int:
        """A whole-number attribute of a message; -1 if it is missing or no number."""
        value = self.attribute(name, "BO_", message.id)
        return int(value) if value is not None and value.isdigit() else -1

    def send_type(self, message: Message) -> str:
        """The send type of a message by its index; empty if there is none."""
        choices, index = (
            self.definitions.get("GenMsgSendType", []),
            self.number("GenMsgSendType", message),
        )
        return choices[index] if 0 <= index < len(choices) else ""


NUMBER = r"[-+]?[0-9]+(?:\.[0-9]+)?"
NAME = r"[A-Za-z_][A-Za-z0-9_]*"
OBJECT = rf"(?:(?P<kind>BU_|BO_|SG_) (?P<object>(?:[0-9]+ )?{NAME}|[0-9]+) )?"
SIGNAL_LINE = re.compile(
    rf"^ SG_ (?P<name>{NAME}) : (?P<start>[0-9]+)\|(?P<length>[0-9]+)@(?P<order>[01])(?P<sign>[-+])"
    rf" \((?P<factor>{NUMBER}),(?P<offset>{NUMBER})\) \[(?P<minimum>{NUMBER})\|(?P<maximum>{NUMBER})\]"
    rf' "(?P<unit>[^"]*)" (?P<receivers>{NAME}(?:,{NAME})*)$'
)
LINES: dict[str, re.Pattern[str]] = {
    "VERSION": re.compile(r'^VERSION ""$'),
    "NS_": re.compile(r"^NS_ :$"),
    "BS_": re.compile(r"^BS_:$"),
    "BU_": re.compile(rf"^BU_:(?P<nodes>(?: {NAME})*)$"),
    "BO_": re.compile(
        rf"^BO_ (?P<id>[0-9]+) (?P<name>{NAME}): (?P<dlc>[0-9]+) (?P<sender>{NAME})$"
    ),
    "CM_": re.compile(rf'^CM_ {OBJECT}"(?P<text>[^"]*)";$'),
    "BA_DEF_": re.compile(
        r'^BA_DEF_ (?:(?:BU_|BO_|SG_) )?"(?P<name>[^"]+)" (?:INT|FLOAT|STRING|ENUM|HEX) ?(?P<rest>.*);$'
    ),
    "BA_DEF_DEF_": re.compile(r'^BA_DEF_DEF_ "[^"]+" .+;$'),
    "BA_": re.compile(rf'^BA_ "(?P<name>[^"]+)" {OBJECT}(?P<value>"[^"]*"|{NUMBER});$'),
    "VAL_": re.compile(
        rf'^VAL_ (?P<id>[0-9]+) (?P<name>{NAME})(?P<pairs>(?: -?[0-9]+ "[^"]*")+) ;$'
    ),
}


def _key(match: re.Match[str]) -> tuple[str | int, ...]:
    kind, words = match["kind"], (match["object"] or "").split()
    if kind is None:
        return ("",)
    return (kind, *(int(word) if word.isdigit() else word for word in words))


def parse(data: bytes) -> Database:
    """Read the bytes of a DBC line by line; what does not fit goes to `not_understood`."""
    db = Database(data, data.decode("latin-1").split("\n"))
    for number, line in enumerate(db.lines, 1):
        if not line:
            continue
        keyword = re.split(r"[ :]", line.lstrip(), maxsplit=1)[0]
        pattern = SIGNAL_LINE if keyword == "SG_" else LINES.get(keyword)
        match = pattern.match(line) if pattern else None
        if match is None:
            db.not_understood.append(f"line {number}: {line}")
            continue
        if keyword != "SG_":
            db.sections.append(keyword)
        match keyword:
            case "BU_":
                db.nodes += match["nodes"].split()
            case "BO_":
                db.messages.append(
                    Message(int(match["id"]), match["name"], int(match["dlc"]), match["sender"], ())
                )
            case "SG_" if db.messages:
                message = db.messages.pop()
                signal = Signal(
                    message_id=message.id,
                    name=match["name"],
                    start=int(match["start"]),
                    length=int(match["length"]),
                    intel=match["order"] == "1",
                    signed=match["sign"] == "-",
                    factor=Decimal(match["factor"]),
                    offset=Decimal(match["offset"]),
                    minimum=Decimal(match["minimum"]),
                    maximum=Decimal(match["maximum"]),
                    unit=match["unit"],
                    receivers=tuple(match["receivers"].split(",")),
                )
                signals = (*message.signals, signal)
                db.messages.append(
                    Message(message.id, message.name, message.dlc, message.sender, signals)
                )
            case "CM_":
                db.comments.append((_key(match), match["text"]))
            case "BA_DEF_":
                db.definitions[match["name"]] = re.findall(r'"([^"]*)"', match["rest"])
            case "BA_":
                db.attributes.append((match["name"], _key(match), match["value"]))
            case "VAL_":
                pairs = [
                    (int(n), text)
                    for n, text in re.findall(r'(-?[0-9]+) "([^"]*)"', match["pairs"])
                ]
                db.value_tables.append(((int(match["id"]), match["name"]), pairs))
            case _:
                pass
    return db


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
    for (_, name), pairs in db.value_tables:
        for _, text in pairs:
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
        if signal.is_flag or signal.is_alive_counter:
            continue
        named = [
            number for number, text in db.tables.get(signal.key, {}).items() if text not in CODES
        ]
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
        named = {
            number: text
            for number, text in db.tables.get(signal.key, {}).items()
            if text not in CODES
        }
        if named or signal.name in ENUMS:
            found.add(signal.name)
            if named != ENUMS.get(signal.name):
                yield f"{signal.name} has {named}"
            if (signal.factor, signal.offset, signal.signed, signal.unit) != (
                Decimal(1),
                Decimal(0),
                False,
                "",
            ):
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
