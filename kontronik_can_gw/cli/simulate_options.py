"""Options of ``simulate``: their table, and what their texts mean. All mistakes are reported at once."""

import argparse
import re
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, TypeVar

from kontronik_can_gw.errors import did_you_mean

if TYPE_CHECKING:
    from kontronik_can_gw.esc.kontronik.simulator import (
        Device,
        Dropout,
        ErrorWindow,
        EscOptions,
        Layout,
        Swap,
    )

T = TypeVar("T")

# fmt: off
_OPTIONS: dict[str, tuple[tuple[str, str, str | None, str], ...]] = {
    "what ESC": (
        ("--esc", "N", "1", "number of ESCs, 1..1000 (default 1)"),
        ("--device", "NAME", None, "kosmik, kolibri, jivepro, kontrol-x or uhv (default: kosmik, in the legacy layout jivepro)"),
        ("--layout", "LAYOUT", None, "v4, legacy, or mixed: odd ESCs v4, even ones legacy (default: legacy for jivepro, else v4)"),
        ("--variant", "N", "120", "device variant (default 120)"),
        ("--firmware", "MAIN.SUB", "4.17", "firmware version (default 4.17)"),
        ("--cells", "N", "6", "cell count (default 6)"),
    ),
    "how it sends": (
        ("--rate", "HZ", "100", "live frames a second, 0.1..10000 (default 100)"),
        ("--info-every", "N", "100", "an info frame each N frames, 0 never (default 100)"),
        ("--info-replaces", "", None, "info frames replace live frames (default: they follow them)"),
        ("--idle", "", None, "the motor never runs (default: a repeating flight of 50 s)"),
        ("--seconds", "S", None, "stop after this TIME"),
        ("--seed", "N", "0", "seed of all that is random (default 0)"),
    ),
    "where to": (
        ("--link", "PATH", None, "symbolic link to the pseudo terminal; {n} is the ESC's number, from 1"),
        ("--out", "FILE", None,
         "write the bytes to FILE (- for standard output) as fast as possible, no pseudo terminal; {n} as for --link"),
    ),
    "misbehaviour": (
        ("--noise", "MEAN", "0", "mean number of random bytes before a frame"),
        ("--lose-bytes", "SHARE", "0", "share of bytes that get lost"),
        ("--flip-bits", "SHARE", "0", "share of bits that are flipped"),
        ("--dropout", "TIME/TIME", None, "length and interval of silences: 2s/10s"),
        ("--error", "NAME@TIME[+TIME]", None, "set an error bit at a time, for a time or for ever; may be repeated"),
        ("--swap-device", "NAME[:LAYOUT]@TIME", None, "plug in another device at a time; may be repeated"),
    ),
}
"""Options by group: name, what follows it, default, help."""
# fmt: on
_REPEATED = frozenset({"--error", "--swap-device"})


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options, all as text: ``main`` reads them and reports every mistake at once."""
    for title, options in _OPTIONS.items():
        group = parser.add_argument_group(title)
        for option, metavar, default, text in options:
            if not metavar:
                group.add_argument(option, action="store_true", help=text)
            elif option in _REPEATED:
                group.add_argument(option, metavar=metavar, action="append", default=[], help=text)
            else:
                group.add_argument(option, metavar=metavar, default=default, help=text)


class Texts:
    """Parses option texts and collects their mistakes."""

    def __init__(self, args: argparse.Namespace) -> None:
        self._args = args
        self.problems: list[str] = []

    def __call__(self, option: str, parse: Callable[[str], T]) -> T | None:
        """The parsed value of an option; None where it is not given, or with a line in the problems."""
        text = getattr(self._args, option[2:].replace("-", "_"))
        return None if text is None else self._parsed(option, text, parse)

    def _parsed(self, option: str, text: str, parse: Callable[[str], T]) -> T | None:
        try:
            return parse(text)
        except ValueError as error:
            end = "" if str(error).endswith("?") else "."
            self.problems.append(f"{option} {text}: {error}{end}")
            return None

    def _all_parsed(self, option: str, texts: Iterable[str], parse: Callable[[str], T]) -> list[T]:
        found = [self._parsed(option, text, parse) for text in texts]
        return [value for value in found if value is not None]

    def esc_options(self, number: int) -> "EscOptions | None":
        """Options of the ESC with this number, from 1."""
        from kontronik_can_gw.esc.kontronik.simulator import (
            FLIGHT,
            IDLE,
            Device,
            EscOptions,
            Faults,
            Layout,
        )

        args = self._args
        device = self("--device", _device)
        if args.layout is not None and args.layout.lower() == "mixed":
            layout: Layout | None = Layout.V4 if number % 2 else Layout.LEGACY
        else:
            layout = self("--layout", lambda text: _layout(text, "mixed"))
        if device is None:
            device = Device.JIVEPRO if layout is Layout.LEGACY else Device.KOSMIK
        values: dict[str, Any] = {
            "variant": self("--variant", lambda text: whole_number(text, 0, 1023)),
            "firmware": self("--firmware", _firmware),
            "cell_count": self("--cells", lambda text: whole_number(text, 1, 100)),
            "period_ns": self("--rate", lambda text: round(1e9 / _number(text, 0.1, 10_000))),
            "info_every": self("--info-every", lambda text: whole_number(text, 0, 1_000_000)),
        }
        faults: dict[str, Any] = {
            "noise": self("--noise", lambda text: _number(text, 0, 1000)),
            "lost_bytes": self("--lose-bytes", _share),
            "flipped_bits": self("--flip-bits", _share),
            "dropout": self("--dropout", _dropout),
            "errors": tuple(self._all_parsed("--error", args.error, _error)),
        }
        swaps = self._all_parsed("--swap-device", args.swap_device, _swap)
        if self.problems:
            return None
        swaps.sort(key=lambda swap: swap.time_ns)
        return EscOptions(
            device=device,
            layout=layout,
            info_replaces=args.info_replaces,
            profile=IDLE if args.idle else FLIGHT,
            faults=Faults(**faults, swaps=tuple(swaps)),
            **values,
        )


def whole_number(text: str, low: int | None = None, high: int | None = None) -> int:
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
        return (
            _number(text.removesuffix("%"), 0, 100) / 100
            if text.endswith("%")
            else _number(text, 0, 1)
        )
    except ValueError as error:
        raise ValueError(f"{error}. Give a share such as 0.001 or 0.1%") from None


def time_ns(text: str) -> int:
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


def _device(text: str) -> "Device":
    from kontronik_can_gw.esc.kontronik.simulator import Device

    return _choice(text, {device.text.lower(): device for device in Device})


def _layout(text: str, *more: str) -> "Layout":
    from kontronik_can_gw.esc.kontronik.simulator import Layout

    names = {layout.value: layout for layout in Layout}
    if text.lower() not in names:
        raise ValueError(f"no such layout. There are: {', '.join((*names, *more))}")
    return names[text.lower()]


def _firmware(text: str) -> tuple[int, int]:
    main_version, dot, sub = text.partition(".")
    if not dot:
        raise ValueError("not a version. Give for example 1.14")
    return whole_number(main_version, 0, 255), whole_number(sub, 0, 255)


def _dropout(text: str) -> "Dropout":
    from kontronik_can_gw.esc.kontronik.simulator import Dropout

    duration, slash, interval = text.partition("/")
    if not slash:
        raise ValueError(
            "the interval is missing. Give for example 2s/10s: 2 s of silence in every 10 s"
        )
    dropout = Dropout(time_ns(duration), time_ns(interval))
    if dropout.duration_ns >= dropout.interval_ns:
        raise ValueError("the silence must be shorter than the interval. Give for example 2s/10s")
    return dropout


def _error(text: str) -> "ErrorWindow":
    from kontronik_can_gw.esc.kontronik.simulator import ErrorWindow, OperatingError, SelfTestError

    name, at, when = text.partition("@")
    bits: dict[str, OperatingError | SelfTestError] = {bit.text: bit for bit in OperatingError}
    bits |= {bit.text: bit for bit in SelfTestError}
    bit = _choice(name, bits)
    if not at:
        raise ValueError("the time is missing. Give for example undervoltage@5s+2s")
    start, plus, duration = when.partition("+")
    return ErrorWindow(bit, time_ns(start), time_ns(duration) if plus else None)


def _swap(text: str) -> "Swap":
    from kontronik_can_gw.esc.kontronik.simulator import Swap

    what, at, when = text.partition("@")
    name, colon, layout = what.partition(":")
    device = _device(name)
    if not at:
        raise ValueError("the time is missing. Give for example kolibri@20s or jivepro:legacy@20s")
    return Swap(time_ns(when), device, _layout(layout) if colon else None)
