"""Counter-examples in the words of a user: names of values, physical numbers, units."""

from fractions import Fraction

from specification import DEVICES
from specification.quantities import Divisor, Presence
from specification.rule import Rule, Shape

from dbc_proof.expected import ExpectedSignal
from dbc_proof.formulas import CounterExample, Settings

_CAUSES = {
    Presence.LIVE: "without fresh live data",
    Presence.INFO: "without fresh info data",
    Presence.KNOWN_INFO: "without info data",
    Presence.AFTER_LIVE: "before the first live frame",
    Presence.RATED: "before a rate is known",
    Presence.ALWAYS: "while it is not available",
}


def counter_example(signal: ExpectedSignal, found: CounterExample) -> str:
    """Return a sentence such as "battery current -3276.8 A is sent as 3276.7 A"."""
    rule = signal.rule
    assert rule is not None
    assert rule.quantity is not None
    name = signal.source.replace("_", " ")
    if found.available:
        value = Fraction(found.steps, rule.quantity.steps)
        value /= found.settings.ratio(rule.quantity.divisor)
        subject = f"{name} {_value(signal, value, found.steps)}"
    else:
        subject = f"{name} {_CAUSES[rule.quantity.presence]}"
    details = _details(rule, found.settings, found.device)
    got = sent(signal, found.got)
    want = sent(signal, found.want)
    return f"{subject}{details} is sent as {got}, not as {want}"


def _value(signal: ExpectedSignal, value: Fraction, steps: int) -> str:
    """Return a number of the quantity's unit in the signal's unit."""
    rule = signal.rule
    assert rule is not None
    if rule.shape is Shape.NAMES:
        return f"{steps}"
    unit = signal.unit or (rule.quantity.unit if rule.quantity else "")
    return f"{decimal(value * rule.scale + rule.shift)} {unit}".rstrip()


def _details(rule: Rule, settings: Settings, device: int | None) -> str:
    assert rule.quantity is not None
    divisor = rule.quantity.divisor
    details = ""
    if divisor in (Divisor.POLES, Divisor.OUTPUT):
        details += f" with {settings.poles} pole pairs"
    if divisor is Divisor.OUTPUT:
        details += f" and gear {settings.gear}"
    if divisor is Divisor.CELLS:
        details += f" with {settings.cells} cells"
    if device is not None:
        details += f" of device {device}"
        if device in DEVICES:
            details += f" ({DEVICES[device]})"
    return details


def sent(signal: ExpectedSignal, raw: int) -> str:
    """Return a raw value as its receiver reads it."""
    rule = signal.rule
    assert rule is not None
    is_value = rule.is_value(raw) or rule.shape is Shape.FLAG
    if not is_value and raw == rule.not_available:
        return "NotAvailable"
    if not is_value and raw == rule.error:
        return "Error"
    if rule.shape is Shape.NAMES:
        return f"number {raw} of the value table"
    unit = signal.unit or (rule.quantity.unit if rule.quantity else "")
    return f"{decimal(rule.physical(raw))} {unit}".rstrip()


def decimal(number: Fraction) -> str:
    """Return a number for people."""
    return f"{float(number):.12g}"
