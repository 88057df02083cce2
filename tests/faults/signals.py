"""Where the values stand in the frames of a DBC: tables made from it by cantools once, for whoever decodes many frames in slow Python."""

import contextlib
import io
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

from feeder import Identity, info_values, live_values

LIVE_NAMES = frozenset(live_values(Identity(), 0))
INFO_NAMES = frozenset(info_values(Identity(), 0))
NOT_FOLLOWED = frozenset({"losses", "layout", "energy_used"})
"""Amid an ESC's values: what is the gateway's own."""
STATE_STEMS = frozenset({"Link", "Heartbeat", "Emergency"})


class Place(NamedTuple):
    """A signal: its bits, its scaling, and the raw value that means not available (None: it has none)."""

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
    """A message: whose it is (None: the gateway's), what its values follow from, and its signals."""

    can_id: int
    stem: str
    esc: int | None
    kind: str
    """``live``, ``info`` or ``other``."""
    places: tuple[Place, ...]
    """All signals; of a live or info message only those that are an ESC's values."""
    flags: tuple[int, int]
    """Start and mask of the error bits; a mask of 0: none."""

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
        assert (
            signal.byte_order == "little_endian" and not signal.offset and not signal.is_multiplexer
        )
        choices = {str(text): raw for raw, text in (signal.choices or {}).items()}
        place = Place(
            _snake(signal.name.removeprefix(prefix)),
            signal.start,
            (1 << signal.length) - 1,
            1 << signal.length - 1 if signal.is_signed else 0,
            float(signal.scale),
            choices.get("NotAvailable"),
        )
        (flags if signal.length == 1 and not choices else places).append(place)
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
    return Message(
        message.frame_id,
        stem,
        esc,
        kind,
        tuple(places),
        (flags[0].start, (1 << len(flags)) - 1) if flags and kind != "other" else (0, 0),
    )


def table_sent(words: Sequence[str], canopen: bool, escs: int) -> Table:
    """Of what ``kontronik-can-gw dbc`` prints, of the nodes too if there are any; in this process, as a start takes long in a VM."""
    import cantools.database

    from kontronik_can_gw.cli import main

    found: Table = {}
    for options in ([], ["--canopen"]) if canopen else ([],):
        printed = io.TextIOWrapper(io.BytesIO(), encoding="cp1252", newline="")
        with contextlib.redirect_stdout(printed):
            assert main(["dbc", *words, *options]) == 0
        text = printed.buffer.getvalue().decode("cp1252")
        database: Any = cantools.database.load_string(text, "dbc", strict=True)
        found |= {message.frame_id: _message(message, escs) for message in database.messages}
    return found
