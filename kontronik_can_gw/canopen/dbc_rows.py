"""Rows of the PDO DBC: messages and signals, and the text that cantools reads them from (``dbc/writer.py`` writes the file)."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction

LAYOUT_VERSION = "1.0.0"
_GATEWAY, _LOGGER = "KontronikGateway", "Logger"
_SEND_TYPES = ("Cyclic", "Event", "OnChange", "CyclicAndEvent", "CyclicAndOnChange", "None")

_DEFINITIONS = f"""\
BA_DEF_ "LayoutVersion" STRING ;
BA_DEF_ "BusType" STRING ;
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ BO_ "GenMsgSendType" ENUM {",".join(f'"{name}"' for name in _SEND_TYPES)};
BA_DEF_ BO_ "GenMsgDelayTime" INT 0 65535;
BA_DEF_ SG_ "GenSigStartValue" FLOAT -2147483648 4294967295;
BA_DEF_DEF_ "LayoutVersion" "";
BA_DEF_DEF_ "BusType" "CAN";
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "GenMsgSendType" "None";
BA_DEF_DEF_ "GenMsgDelayTime" 0;
BA_DEF_DEF_ "GenSigStartValue" 0;
BA_ "LayoutVersion" "{LAYOUT_VERSION}";
BA_ "BusType" "CAN";"""


@dataclass(frozen=True)
class Signal:
    """One SG_ line. ``low``, ``high`` and ``start_value`` are raw."""

    name: str
    start: int
    length: int
    comment: str
    signed: bool = False
    is_float: bool = False
    factor: Fraction = Fraction(1)
    unit: str = ""
    low: int = 0
    high: int = 1
    start_value: int = 0
    names: Mapping[int, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Message:
    """One BO_ line and its attributes; times in ms."""

    cob_id: int
    name: str
    length: int
    comment: str
    send_type: str
    cycle: int
    delay: int
    signals: Sequence[Signal]


def dbc_lines(messages: Sequence[Message], about: str) -> Iterator[str]:
    """The text of a DBC with these messages; ``about`` is its comment."""
    yield f'VERSION ""\nNS_ :\nBS_:\nBU_: {_GATEWAY} {_LOGGER}'
    for message in messages:
        yield f"BO_ {message.cob_id} {message.name}: {message.length} {_GATEWAY}"
        yield from map(_signal_line, message.signals)
    pairs = [(message, signal) for message in messages for signal in message.signals]
    yield f'CM_ "{_plain(about)}";'
    yield f'CM_ BU_ {_GATEWAY} "Gateway that is a CANopen node for each KONTRONIK ESC. It sends every message of this file.";'
    yield f'CM_ BU_ {_LOGGER} "Any receiver: logger, display or controller.";'
    yield from (f'CM_ BO_ {message.cob_id} "{_plain(message.comment)}";' for message in messages)
    yield from (
        f'CM_ SG_ {message.cob_id} {signal.name} "{_plain(signal.comment)}";'
        for message, signal in pairs
    )
    yield _DEFINITIONS
    attributes: tuple[tuple[str, Callable[[Message], int]], ...] = (
        ("GenMsgCycleTime", lambda message: message.cycle),
        ("GenMsgSendType", lambda message: _SEND_TYPES.index(message.send_type)),
        ("GenMsgDelayTime", lambda message: message.delay),
    )
    for message in messages:
        yield from (
            f'BA_ "{name}" BO_ {message.cob_id} {value(message)};' for name, value in attributes
        )
    for message, signal in pairs:
        yield f'BA_ "GenSigStartValue" SG_ {message.cob_id} {signal.name} {signal.start_value};'
    for message, signal in pairs:
        if signal.names:
            texts = " ".join(f'{number} "{text}"' for number, text in sorted(signal.names.items()))
            yield f"VAL_ {message.cob_id} {signal.name} {texts} ;"
    for message, signal in pairs:
        if signal.is_float:
            yield f"SIG_VALTYPE_ {message.cob_id} {signal.name} : {1 if signal.length == 32 else 2};"
    yield ""


def _signal_line(signal: Signal) -> str:
    low, high = (0, 0) if signal.is_float else (signal.low, signal.high)  # [0|0]: no limits
    limits = f"{number(low * signal.factor)}|{number(high * signal.factor)}"
    return (
        f" SG_ {signal.name} : {signal.start}|{signal.length}@1{'-' if signal.signed else '+'} "
        f'({number(signal.factor)},0) [{limits}] "{signal.unit}" {_LOGGER}'
    )


def number(value: Fraction) -> str:
    """A number as DBC files have it."""
    return str(value.numerator) if value.denominator == 1 else repr(float(value))


def _plain(text: str) -> str:
    """A comment without what a parser may take for syntax: names of objects come from any EDS."""
    return text.translate(str.maketrans('";\\', "',/"))
