"""Builds and runs every_value.c for a DBC, with the core in C as `export c` writes it.

The expected frames are written as tables of the specification (dbc_proof/expected.py).
"""

import math
import re
import subprocess
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from built import there
from dbc_proof.expected import ExpectedMessage, ExpectedSignal, expected_messages
from specification import INFO_FIELDS, LIVE_FIELDS, TYPE_RANGES, Field
from specification.quantities import PRODUCT, Divisor, Presence, Read
from specification.rule import Rule, Shape

from kontronik_can_gw.assembly.assemble import load_configuration
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.desk.export_c import exported
from kontronik_can_gw.desk.recordings.layouts import layout_of_dbc

HERE = Path(__file__).parent
OPTIONS = ("-std=gnu99", "-O2", "-DKCG_SLICES=8")
FIELDS = (
    *(("live", field) for field in LIVE_FIELDS),
    *(("info", field) for field in INFO_FIELDS),
)
"""The fields of both kinds of frame, in the order of their rows in C."""
PRESENCES = {Presence.LIVE: "LIVE", Presence.INFO: "INFO", Presence.KNOWN_INFO: "LAST_INFO"}
DIVISORS = {
    Divisor.ONE: "FREE",
    Divisor.POLES: "POLES",
    Divisor.OUTPUT: "OUTPUT",
    Divisor.CELLS: "CELLS",
}
DBC = shipped("dbc/kontronik_esc.dbc")
WORD_BITS = 64
WORDS = 8
MOST = 1 << 126
"""every_value.c computes with smaller numbers."""


@dataclass(frozen=True)
class Compared:
    values: int
    frames: int


def bits_of_field(field: Field) -> int:
    low, high = TYPE_RANGES[field.code]
    return (high - low).bit_length()


def field_of(read: Read) -> int:
    """Return the row of the field that a value is read from."""
    if read == PRODUCT:
        return next(n for n, (_, field) in enumerate(FIELDS) if field.name == "battery_voltage")
    places = [(source, field.offset) for source, field in FIELDS]
    return places.index((read.source, read.offset))


def is_of_a_frame(rule: Rule) -> bool:
    """Return True for a value that depends on fields and settings only."""
    quantity = rule.quantity
    if quantity is None or rule.shape is Shape.FLOAT:
        return False
    return bool(quantity.read.wire) or quantity.read == PRODUCT


def runs_of(bits: Sequence[int]) -> list[str]:
    """Return the bits of a number as rows of neighbouring bits in a word."""
    rows = []
    begin = 0
    for end in range(1, len(bits) + 1):
        is_next = end < len(bits) and bits[end] == bits[end - 1] + 1 and bits[end] % WORD_BITS
        if not is_next:
            rows.append(f"{{{begin}, {end - begin}, {bits[begin]}}}")
            begin = end
    return rows


def words_of(bits: Iterable[int]) -> str:
    """Return a frame with these bits set, as an initializer in C."""
    number = sum(1 << bit for bit in set(bits))
    words = [number >> WORD_BITS * k & (1 << WORD_BITS) - 1 for k in range(WORDS)]
    return "{" + ", ".join(f"{word:#x}u" for word in words) + "}"


class Header:
    """The text of expected.h: fields, messages and signals."""

    def __init__(self, messages: Sequence[ExpectedMessage]) -> None:
        self.runs: list[str] = []
        self.codes: list[int] = []
        self.names: list[str] = []
        self.pages: list[str] = []
        self.signals: list[str] = []
        self.messages: list[str] = []
        self.left_out: list[str] = []
        """Signals that are not compared."""
        self.rounds = 1
        for message in messages:
            self._add(message)

    def _add_runs(self, bits: Sequence[int]) -> str:
        rows = runs_of(bits)
        self.runs += rows
        return f"{len(self.runs) - len(rows)}, {len(rows)}"

    def _add(self, message: ExpectedMessage) -> None:
        first_page = len(self.pages)
        self.rounds = math.lcm(self.rounds, len(message.pages))
        alive = ""
        alive_values = 1
        crc_at = 0
        hidden: dict[int | None, set[int]] = {}
        for signal in message.signals:
            rule = signal.rule
            if rule is not None and rule.shape is Shape.ALIVE:
                alive = self._add_runs(signal.bits)
                alive_values = rule.modulus
            elif rule is not None and rule.shape is Shape.CRC:
                crc_at = min(signal.bits) // 8
            elif rule is not None and is_of_a_frame(rule):
                self._add_signal(message, signal, rule, first_page)
            elif rule is None or rule.shape is not Shape.CONSTANT:
                hidden.setdefault(signal.page, set()).update(signal.bits)
                self.left_out.append(f"{message.name}.{signal.name}")
        for page in message.pages:
            bits = []
            for signal in message.signals:
                rule = signal.rule
                is_constant = rule is not None and rule.shape is Shape.CONSTANT
                if rule is not None and is_constant and signal.page in (None, page):
                    bits += set_bits(signal.bits, rule.constant)
            bits += set_bits(message.multiplexer, page or 0)
            unknown = hidden.get(None, set()) | hidden.get(page, set())
            compared = set(range(8 * message.length)) - unknown
            self.pages.append(f"{{{page or 0}, {words_of(bits)}, {words_of(compared)}}}")
        crc = message.crc
        is_last = message.sending is not None and message.sending.follows_gateway
        numbers = (
            *(message.can_id | message.extended << 31, message.length),
            *(first_page, len(message.pages), int(is_last)),
        )
        row = [f'"{message.name}"', *map(str, numbers)]
        row += [self._add_runs(message.multiplexer), alive or "0, 0", str(alive_values)]
        if crc is None:
            row += ["0"] * 7 + ["{0}"]
        else:
            ids = ", ".join(map(str, crc.data_ids))
            row += map(str, (crc.bits, crc_at, crc.polynomial, crc.start, crc.final_xor))
            row += [str(crc.id_bytes), str(int(crc.is_id_last)), f"{{{ids}}}"]
        self.messages.append(f"{{{', '.join(row)}}}")

    def _add_signal(
        self, message: ExpectedMessage, signal: ExpectedSignal, rule: Rule, first_page: int
    ) -> None:
        quantity = rule.quantity
        assert quantity is not None
        page = "ANY" if signal.page is None else first_page + message.pages.index(signal.page)
        nought = rule.exact(Fraction(0))
        step = rule.exact(Fraction(1, quantity.steps)) - nought
        by = math.lcm(step.denominator, nought.denominator)
        factor, offset = int(step * by), int(nought * by)
        assert 2 * (abs(factor) << 52) + 2 * (abs(offset) << 28) + (by << 29) < MOST, signal.name
        low, high = rule.raw_limits
        first_name = len(self.names)
        self.names += [f"{{{number}, {raw}}}" for number, raw in rule.numbers.items()]
        codes = sorted(rule.codes)
        numbers = (
            *(len(self.messages), page, rule.esc, PRESENCES[quantity.presence]),
            *(field_of(quantity.read), quantity.read.shift, quantity.read.mask),
            *(int(quantity.read == PRODUCT), DIVISORS[quantity.divisor]),
            sum(1 << device for device in quantity.not_on),
            *(factor, offset, by, low, high, rule.error, rule.not_available),
            *(len(self.codes), len(codes), first_name, len(rule.numbers)),
        )
        self.codes += codes
        row = [f'"{signal.name}"', *map(str, numbers), self._add_runs(signal.bits)]
        self.signals.append(f"{{{', '.join(row)}, {rule.length}}}")

    def text(self, quiet_after_ns: int, is_long: bool) -> str:
        fields = []
        for source, field in FIELDS:
            size = bits_of_field(field) // 8
            is_signed = int(TYPE_RANGES[field.code][0] < 0)
            is_info = int(source == "info")
            fields.append(f'{{"{field.name}", {field.offset}, {size}, {is_signed}, {is_info}}}')
        names = [field.name for _, field in FIELDS]
        places = {
            "SPEED": names.index("electrical_speed"),
            "VOLTAGE": names.index("battery_voltage"),
            "CURRENT": names.index("battery_current"),
            "DEVICE": names.index("device_and_variant"),
            "CELL_COUNT": names.index("cell_count"),
            "ROUNDS": self.rounds,
            "IS_LONG": int(is_long),
        }
        numbers = ", ".join(f"{name} = {place}" for name, place in places.items())
        tables = {
            "struct field fields": fields,
            "struct run runs": self.runs,
            "int64_t codes": [*map(str, self.codes)] or ["0"],
            "struct named named": self.names or ["{0, 0}"],
            "struct page pages": self.pages,
            "struct message messages": self.messages,
            "struct signal signals": self.signals,
        }
        lines = [f"enum {{ {numbers} }};", f"#define QUIET_AFTER INT64_C({quiet_after_ns})"]
        for name, rows in tables.items():
            lines += [f"static const {name}[] = {{", *(f"    {row}," for row in rows), "};"]
        return "\n".join([*lines, ""])


def set_bits(bits: Sequence[int], number: int) -> list[int]:
    """Return the positions in the frame of the set bits of a number."""
    return [at for place, at in enumerate(bits) if number >> place & 1]


def export_shipped(folder: Path) -> None:
    """Write the core and the tables of the shipped DBC into a folder."""
    bus = layout_of_dbc(DBC)
    for name, text in exported(CoreSettings(bus.escs, bus.layout), "").items():
        (folder / name).write_text(text, encoding="utf-8")


def compare_values(configuration: Path, part: str, is_long: bool = False) -> Compared:
    """Run a part of the comparison. Raises AssertionError with the first difference.

    ``is_long``: 2^20 values of each field with 32 bits, otherwise 2^16. Without it, only the first
    scene has all values of the fields with 16 bits.
    """
    folder = configuration.parent
    loaded = load_configuration(configuration)
    assert loaded.database is not None
    config = loaded.config
    quiet_after_ns = config.can.quiet_after_ns
    for name, text in exported(loaded.core_settings, "").items():
        (folder / name).write_text(text, encoding="utf-8")
    header = Header([*expected_messages(loaded.database, loaded.escs, config.dbc)])
    (folder / "expected.h").write_text(header.text(quiet_after_ns, is_long))
    program = folder / "every_value"
    sources = [str(HERE / "every_value.c"), str(folder / "tables.c")]
    command = [there(), *OPTIONS, "-I", str(folder), "-o", str(program), *sources]
    subprocess.run(command, check=True)
    done = subprocess.run([str(program), part], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    print(f"{part}: {done.stdout.strip()}; not compared: {', '.join(header.left_out) or 'none'}")
    values, frames = map(int, re.findall(r"\d+", done.stdout))
    return Compared(values, frames)
