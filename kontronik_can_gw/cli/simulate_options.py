"""Options of ``simulate``, and what their texts mean. A text that means nothing is kept, so that all mistakes are reported at once."""

import argparse
import re
from collections.abc import Callable
from typing import NamedTuple, TypeVar

from kontronik_can_gw.cli.arguments import option
from kontronik_can_gw.errors import did_you_mean
from kontronik_can_gw.esc.kontronik.simulator import (
    FLIGHT,
    IDLE,
    Device,
    Dropout,
    ErrorWindow,
    EscOptions,
    Faults,
    Layout,
    OperatingError,
    SelfTestError,
    Swap,
)

T = TypeVar("T")
_MIXED = "mixed"


class _Mistake(NamedTuple):
    text: str
    why: str


def mistakes(args: argparse.Namespace) -> list[str]:
    """A line for each text that means nothing."""
    found = []
    for name, value in vars(args).items():
        for each in value if isinstance(value, list) else [value]:
            if isinstance(each, _Mistake):
                end = "" if each.why.endswith("?") else "."
                found.append(f"--{name.replace('_', '-')} {each.text}: {each.why}{end}")
    return found


def esc_options(args: argparse.Namespace, number: int) -> EscOptions:
    """Options of the ESC with this number, from 1."""
    layout = args.layout
    if layout == _MIXED:
        layout = Layout.V4 if number % 2 else Layout.LEGACY
    return EscOptions(
        device=args.device or (Device.JIVEPRO if layout is Layout.LEGACY else Device.KOSMIK),
        layout=layout,
        variant=args.variant,
        firmware=args.firmware,
        cell_count=args.cells,
        period_ns=round(1e9 / args.rate),
        info_every=args.info_every,
        info_replaces=args.info_replaces,
        profile=IDLE if args.idle else FLIGHT,
        faults=Faults(
            noise=args.noise,
            lost_bytes=args.lose_bytes,
            flipped_bits=args.flip_bits,
            dropout=args.dropout,
            errors=tuple(args.error),
            swaps=tuple(sorted(args.swap_device, key=lambda swap: swap.time_ns)),
        ),
    )


def _type(parse: Callable[..., T], *limits: float) -> Callable[[str], T | _Mistake]:
    """An argparse type: what ``parse`` makes of a text and the limits."""

    def read(text: str) -> T | _Mistake:
        try:
            return parse(text, *limits)
        except ValueError as error:
            return _Mistake(text, str(error))

    return read


def _whole_number(text: str, low: int | None = None, high: int | None = None) -> int:
    if not re.fullmatch(r"[+-]?[0-9]{1,18}", text):
        raise ValueError("not a whole number")
    value = int(text)
    if (low is not None and value < low) or (high is not None and value > high):
        raise ValueError(f"outside {low}..{high}")
    return value


def _number(text: str, low: float, high: float) -> float:
    try:
        value = float(text)
    except ValueError:
        raise ValueError("not a number") from None
    if not low <= value <= high:
        raise ValueError(f"outside {low}..{high}")
    return value


def _share(text: str) -> float:
    try:
        if text.endswith("%"):
            return _number(text.removesuffix("%"), 0, 100) / 100
        return _number(text, 0, 1)
    except ValueError as error:
        raise ValueError(f"{error}. Give a share such as 0.001 or 0.1%") from None


def _time_ns(text: str) -> int:
    """A TIME in nanoseconds."""
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]*)?|\.[0-9]+)\s*(ms|s|min|h|)", text.strip())
    if not match:
        raise ValueError(f"{text!r} is not a time. Give for example 5s, 200ms or 2min")
    value = float(match[1]) * {"ms": 1e6, "s": 1e9, "": 1e9, "min": 60e9, "h": 3600e9}[match[2]]
    if value > 1e18:
        raise ValueError(f"{text!r} is more than 30 years")
    return round(value)


def _choice(text: str, choices: dict[str, T]) -> T:
    """The choice with this name; case, ``-``, ``_`` and blanks are ignored."""
    plain = {re.sub(r"[-_ ]", "", name).lower(): name for name in choices}
    key = re.sub(r"[-_ ]", "", text).lower()
    if key in plain:
        return choices[plain[key]]
    near = did_you_mean(key, plain, show=plain.__getitem__)
    raise ValueError(f"no such name as {text!r}.{near or ' There are: ' + ', '.join(choices)}")


def _device(text: str) -> Device:
    return _choice(text, {device.text.lower(): device for device in Device})


def _layout(text: str, *more: str) -> Layout:
    names = {layout.value: layout for layout in Layout}
    if text.lower() not in names:
        raise ValueError(f"no such layout. There are: {', '.join((*names, *more))}")
    return names[text.lower()]


def _layout_or_mixed(text: str) -> Layout | str:
    return _MIXED if text.lower() == _MIXED else _layout(text, _MIXED)


def _firmware(text: str) -> tuple[int, int]:
    main_version, dot, sub = text.partition(".")
    if not dot:
        raise ValueError("not a version. Give for example 1.14")
    return _whole_number(main_version, 0, 255), _whole_number(sub, 0, 255)


def _dropout(text: str) -> Dropout:
    duration, slash, interval = text.partition("/")
    if not slash:
        raise ValueError(
            "the interval is missing. Give for example 2s/10s: 2 s of silence in every 10 s"
        )
    dropout = Dropout(_time_ns(duration), _time_ns(interval))
    if dropout.duration_ns >= dropout.interval_ns:
        raise ValueError("the silence must be shorter than the interval. Give for example 2s/10s")
    return dropout


def _error(text: str) -> ErrorWindow:
    name, at, when = text.partition("@")
    bits: dict[str, OperatingError | SelfTestError] = {bit.text: bit for bit in OperatingError}
    bits |= {bit.text: bit for bit in SelfTestError}
    bit = _choice(name, bits)
    if not at:
        raise ValueError("the time is missing. Give for example undervoltage@5s+2s")
    start, plus, duration = when.partition("+")
    return ErrorWindow(bit, _time_ns(start), _time_ns(duration) if plus else None)


def _swap(text: str) -> Swap:
    what, at, when = text.partition("@")
    name, colon, layout = what.partition(":")
    device = _device(name)
    if not at:
        raise ValueError("the time is missing. Give for example kolibri@20s or jivepro:legacy@20s")
    return Swap(_time_ns(when), device, _layout(layout) if colon else None)


# fmt: off
OPTIONS = (
    "what ESC",
    option("--esc N", "number of ESCs, 1..1000 (default 1)", type=_type(_whole_number, 1, 1000), default=1),
    option("--device NAME", "kosmik, kolibri, jivepro, kontrol-x or uhv (default: kosmik, in the legacy layout jivepro)",
           type=_type(_device)),
    option("--layout LAYOUT", "v4, legacy, or mixed: odd ESCs v4, even ones legacy (default: legacy for jivepro, else v4)",
           type=_type(_layout_or_mixed)),
    option("--variant N", "device variant (default 120)", type=_type(_whole_number, 0, 1023), default=120),
    option("--firmware MAIN.SUB", "firmware version (default 4.17)", type=_type(_firmware), default=(4, 17)),
    option("--cells N", "cell count (default 6)", type=_type(_whole_number, 1, 100), default=6),
    "how it sends",
    option("--rate HZ", "live frames a second, 0.1..10000 (default 100)", type=_type(_number, 0.1, 10_000), default=100.0),
    option("--info-every N", "an info frame each N frames, 0 never (default 100)", type=_type(_whole_number, 0, 1_000_000), default=100),
    option("--info-replaces", "info frames replace live frames (default: they follow them)"),
    option("--idle", "the motor never runs (default: a repeating flight of 50 s)"),
    option("--seconds S", "stop after this TIME", type=_type(_time_ns)),
    option("--seed N", "seed of all that is random (default 0)", type=_type(_whole_number), default=0),
    "where to",
    option("--link PATH", "symbolic link to the pseudo terminal; {n} is the ESC's number, from 1"),
    option("--out FILE", "write the bytes to FILE (- for standard output) as fast as possible, no pseudo terminal; {n} as for --link"),
    "misbehaviour",
    option("--noise MEAN", "mean number of random bytes before a frame", type=_type(_number, 0, 1000), default=0.0),
    option("--lose-bytes SHARE", "share of bytes that get lost", type=_type(_share), default=0.0),
    option("--flip-bits SHARE", "share of bits that are flipped", type=_type(_share), default=0.0),
    option("--dropout TIME/TIME", "length and interval of silences: 2s/10s", type=_type(_dropout)),
    option("--error NAME@TIME[+TIME]", "set an error bit at a time, for a time or for ever; may be repeated",
           type=_type(_error), action="append", default=[]),
    option("--swap-device NAME[:LAYOUT]@TIME", "plug in another device at a time; may be repeated",
           type=_type(_swap), action="append", default=[]),
)
# fmt: on
