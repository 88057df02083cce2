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

FIRST_ID, LAST_ID = 0x680, 0x6DF
FIRST_GATEWAY_ID = 0x6D8
ESCS = 8
"""Each ESC has its own ids: those of the file plus 0..7."""

LONGEST_NAME = 32
LONGEST_SIGNAL_NAME = 28
"""Leaves four characters for the prefix of further ESCs, as `Esc2`."""

ZERO, ONE = Decimal(0), Decimal(1)

SECTIONS = ("VERSION", "NS_", "BS_", "BU_", "BO_", "CM_", "BA_DEF_", "BA_DEF_DEF_", "BA_", "VAL_")
GATEWAY, RECEIVER = "KontronikGateway", "Logger"
EVENT_HZ = 100
"""Frames a second of an Event message: one per live frame of the ESC."""

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

    @property
    def bits(self) -> range:
        return range(self.start, self.start + self.length)


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
class Definition:
    """One BA_DEF_ line."""

    object: str
    type: str
    choices: tuple[str, ...]


@dataclass
class Database:
    """What the lines of a DBC say. Comment and value keys: ("",), ("BU_", name), ("BO_", id), ("SG_", id, name)."""

    data: bytes
    lines: list[str]
    version: list[str] = field(default_factory=list)
    sections: list[str] = field(default_factory=list)
    not_understood: list[str] = field(default_factory=list)
    nodes: list[str] = field(default_factory=list)
    messages: list[Message] = field(default_factory=list)
    comments: list[tuple[tuple[str | int, ...], str]] = field(default_factory=list)
    definitions: dict[str, Definition] = field(default_factory=dict)
    defaults: dict[str, str] = field(default_factory=dict)
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
        return next((value.strip('"') for n, k, value in self.attributes if (n, k) == (name, key or ("",))), None)

    def number(self, name: str, message: Message) -> int:
        """A whole-number attribute of a message; -1 if it is missing or no number."""
        value = self.attribute(name, "BO_", message.id)
        return int(value) if value is not None and value.isdigit() else -1

    def send_type(self, message: Message) -> str:
        """The send type of a message by its index; empty if there is none."""
        definition, index = self.definitions.get("GenMsgSendType"), self.number("GenMsgSendType", message)
        return definition.choices[index] if definition and 0 <= index < len(definition.choices) else ""


NUMBER = r"[-+]?[0-9]+(?:\.[0-9]+)?"
NAME = r"[A-Za-z_][A-Za-z0-9_]*"
OBJECT = rf"(?:(?P<kind>BU_|BO_|SG_) (?P<object>(?:[0-9]+ )?{NAME}|[0-9]+) )?"
SIGNAL_LINE = re.compile(
    rf"^ SG_ (?P<name>{NAME}) : (?P<start>[0-9]+)\|(?P<length>[0-9]+)@(?P<order>[01])(?P<sign>[-+])"
    rf" \((?P<factor>{NUMBER}),(?P<offset>{NUMBER})\) \[(?P<minimum>{NUMBER})\|(?P<maximum>{NUMBER})\]"
    rf' "(?P<unit>[^"]*)" (?P<receivers>{NAME}(?:,{NAME})*)$'
)
LINES: dict[str, re.Pattern[str]] = {
    "VERSION": re.compile(r'^VERSION "(?P<version>[^"]*)"$'),
    "NS_": re.compile(r"^NS_ :$"),
    "BS_": re.compile(r"^BS_:$"),
    "BU_": re.compile(rf"^BU_:(?P<nodes>(?: {NAME})*)$"),
    "BO_": re.compile(rf"^BO_ (?P<id>[0-9]+) (?P<name>{NAME}): (?P<dlc>[0-9]+) (?P<sender>{NAME})$"),
    "CM_": re.compile(rf'^CM_ {OBJECT}"(?P<text>[^"]*)";$'),
    "BA_DEF_": re.compile(
        r'^BA_DEF_ (?:(?P<object>BU_|BO_|SG_) )?"(?P<name>[^"]+)" (?P<type>INT|FLOAT|STRING|ENUM|HEX) ?(?P<rest>.*);$'
    ),
    "BA_DEF_DEF_": re.compile(r'^BA_DEF_DEF_ "(?P<name>[^"]+)" (?P<value>.+);$'),
    "BA_": re.compile(rf'^BA_ "(?P<name>[^"]+)" {OBJECT}(?P<value>"[^"]*"|{NUMBER});$'),
    "VAL_": re.compile(rf'^VAL_ (?P<id>[0-9]+) (?P<name>{NAME})(?P<pairs>(?: -?[0-9]+ "[^"]*")+) ;$'),
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
            case "VERSION":
                db.version.append(match["version"])
            case "BU_":
                db.nodes += match["nodes"].split()
            case "BO_":
                db.messages.append(Message(int(match["id"]), match["name"], int(match["dlc"]), match["sender"], ()))
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
                db.messages.append(Message(message.id, message.name, message.dlc, message.sender, signals))
            case "CM_":
                db.comments.append((_key(match), match["text"]))
            case "BA_DEF_":
                choices = tuple(re.findall(r'"([^"]*)"', match["rest"]))
                db.definitions[match["name"]] = Definition(match["object"] or "", match["type"], choices)
            case "BA_DEF_DEF_":
                db.defaults[match["name"]] = match["value"].strip('"')
            case "BA_":
                db.attributes.append((match["name"], _key(match), match["value"]))
            case "VAL_":
                pairs = [(int(n), text) for n, text in re.findall(r'(-?[0-9]+) "([^"]*)"', match["pairs"])]
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


def header_is_plain(db: Database) -> Iterator[str]:
    if db.version != [""]:
        yield f'VERSION is {db.version}, not once ""'
    if db.lines[0] != 'VERSION ""':
        yield "the first line is not VERSION"
    for keyword in ("NS_", "BS_", "BU_"):
        if db.sections.count(keyword) != 1:
            yield f"{keyword} is there {db.sections.count(keyword)} times"


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


def percent_signals_say_so(db: Database) -> Iterator[str]:
    for signal in db.signals:
        if (signal.unit == "%") != signal.name.endswith("Percent"):
            yield f"{signal.name} in {signal.unit!r}"


def nodes_are_gateway_and_logger(db: Database) -> Iterator[str]:
    if db.nodes != [GATEWAY, RECEIVER]:
        yield f"the nodes are {db.nodes}"
    for message in db.messages:
        if message.sender != GATEWAY:
            yield f"{message.name} is sent by {message.sender}"
        for signal in message.signals:
            if signal.receivers != (RECEIVER,):
                yield f"{signal.name} is received by {signal.receivers}"


def ids_are_in_the_free_range(db: Database) -> Iterator[str]:
    """680h..6DFh: outside the restricted ids and the PDOs of CiA 301."""
    for message in db.messages:
        if not FIRST_ID <= message.id <= LAST_ID:
            yield f"{message.name} has {message.id:X}h"


def eight_escs_fit(db: Database) -> Iterator[str]:
    owners: dict[int, str] = {}
    for message in db.messages:
        for id_ in range(message.id, message.id + (ESCS if message.is_of_an_esc else 1)):
            if id_ in owners:
                yield f"{message.name} and {owners[id_]} meet at {id_:X}h"
            owners[id_] = message.name
            if message.is_of_an_esc and id_ >= FIRST_GATEWAY_ID:
                yield f"{message.name} of a further ESC has {id_:X}h, an id of the gateway"
        if message.is_of_an_esc != message.name.startswith("Esc"):
            yield f"{message.name} has {message.id:X}h"


def messages_have_eight_bytes(db: Database) -> Iterator[str]:
    for message in db.messages:
        if message.dlc != 8:
            yield f"{message.name} has {message.dlc} bytes"
        if not message.signals:
            yield f"{message.name} has no signals"


def signals_are_intel_on_byte_borders(db: Database) -> Iterator[str]:
    for signal in db.signals:
        if not signal.intel:
            yield f"{signal.name} is Motorola"
        if signal.length > 8:
            if signal.start % 8 or signal.length % 8:
                yield f"{signal.name} of {signal.length} bits at bit {signal.start} is not whole bytes"
        elif signal.start % 8 + signal.length > 8:
            yield f"{signal.name} crosses a byte border"
        if signal.signed and signal.length not in (8, 16, 32):
            yield f"{signal.name} is signed with {signal.length} bits"


def signals_do_not_overlap(db: Database) -> Iterator[str]:
    for message in db.messages:
        owners: dict[int, str] = {}
        for signal in message.signals:
            for bit in signal.bits:
                if bit >= 8 * message.dlc:
                    yield f"{signal.name} reaches out of {message.name}"
                    break
                if bit in owners:
                    yield f"{signal.name} and {owners[bit]} share bit {bit} of {message.name}"
                owners[bit] = signal.name


def flags_are_plain_bits(db: Database) -> Iterator[str]:
    for signal in db.signals:
        if signal.is_flag:
            plain = (signal.signed, signal.factor, signal.offset, signal.minimum, signal.maximum, signal.unit)
            if plain != (False, ONE, ZERO, ZERO, ONE, ""):
                yield f"{signal.name} is not an unsigned bit [0|1] without scale and unit"
            if signal.key in db.tables:
                yield f"{signal.name} has value texts"


def alive_counters_are_where_they_belong(db: Database) -> Iterator[str]:
    """One in each live message: sent with the live frame or at least every 100 ms."""
    for message in db.messages:
        counters = [signal for signal in message.signals if signal.is_alive_counter]
        live = db.send_type(message) == "Event" or db.number("GenMsgCycleTime", message) <= 100
        if len(counters) > 1 or (live and not counters):
            yield f"{message.name} has {len(counters)} alive counters"
        for signal in counters:
            plain = (signal.length, signal.signed, signal.factor, signal.offset, signal.minimum, signal.maximum)
            if plain != (4, False, ONE, ZERO, ZERO, Decimal(14)):
                yield f"{signal.name} is not 4 bits [0|14]"
            if signal.key in db.tables:
                yield f"{signal.name} has value texts"


def not_available_and_error_are_named(db: Database) -> Iterator[str]:
    for signal in db.signals:
        if signal.is_flag or signal.is_alive_counter:
            continue
        table = db.tables.get(signal.key, {})
        for code, text in ((signal.not_available, "NotAvailable"), (signal.error, "Error")):
            if table.get(code) != text:
                yield f"{signal.name}: {code} is {table.get(code)!r}, not {text!r}"
        for number, text in table.items():
            if text in CODES and number not in (signal.not_available, signal.error):
                yield f"{signal.name}: {number} is called {text} too"


def limits_leave_out_the_codes(db: Database) -> Iterator[str]:
    """[min|max] is the whole type less the two codes, of an enum 0 to its greatest name. It always contains 0: canmatrix
    checks the default start value against it."""
    for signal in db.signals:
        if signal.is_flag or signal.is_alive_counter:
            continue
        named = [number for number, text in db.tables.get(signal.key, {}).items() if text not in CODES]
        if signal.signed:
            raw = (signal.error + 1, (1 << (signal.length - 1)) - 1)
        else:
            raw = (0, max(named) if named else signal.error - 1)
        expected = tuple(number * signal.factor + signal.offset for number in raw)
        if (signal.minimum, signal.maximum) != expected:
            yield f"{signal.name} has [{signal.minimum}|{signal.maximum}], not [{expected[0]}|{expected[1]}]"
        if not signal.minimum <= 0 <= signal.maximum:
            yield f"{signal.name} leaves out 0"


def value_tables_belong_to_signals(db: Database) -> Iterator[str]:
    signals = {signal.key for signal in db.signals}
    for key, count in Counter(key for key, _ in db.value_tables).items():
        if key not in signals:
            yield f"{key} is no signal"
        if count > 1:
            yield f"{key} has {count} tables"
    for (_, name), pairs in db.value_tables:
        if len({number for number, _ in pairs}) < len(pairs) or len({text.upper() for _, text in pairs}) < len(pairs):
            yield f"{name} names a value or a text twice"


def enums_are_closed(db: Database) -> Iterator[str]:
    """Every value that the gateway can send has a name, and nothing else has: one unknown sample costs all names."""
    found = set()
    for signal in db.signals:
        named = {number: text for number, text in db.tables.get(signal.key, {}).items() if text not in CODES}
        if named or signal.name in ENUMS:
            found.add(signal.name)
            if named != ENUMS.get(signal.name):
                yield f"{signal.name} has {named}"
            if (signal.factor, signal.offset, signal.signed, signal.unit) != (ONE, ZERO, False, ""):
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


def attributes_are_declared(db: Database) -> Iterator[str]:
    expected = {
        "LayoutVersion": ("", "STRING"), "BusType": ("", "STRING"), "GenMsgCycleTime": ("BO_", "INT"),
        "GenMsgSendType": ("BO_", "ENUM"), "GenMsgDelayTime": ("BO_", "INT"), "GenSigStartValue": ("SG_", "FLOAT"),
    }  # fmt: skip
    for name, declared in expected.items():
        definition = db.definitions.get(name)
        if definition is None or (definition.object, definition.type) != declared:
            yield f"{name} is not declared as {declared}"
    for name, definition in db.definitions.items():
        if name not in db.defaults:
            yield f"{name} has no default"
        elif definition.choices and db.defaults[name] not in definition.choices:
            yield f"{name} has the default {db.defaults[name]!r}, which is none of its values"
    for name in (set(db.defaults) | {name for name, _, _ in db.attributes}) - set(db.definitions):
        yield f"{name} is not declared"
    if "SystemSignalLongSymbol" in db.definitions:
        yield "SystemSignalLongSymbol is declared"


def attributes_belong_to_something(db: Database) -> Iterator[str]:
    keys: set[tuple[str | int, ...]] = {("",), *(("BU_", node) for node in db.nodes)}
    keys |= {("BO_", message.id) for message in db.messages} | {("SG_", *signal.key) for signal in db.signals}
    for (name, key), count in Counter((name, key) for name, key, _ in db.attributes).items():
        if key not in keys:
            yield f"{name} of {key}, which is not there"
        if name in db.definitions and db.definitions[name].object != key[0]:
            yield f"{name} of {key} is declared for {db.definitions[name].object!r}"
        if count > 1:
            yield f"{name} of {key} is there {count} times"


def enum_attributes_are_set_by_index(db: Database) -> Iterator[str]:
    for name, key, value in db.attributes:
        definition = db.definitions.get(name)
        if definition and definition.type == "ENUM" and not (value.isdigit() and int(value) < len(definition.choices)):
            yield f"{name} of {key} is {value}"
        if definition and (definition.type == "STRING") != value.startswith('"'):
            yield f"{name} of {key} is {value}, a {definition.type}"


def bus_is_can_and_not_j1939(db: Database) -> Iterator[str]:
    if db.attribute("BusType") != "CAN":
        yield f"BusType is {db.attribute('BusType')}"
    for value in (db.defaults.get("ProtocolType"), db.attribute("ProtocolType")):
        if value is not None and "J1939" in value:
            yield f"ProtocolType is {value}"
    if "VFrameFormat" in db.definitions:
        yield "VFrameFormat is declared"


def version_is_in_attribute_and_comment(db: Database) -> Iterator[str]:
    version = db.attribute("LayoutVersion") or ""
    if not re.fullmatch(r"[0-9]+\.[0-9]+\.[0-9]+", version):
        yield f"LayoutVersion is {version!r}"
    if not any(key == ("",) and f"layout version {version}." in text for key, text in db.comments):
        yield f"the comment of the database does not say {version}"


def messages_have_a_schedule(db: Database) -> Iterator[str]:
    for message in db.messages:
        send_type = db.send_type(message)
        cycle, delay = db.number("GenMsgCycleTime", message), db.number("GenMsgDelayTime", message)
        if send_type not in ("Cyclic", "Event", "CyclicAndOnChange"):
            yield f"{message.name} is sent {send_type!r}"
        if (cycle == 0) != (send_type == "Event") or cycle < 0:
            yield f"{message.name} is sent {send_type!r} every {cycle} ms"
        if delay <= 0 or (cycle > 0 and delay >= cycle):
            yield f"{message.name} has the delay {delay} ms in a cycle of {cycle} ms"


def start_values_are_raw_not_available(db: Database) -> Iterator[str]:
    for signal in db.signals:
        expected = 0 if signal.is_flag or signal.is_alive_counter else signal.not_available
        if db.attribute("GenSigStartValue", "SG_", *signal.key) != str(expected):
            value = db.attribute("GenSigStartValue", "SG_", *signal.key)
            yield f"{signal.name} starts with {value}, not {expected}"


def one_esc_loads_the_bus_below_ten_percent(db: Database) -> Iterator[str]:
    load = bus_load(db)
    if not 0 < load < 0.10:
        yield f"{load:.2%} of 500 kbit/s"


def bus_load(db: Database, escs: int = 1, bit_rate: int = 500_000) -> float:
    """The greatest share of the bus: every frame stuffed as badly as can be, every change message as often as its delay
    allows, every event message with EVENT_HZ."""
    bits_a_second = 0.0
    for message in db.messages:
        cycle, delay = db.number("GenMsgCycleTime", message), db.number("GenMsgDelayTime", message)
        hertz = {
            "Event": float(EVENT_HZ),
            "Cyclic": 1000 / cycle if cycle > 0 else 0.0,
            "CyclicAndOnChange": 1000 / delay if delay > 0 else 0.0,
        }.get(db.send_type(message), 0.0)
        bits_a_second += hertz * worst_frame_bits(message.dlc) * (escs if message.is_of_an_esc else 1)
    return bits_a_second / bit_rate


def worst_frame_bits(data_bytes: int) -> int:
    """Bits of a classic frame with an 11-bit id, intermission included. SOF to CRC are 34 bits and the data; of these a
    stuff bit can follow the first five and then every four."""
    stuffed = 34 + 8 * data_bytes
    return stuffed + (stuffed - 1) // 4 + 13


Rule = Callable[[Database], Iterator[str]]
RULES: dict[str, Rule] = {
    rule.__name__: rule
    for rule in (
        text_is_ascii_with_line_feeds, every_line_is_understood, header_is_plain, sections_are_in_order,
        names_are_pascal_case, names_are_unique, percent_signals_say_so, nodes_are_gateway_and_logger,
        ids_are_in_the_free_range, eight_escs_fit, messages_have_eight_bytes, signals_are_intel_on_byte_borders,
        signals_do_not_overlap, flags_are_plain_bits, alive_counters_are_where_they_belong,
        not_available_and_error_are_named, limits_leave_out_the_codes, value_tables_belong_to_signals,
        enums_are_closed, everything_has_one_comment, attributes_are_declared, attributes_belong_to_something,
        enum_attributes_are_set_by_index, bus_is_can_and_not_j1939, version_is_in_attribute_and_comment,
        messages_have_a_schedule, start_values_are_raw_not_available, one_esc_loads_the_bus_below_ten_percent,
    )
}  # fmt: skip


def findings(data: bytes) -> list[str]:
    """Every violation of every rule, as `rule: what`."""
    db = parse(data)
    return [f"{name}: {finding}" for name, rule in RULES.items() for finding in rule(db)]
