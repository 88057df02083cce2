"""The messages that the gateway sends: from the DBC in use, with what the compiled layout makes of it."""

import math
from collections.abc import Sequence
from fractions import Fraction
from pathlib import PurePath
from typing import Any

from kontronik_can_gw.desk.describe.parts import Facts, number, one_line, value_table
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.esc.telemetry import MS
from kontronik_can_gw.signals.plan import MessagePlan, Role, SendType, SignalPlan

_SEND_TYPES = {SendType.CYCLIC: "cyclic", SendType.EVENT: "event", SendType.ON_CHANGE: "on change"}


def bus_facts(bus: BusLayout, escs: Sequence[str]) -> Facts:
    """File, node and messages of a DBC."""
    found = {message.name: message for message in bus.database.messages}
    comment = next((bus.comment for bus in bus.database.buses if bus.comment), "")
    return {
        "file": PurePath(bus.layout.file).name,
        "node": bus.layout.node,
        "comment": one_line(comment),
        "messages": [_message(plan, found[plan.name], escs) for plan in bus.layout.messages],
    }


def _message(plan: MessagePlan, message: Any, escs: Sequence[str]) -> Facts:
    """A message, ``message`` as cantools has it. 0 ms: no cycle, or no minimum distance between two frames (``delay_ms``)."""
    signals = {signal.name: signal for signal in message.signals}
    return {
        "name": plan.name,
        "id": plan.can_id,
        "extended": plan.extended,
        "fd": plan.fd,
        "length": plan.length,
        "send_type": [text for flag, text in _SEND_TYPES.items() if flag in plan.send_type],
        "cycle_ms": number(Fraction(plan.cycle_ns, MS)),
        "delay_ms": number(Fraction(plan.delay_ns, MS)),
        "comment": one_line(message.comment),
        "signals": [_signal(signal, signals[signal.name], escs) for signal in plan.signals],
    }


def _signal(plan: SignalPlan, signal: Any, escs: Sequence[str]) -> Facts:
    """A signal. Physical value in ``unit``: raw * factor + offset. ``start_bit`` as DBC files count; ``page``: multiplexer value.

    ``minimum`` and ``maximum`` are those of the DBC, else of what can be sent. ``not_available`` and ``error`` are raw values.
    ``role``: source, alive counter, CRC, constant or multiplexer. ``notes``: what of the source's resolution or range is lost.
    """
    plain_bit = plan.length == 1 and not plan.signed and plan.factor == 1 and plan.offset == 0
    has_codes = plan.role is Role.SOURCE and not (plain_bit and plan.numbers is None)
    low, high = _range(plan)
    choices = {int(value): str(text) for value, text in (signal.choices or {}).items()}
    return {
        "name": plan.name,
        "start_bit": signal.start,
        "length": plan.length,
        "byte_order": signal.byte_order,
        "signed": plan.signed,
        "is_float": plan.is_float,
        "unit": plan.unit,
        "factor": number(plan.factor),
        "offset": number(plan.offset),
        "minimum": _finite(low if signal.minimum is None else signal.minimum),
        "maximum": _finite(high if signal.maximum is None else signal.maximum),
        "not_available": plan.not_available if has_codes else None,
        "error": plan.error if has_codes else None,
        "page": plan.page,
        "role": plan.role.value,
        "source": None if plan.source is None else plan.source.name,
        "esc": None if plan.esc is None else escs[plan.esc],
        "comment": one_line(signal.comment),
        "values": value_table(choices),
        "notes": [f"{note[:1].upper()}{note[1:]}" for note in plan.notes],
    }


def _range(plan: SignalPlan) -> list[float]:
    """The least and the largest physical value that can be sent."""
    if plan.is_float:
        return sorted(raw * float(plan.factor) + float(plan.offset) for raw in plan.limits)
    return sorted(float(raw * plan.factor + plan.offset) for raw in (plan.low, plan.high))


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
