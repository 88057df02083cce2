"""Positions of the values in the frames of a DBC.

cantools creates the tables once, so that many frames can be decoded quickly in Python.
"""

import contextlib
import io
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

from feeder import Identity, info_values, live_values

LIVE_NAMES = frozenset(live_values(Identity(), 0))
INFO_NAMES = frozenset(info_values(Identity(), 0))
NOT_FOLLOWED = frozenset({"losses", "layout", "energy_used"})
"""Signals in messages of an ESC's values that the gateway itself computes."""
STATE_STEMS = frozenset({"Link", "Heartbeat", "Emergency"})


class Place(NamedTuple):
    """A signal: its bits, its scale, and the raw value for "not available", or None."""

    name: str
    start: int
    mask: int
    sign: int
    scale: float
    not_available: int | None

    def raw(self, bits: int) -> int:
        x = bits >> self.start & self.mask
        return x - self.mask - 1 if x & self.sign else x


class Message(NamedTuple):
    """A message with the number of its ESC (None for the gateway's own) and its signals."""

    can_id: int
    stem: str
    esc: int | None
    kind: str
    """The frame that the values are computed from: ``live``, ``info`` or ``other``."""
    places: tuple[Place, ...]
    """All signals. In a live or info message only the signals that are an ESC's values."""
    flags: tuple[int, int]
    """Start and mask of the error bits. The mask is 0 if the message has no error bits."""

    @property
    def name(self) -> str:
        return self.stem if self.esc is None else f"Esc{self.esc + 1}{self.stem}"


Table = dict[int, Message]


def _snake(name: str) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name.removesuffix("Percent")).lower()


def _message(message: Any, count: int) -> Message:
    whose = re.match(r"Esc(\d*)(?=[A-Z])", message.name)
    if whose is None or (count > 1) != bool(whose[1]):
        stem = message.name
        esc = None
        prefix = ""
    else:
        stem = message.name[whose.end() :]
        esc = int(whose[1] or 1) - 1
        prefix = whose[0] if count > 1 else ""
    places: list[Place] = []
    flags: list[Place] = []
    for signal in sorted(message.signals, key=lambda s: int(s.start)):
        assert signal.byte_order == "little_endian"
        assert not signal.offset
        assert not signal.is_multiplexer
        choices = {str(text): raw for raw, text in (signal.choices or {}).items()}
        place = Place(
            name=_snake(signal.name.removeprefix(prefix)),
            start=signal.start,
            mask=(1 << signal.length) - 1,
            sign=1 << signal.length - 1 if signal.is_signed else 0,
            scale=float(signal.scale),
            not_available=choices.get("NotAvailable"),
        )
        is_flag = signal.length == 1 and not choices
        if is_flag:
            flags.append(place)
        else:
            places.append(place)
    kind = "other"
    if esc is not None and stem not in STATE_STEMS:
        known = {place.name for place in places}
        kind = "live" if known & LIVE_NAMES else "info"
        followed = LIVE_NAMES if kind == "live" else INFO_NAMES
        left = known - followed - NOT_FOLLOWED - {"link_state", "live_counter"}
        left = {name for name in left if not name.endswith("_alive")}
        assert not left, f"{message.name}: nobody follows {left}"
        places = [place for place in places if place.name in followed]
        flags = [flag for flag in flags if flag.name not in ("replay", "info_valid")]
        assert all(flag.start == flags[0].start + i for i, flag in enumerate(flags))
    error_bits = (0, 0)
    if flags and kind != "other":
        error_bits = (flags[0].start, (1 << len(flags)) - 1)
    return Message(
        message.frame_id,
        stem,
        esc,
        kind,
        tuple(places),
        error_bits,
    )


def table_sent(words: Sequence[str], canopen: bool, escs: int) -> Table:
    """Return the table of the DBC that ``kontronik-can-gw dbc`` prints.

    With ``canopen`` it includes the messages of the nodes. The command runs in this process,
    because starting a process takes long in a virtual machine.
    """
    import cantools.database

    from kontronik_can_gw.cli import main

    found: Table = {}
    variants: list[list[str]] = [[]]
    if canopen:
        variants.append(["--canopen"])
    for options in variants:
        printed = io.TextIOWrapper(io.BytesIO(), encoding="cp1252", newline="")
        with contextlib.redirect_stdout(printed):
            assert main(["dbc", *words, *options]) == 0
        text = printed.buffer.getvalue().decode("cp1252")
        database: Any = cantools.database.load_string(text, "dbc", strict=True)
        found |= {message.frame_id: _message(message, escs) for message in database.messages}
    return found
