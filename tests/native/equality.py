"""The core in C beside the core in Python: the same random DBC, bytes and times; every frame, event, counter and deadline equal."""

import math
import random
from collections.abc import Sequence
from fractions import Fraction
from functools import cache
from itertools import zip_longest
from typing import Any
from zlib import crc32

from packer_oracle import (
    LayoutMaker,
    Msg,
    Sig,
    bindings,
    dbc_text,
    random_gateway,
    random_info,
    random_live,
    read,
)

from kontronik_can_gw.canopen.bound_values import bits_of, compile_pdo
from kontronik_can_gw.canopen.dictionary import Variable
from kontronik_can_gw.canopen.eds import load
from kontronik_can_gw.canopen.objects import BINDINGS
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.core.interface import Follower
from kontronik_can_gw.core.python_core import PythonCore
from kontronik_can_gw.core.slots import Slot, SlotPlan, SlotSettings
from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.kontronik.codec import Layout as WireLayout
from kontronik_can_gw.esc.kontronik.codec import encode
from kontronik_can_gw.esc.telemetry import EscSettings, Event
from kontronik_can_gw.esc.values import VALUES, Group, Kind
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.native.core import NativeCore
from kontronik_can_gw.native.rows import GATEWAY, MAX_GEAR, NotInCore
from kontronik_can_gw.native.slots import _rows
from kontronik_can_gw.signals.packer import compile_pack
from kontronik_can_gw.signals.plan import Layout, MessagePlan, Piece, Role, SendType, SignalPlan
from kontronik_can_gw.status import GatewayStatus
from kontronik_can_gw.times import MS, SECOND

START = 1_000 * SECOND
_STEPS = (0, 1_000, 100_000, MS, 2 * MS, 5 * MS, 10 * MS, 10 * MS, 10 * MS, 50 * MS, 260 * MS)


def settings(chance: random.Random, number: int) -> EscSettings:
    part = chance.choice((300, MAX_GEAR))
    return EscSettings(
        f"esc{number + 1}",
        chance.choice((1, 2, 7, 14, 255)),
        Fraction(chance.randint(1, part), chance.randint(1, part)),
        chance.choice((0, 0, 6, 14)),
        chance.choice((20, 60, 250, 1000)) * MS,
        chance.choice((1, 5, 50)),
    )


def dbc(chance: random.Random, escs: Sequence[EscSettings], most: int = 8) -> tuple[str, DbcConfig]:
    """A random DBC, and how its signals are bound; not always one that the gateway accepts. ``most`` messages."""
    maker = LayoutMaker(chance, escs)
    messages = [maker.message() for _ in range(chance.randint(1, most))]
    if chance.random() < 0.4:
        messages.append(protected(chance, escs))
    more = "\n".join(
        f'BA_ "GenMsgSendType" BO_ {m.dbc_id} {chance.randrange(5)};\n'
        f'BA_ "GenMsgCycleTime" BO_ {m.dbc_id} {chance.choice((5, 10, 12, 20, 50, 100, 1000))};\n'
        f'BA_ "GenMsgDelayTime" BO_ {m.dbc_id} {chance.choice((0, 0, 0, 5, 20, 25, 200))};'
        for m in messages
    )
    ids = {"Protected": 0x1234} if any(m.name == "Protected" for m in messages) else {}
    return dbc_text(messages, more), DbcConfig(bind=bindings(messages), e2e_data_ids=ids)


def layout(chance: random.Random, escs: Sequence[EscSettings], most: int = 8) -> Layout:
    """A random layout that the gateway accepts."""
    while True:
        try:
            text, chosen = dbc(chance, escs, most)
            return prepare(read(text), "x.dbc", escs, chosen, fd_allowed=True)
        except UserError:
            continue


def protected(chance: random.Random, escs: Sequence[EscSettings]) -> Msg:
    """A message with an alive counter and perhaps a CRC of AUTOSAR E2E profile 1."""
    prefix = f"Esc{chance.randint(1, len(escs))}" if len(escs) > 1 else ""
    voltage = Sig(f"{prefix}BatteryVoltage", 24, 16, unit="V", factor="0.01")
    signals = [Sig("Alive", 8, chance.choice((2, 4, 8, 16))), voltage]
    if chance.random() < 0.7:
        signals.append(Sig("Crc8", 0, 8))
    return Msg("Protected", 0x7F0, chance.randint(5, 8), signals)


def stream(chance: random.Random) -> bytes:
    """Some frames, in part damaged, cut, and with rubbish around them."""
    data = b""
    for _ in range(chance.choice((1, 1, 1, 1, 1, 2, 3, 12))):
        wire = WireLayout.V4 if chance.random() < 0.95 else WireLayout.LEGACY
        one = encode(random_live(chance) if chance.random() < 0.8 else random_info(chance), wire)
        if chance.random() < 0.1:
            at = chance.randrange(len(one))
            one = one[:at] + bytes((one[at] ^ 1 << chance.randrange(8),)) + one[at + 1 :]
        if chance.random() < 0.1:
            one = one[: chance.randrange(len(one))]
        if chance.random() < 0.03:  # a CRC that covers 34 bytes
            one = one[:34] + crc32(one[:34]).to_bytes(4, "little")
        if chance.random() < 0.08:
            one = bytes(chance.choices(b"KODLI\0\xff\xf0a", k=chance.randrange(60))) + one
        data += one
    return data


@cache
def _streams() -> list[bytes]:
    """Enough of them: to make one takes longer than both cores take for it."""
    chance = random.Random(0)
    return [stream(chance) for _ in range(1000)]


def _difference(*sides: Sequence[CanFrame]) -> str:
    """The first frame that is another."""
    texts = [[f"{f.can_id:X} {f.data.hex()} {f.page}" for f in frames] for frames in sides]
    place, pair = next((n, p) for n, p in enumerate(zip_longest(*texts)) if p[0] != p[1])
    return f"frame {place} of {len(texts[0])} and {len(texts[1])}: {pair[0]}, {pair[1]}"


_STATE_EACH = 10
STATE = (
    "live",
    "info",
    "last_live",
    "last_info",
    "link",
    "layout",
    "cells",
    "last_cells",
    "counters",
    "frame_rate",
    "losses",
    "late_frames",
    "suspect_frames",
    "live_ns",
    "last_info_ns",
    "info_bound_ns",
    "pole_pairs",
    "output_divisor",
    "gear_denominator",
    "energy_mw_ns",
    "run_time_ns",
)


class BothSlots:
    """A slot of both cores, given the same calls. It carries random objects of the shipped EDS, or is a transfer of random values."""

    def __init__(self, chance: random.Random, *both: Slot) -> None:
        self.chance = chance
        self.both = both
        self.is_transfer = chance.random() < 0.4
        self.settings: SlotSettings | None = self._random()
        self.started = False
        self._call("configure", self.settings, START)

    def act(self, now: int) -> None:
        """Something is done with it: as a rule it is started."""
        chance = self.chance
        what = self.chance.random()
        if what < 0.3:
            other = None if chance.random() < 0.3 else self._random()
            if self.started and self.settings is not None and other is not None:
                other = other._replace(plan=self.settings.plan)  # only a stopped one is filled anew
            self.settings = other
            self._call("configure", other, now)
        elif what < 0.6 or not self.started:
            self.started = True
            self._call("start", now)
        elif what < 0.7:
            self.started = False
            self._call("stop")
        else:
            self._call(chance.choice(("news", "send")), now)

    def _call(self, name: str, *arguments: Any) -> None:
        for slot in self.both:
            getattr(slot, name)(*arguments)

    def _random(self) -> SlotSettings:
        chance = self.chance
        mapped: list[Variable] = []
        for variable in chance.sample(_mappable(), chance.randint(1, 8)):
            if sum(map(bits_of, [*mapped, variable])) <= 64:
                mapped.append(variable)
        times = (chance.choice((0, 0, 5, 20, 25)) * MS, chance.choice((0, 0, 7, 500)) * MS)
        if self.is_transfer:
            fill = chance.getrandbits(8 * FILL)
            page = 64 + 3 * chance.randrange(40)
            of_id = chance.choice((0x18040A2A, 0x18040A2A, 0x18040A2B)), chance.random() < 0.9
            return SlotSettings(transfer_plan(chance), *of_id, *times, fill, page)
        plan = compile_pdo(mapped)
        return SlotSettings(plan, chance.randrange(1, 0x700), chance.random() < 0.8, *times)


FILL = 2
"""Bytes at the begin of a transfer that its owner fills."""


def transfer_plan(chance: random.Random) -> SlotPlan:
    """Up to seven values as integers or floats of any length; their Error code is the type's limit.

    One that the core in C can express: slots of one id are all there, and count together.
    """
    at = 8 * FILL
    signals = []
    sources = [v for v in VALUES.values() if v.supplied and v.kind is not Kind.OBJECT]
    for source in chance.sample(sources, chance.randint(1, 7)):
        is_float = chance.random() < 0.4
        signed = not is_float and chance.random() < 0.5
        length = chance.choice((16, 16, 32)) if is_float else chance.randint(2, 24)
        if at + length > 128:
            break
        high = (1 << length - signed) - 1
        cut = chance.choice((0, 0, 0, length // 3))
        pieces = [Piece(cut, length - cut, at)] + [Piece(0, cut, at + length - cut)] * (cut > 0)
        codes = (0x7E00, 0x7BFF) if is_float else (0, high)
        signal = SignalPlan(
            source.name,
            "",
            Role.SOURCE,
            length,
            signed,
            is_float,
            tuple(pieces),
            -high - 1 if signed else 0,
            high,
            *codes,
            slope=Fraction(chance.choice((1, 1, 1, 1000)), source.per_unit),
            intercept=Fraction(chance.choice(("0", "0", "273.15"))),
            source=source,
            esc=None if source.group is Group.GATEWAY else 0,
            limits=(-65504.0, 65504.0) if length == 16 else (-math.inf, math.inf),
        )
        signals.append(signal)
        at += length
    plan = MessagePlan(
        "transfer",
        0,
        True,
        False,
        (at + 7) // 8,
        SendType.EVENT,
        0,
        0,
        tuple(signals),
        frozenset({0}),
        frozenset({Group.LIVE}),
    )
    seed = chance.randrange(1 << 16)
    paced = chance.random() < 0.7
    found = SlotPlan(plan, compile_pack(plan), Event.LIVE, 0, None, False, "", seed, paced)
    try:
        _rows(found, EscSettings().protocol)
    except NotInCore:
        return transfer_plan(chance)
    return found


@cache
def _mappable() -> list[Variable]:
    eds = load(shipped("eds/kontronik_esc.eds").read_bytes(), "kontronik_esc.eds")
    found = []
    for entry in eds.entries:
        if entry.mappable and (entry.index, entry.sub) in BINDINGS:
            found.append(Variable(entry))
            found[-1].bound = BINDINGS[entry.index, entry.sub]
    return found


class Both:
    """Both cores, given the same calls."""

    def __init__(
        self,
        library: Any,
        chance: random.Random,
        escs: Sequence[EscSettings],
        layout: Layout,
    ) -> None:
        self.chance = chance
        self.escs = escs
        self.layout = layout
        self.silent = chance.random() < 0.3
        self.now = START
        self.events: tuple[list[Any], list[Any]] = ([], [])
        given = self.escs, self.layout, self.now, self.silent
        self.python = PythonCore(*given)
        slots = chance.choice((0, 1, 3))
        self.native = NativeCore(library, *given, slots)
        self.slots = [
            BothSlots(chance, self.python.slot(esc), self.native.slot(esc))
            for esc in range(len(self.escs))
            for _ in range(slots)
        ]
        self.python.followers = [Follower(Event.ALL, lambda *event: self.events[0].append(event))]
        self.native.followers = [Follower(Event.ALL, lambda *event: self.events[1].append(event))]
        self.count = self.compared = 0
        self._tell(self.python.status)

    def _tell(self, status: GatewayStatus) -> None:
        """What the owner of both knows of the gateway."""
        for name in (name.removeprefix("gateway_") for name in GATEWAY if name != "escs_ok"):
            for core in (self.python, self.native):
                setattr(core.status, name, getattr(status, name))

    def call(self, name: str, *arguments: Any) -> None:
        """One call to both."""
        getattr(self.python, name)(*arguments)
        getattr(self.native, name)(*arguments)

    def compare(self) -> None:
        """What came out, each time; the state of the ESCs, which keeps what is wrong, now and then."""
        for slot in self.slots:
            assert slot.both[0].is_pending == slot.both[1].is_pending
        frames = self.python.take(self.now)
        others = self.native.take(self.now)
        assert frames == others, _difference(frames, others)
        self.count += len(frames)
        assert self.events[0] == self.events[1], self.events
        for listed in self.events:
            listed.clear()
        assert self.python.link_changes == self.native.link_changes
        assert self.python.next_deadline() == self.native.next_deadline()
        self.compared += 1
        if self.compared % _STATE_EACH:
            return
        for slot in self.slots:
            assert slot.both[0].sent == slot.both[1].sent
            assert slot.both[0].is_news == slot.both[1].is_news
        for esc, other in zip(self.python.escs, self.native.escs, strict=True):
            for name in STATE:
                assert getattr(esc, name) == getattr(other, name), name

    def run(self, steps: int) -> int:
        """Frames compared in so many steps."""
        self.call("repeat", self.now)
        self.compare()
        for _ in range(steps):
            self.step()
            self.compare()
        self.call("stop", self.now)
        self.compared = -1
        self.compare()
        return self.count

    def step(self) -> None:
        """Something happens, and time passes."""
        chance = self.chance
        self.now += (
            chance.choice(_STEPS) if chance.random() < 0.99 else chance.randrange(30 * SECOND)
        )
        esc = chance.randrange(len(self.escs))
        what = chance.random()
        if what < 0.1:
            pass
        elif what < 0.12:
            self.call("port", esc, chance.random() < 0.5, self.now)
        elif what < 0.13:
            self.call("apply", esc, settings(chance, esc))
        elif what < 0.14:
            self.call("repeat", self.now)
        elif what < 0.16:
            self._tell(random_gateway(chance, self.now))
            self.call("gateway_changed", self.now)
        elif what < 0.24 and self.slots:
            chance.choice(self.slots).act(self.now)
        else:
            self._receive(esc)
        self.call("advance", self.now)

    def _receive(self, esc: int) -> None:
        chance = self.chance
        data = self.chance.choice(_streams())
        count = chance.randrange(6) if chance.random() < 0.2 else 0
        cuts = sorted(chance.choices(range(len(data) + 1), k=count))
        for begin, end in zip([0, *cuts], [*cuts, len(data)], strict=True):
            since = self.now - chance.choice((0, 0, 0, MS, 10 * MS, 200 * MS, 2 * SECOND))
            self.call("receive", esc, data[begin:end], self.now, since)
            if chance.random() < 0.3:
                self.now += chance.randrange(3 * MS)


def some_escs(chance: random.Random) -> list[EscSettings]:
    return [settings(chance, n) for n in range(chance.randint(1, 3))]


def run(library: Any, seed: int, steps: int = 300, most: int = 8) -> int:
    """Frames compared; 0 for a layout that the core in C does not take."""
    chance = random.Random(seed)
    escs = some_escs(chance)
    try:
        return Both(library, chance, escs, layout(chance, escs, most)).run(steps)
    except NotInCore:
        return 0
