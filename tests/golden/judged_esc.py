"""The data of an ESC as found in its bytes by brute force, and the correct values of signals.

The judge of the golden set and the recorded hour use it. It uses the protocol specification and the
oracle of values, but nothing of the product.
"""

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import accumulate
from types import SimpleNamespace
from typing import Any, NamedTuple

import specification
from cantools.database.can.signal import Signal
from esc import reference
from packer_oracle import KNOWN

NS_PER_BYTE = 11 * 10**9 // 115_200
INFO_NS = 10 * 10**9
"""Info data older than this is not available."""
CONVERSIONS: dict[tuple[str, str], int | Fraction] = {
    ("V", "mV"): 1000,
    ("A", "mA"): 1000,
    ("us", "ms"): Fraction(1, 1000),
}
LIVE = {f.name: f for f in specification.LIVE_FIELDS}
INFO = {f.name: f for f in specification.INFO_FIELDS}
OF_SETTINGS = {"motor_speed", "output_speed", "mean_cell_voltage"}
"""Values that depend on settings."""
_DERIVED = {
    "operating_state_raw",
    "battery_power",
    "device",
    "device_raw",
    "variant",
    "firmware_main",
    "firmware_sub",
    "layout",
    "data_age",
}
JUDGED = {*_DERIVED, *OF_SETTINGS, *LIVE, *INFO} & KNOWN.keys()
"""Values that depend on telemetry and settings only."""
Values = Mapping[str, int]
Bytes = tuple[int, bytes | None]
"""The time of an input and the bytes read. None: the port was lost."""
Arrivals = list[tuple[str, str, Values, int]]
"""Frames that become certain with an input: kind, layout, values, time of the last byte."""


class State(NamedTuple):
    """The data of an ESC."""

    live: Values | None = None
    """Newest live data. None unless it is fresh."""
    live_ns: int | None = None
    """Arrival of the newest live data, fresh or not."""
    info: Values | None = None
    """Newest info data. None unless it is fresh."""
    info_ns: int = 0
    """Arrival of the newest info data, fresh or not."""
    last_info: Values | None = None
    """Newest info data, fresh or not."""
    layout: int = 0
    """1: V4. 2: legacy. 0: unknown."""


@dataclass
class Esc:
    """An ESC: its settings and its state."""

    prefix: str
    pole_pairs: int = 1
    gear: Fraction = Fraction(1)
    cells: int = 0
    timeout: int = 250_000_000
    state: State = State()
    passed: list[State] = field(default_factory=list)
    """States since the time of the last input."""
    sure: bool = True
    """False after a change of the settings that the judge does not understand."""

    def expire(self, now: int) -> bool:
        """Forget data that is too old. Returns True if the state has changed."""
        before = self.state
        live_age = now - (before.live_ns or 0)
        if before.live is not None and live_age > self.timeout:
            self.lose()
        if self.state.info is not None and now - self.state.info_ns > INFO_NS:
            self.state = self.state._replace(info=None)
        return before is not self.state

    def lose(self) -> None:
        self.state = self.state._replace(live=None, info=None)

    def take(
        self,
        kind: str,
        layout: str,
        values: Values,
        when: int,
    ) -> None:
        """Receive a frame whose last byte arrived at ``when``."""
        number = 1 if layout == "v4" else 2
        if number != self.state.layout:
            self.state = self.state._replace(layout=number, info=None, last_info=None)
        if kind == "info":
            self.state = self.state._replace(info=values, info_ns=when, last_info=values)
        else:
            when = max(when, self.state.live_ns or 0)
            self.state = self.state._replace(live=values, live_ns=when)


def found_frames(inputs: list[Bytes], timeout: int) -> list[Arrivals | None]:
    """Find by brute force the frames that become certain with each input.

    A frame is certain if no further byte can change it. The result of an input is None if the port
    was lost.
    """
    found: list[Arrivals] = [[] for _ in inputs]
    begin = 0
    while begin < len(inputs):
        end = begin
        while end < len(inputs) and inputs[end][1] is not None:
            end += 1
            if end < len(inputs) and inputs[end][0] - inputs[end - 1][0] > timeout:
                break  # the incomplete frame is discarded
        if end > begin:
            _search(inputs, begin, end, timeout, found)
        begin = end if end > begin else end + 1
    results: list[Arrivals | None] = []
    for (_, data), arrivals in zip(inputs, found, strict=True):
        results.append(None if data is None else arrivals)
    return results


def _search(
    inputs: list[Bytes],
    begin: int,
    end: int,
    timeout: int,
    found: list[Arrivals],
) -> None:
    """Add the frames of the inputs from ``begin`` to ``end`` to ``found``."""
    parts = [data or b"" for _, data in inputs[begin:end]]
    stream = b"".join(parts)
    ends = list(accumulate(map(len, parts)))
    moment = 0  # number of bytes after which the frame is certain
    gap = 0  # end of the frame before
    for frame in reference.frames_of(stream):
        moment = max(moment, frame.end)
        for at in range(gap, frame.offset):
            longest = reference.LONGEST_OF.get(stream[at : at + 4], 0)
            moment = max(moment, at + longest)
        gap = frame.end
        if moment > len(stream):
            continue  # the frame is found only when the rest of the stream is discarded
        index = next(n for n, size in enumerate(ends) if size >= moment)
        now = inputs[begin + index][0]
        when = now - (ends[index] - frame.end) * NS_PER_BYTE
        if now - when <= timeout:
            values = fields_of(frame.kind, frame.raw)
            found[begin + index].append((frame.kind, frame.layout, values, when))


def fields_of(kind: str, raw: bytes) -> Values:
    """Return the raw values of a frame's fields."""
    listed = specification.LIVE_FIELDS if kind == "live" else specification.INFO_FIELDS
    values = {}
    for one in listed:
        (values[one.name],) = struct.unpack_from(f"<{one.code}", raw, one.offset)
    return values


def snake(name: str) -> str:
    """Return the name of the value that a signal of the shipped DBC has."""
    return re.sub("(?<!^)(?=[A-Z])", "_", name.removesuffix("Percent")).lower()


def _as_object(values: Values | None) -> SimpleNamespace | None:
    return None if values is None else SimpleNamespace(**values)


def expected(
    name: str,
    esc: Esc,
    state: State,
    now: int,
) -> Fraction | int | None:
    """Return the correct value of a signal, in the unit of the protocol specification.

    Returns None if the value is not available. KeyError if the value is not judged.
    """
    plain = snake(name)
    if plain not in JUDGED or (plain in OF_SETTINGS and not esc.sure):
        raise KeyError(name)
    made: Any = SimpleNamespace(
        live=_as_object(state.live),
        info=_as_object(state.info),
        last_info=_as_object(state.last_info),
        layout=state.layout,
        live_ns=state.live_ns,
        settings=esc,
        cells=esc.cells or (state.info or {}).get("cell_count", 0),
    )
    of_gateway: Any = None
    return KNOWN[plain].read(made, of_gateway, now)


def fits(
    signal: Signal,
    raw: float,
    value: Fraction | int | None,
    unit: str,
) -> bool:
    """Return True if the raw value is correct for a value in this unit."""
    texts: dict[str, int] = {}
    for number, text in (signal.choices or {}).items():
        texts[str(text)] = number
    if value is None:
        return _is_not_available(signal, raw, texts)
    value = Fraction(value) * CONVERSIONS.get((unit, signal.unit or ""), 1)
    if signal.is_float:
        physical = raw * signal.scale + signal.offset
        return bool(abs(physical - float(value)) <= 1e-6 * abs(value))
    offset = Fraction(str(signal.offset))
    scale = Fraction(str(signal.scale))
    ideal = float((value - offset) / scale)
    codes = 1 << signal.length
    top = codes // 2 - 1 if signal.is_signed else codes - 1
    fits_into_bits = top - codes < ideal < top + 0.5
    if not fits_into_bits or _is_out_of_range(signal, ideal, value, texts):
        return "Error" not in texts or raw == texts["Error"]
    return abs(raw - ideal) <= 0.5 + 1e-9


def _is_not_available(signal: Signal, raw: float, texts: Mapping[str, int]) -> bool:
    if signal.is_float and signal.raw_initial is None:
        return raw != raw
    if signal.raw_initial is not None:
        code = int(signal.raw_initial)
    elif signal.is_signed:
        code = -1 << signal.length - 1
    else:
        code = (1 << signal.length) - 1
    return bool(raw == texts.get("NotAvailable", code))


def _is_out_of_range(
    signal: Signal,
    ideal: float,
    value: Fraction,
    texts: Mapping[str, int],
) -> bool:
    """Return True if a value has no name in an enumeration, or is outside the signal's limits."""
    numbers = [number for text, number in texts.items() if text not in ("NotAvailable", "Error")]
    if numbers:
        return value not in numbers
    limits = (signal.minimum or 0, signal.maximum or 0)
    if limits == (0, 0):
        return False
    low, high = sorted(round((limit - signal.offset) / signal.scale) for limit in limits)
    return not low - 0.5 <= ideal < high + 0.5
