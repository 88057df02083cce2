"""Compares the C core with the Python core.

Both get the same random DBC, bytes and times. Every frame, event, counter and deadline must be
equal.
"""

import math
import random
from collections.abc import Sequence
from dataclasses import replace
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
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.core.slots import Slot, SlotPlan, SlotSettings
from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.telemetry import EscSettings, Event
from kontronik_can_gw.esc.values import VALUES, Group, Kind
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.native.core import NativeCore
from kontronik_can_gw.native.rows import GATEWAY, MAX_GEAR, NotInCore
from kontronik_can_gw.native.slots import slot_rows
from kontronik_can_gw.signals.e2e import PROFILES, DataIdMode, Profile
from kontronik_can_gw.signals.packer import compile_pack
from kontronik_can_gw.signals.plan import (
    MessageLayout,
    MessagePlan,
    Piece,
    SignalPlan,
)
from kontronik_can_gw.status import GatewayStatus
from kontronik_can_gw.times import MS, SECOND

START = 1_000 * SECOND
_STEPS = (0, 1_000, 100_000, MS, 2 * MS, 5 * MS, 10 * MS, 10 * MS, 10 * MS, 50 * MS, 260 * MS)


def settings(chance: random.Random, number: int) -> EscSettings:
    part = chance.choice((300, MAX_GEAR))
    pole_pairs = chance.choice((1, 2, 7, 14, 255))
    numerator = chance.randint(1, part)
    denominator = chance.randint(1, part)
    return EscSettings(
        f"esc{number + 1}",
        pole_pairs,
        Fraction(numerator, denominator),
        chance.choice((0, 0, 6, 14)),
        chance.choice((20, 60, 250, 1000)) * MS,
        chance.choice((1, 5, 50)),
    )


def dbc(
    chance: random.Random,
    escs: Sequence[EscSettings],
    most: int = 8,
) -> tuple[str, DbcConfig]:
    """Return a random DBC with up to ``most`` messages, and its bindings.

    The gateway does not accept all of them.
    """
    maker = LayoutMaker(chance, escs)
    messages = [maker.message() for _ in range(chance.randint(1, most))]
    if chance.random() < 0.4:
        profile = chance.choice(list(PROFILES))
        messages.append(protected(chance, escs, PROFILES[profile]))
    attributes = []
    for message in messages:
        place = f"BO_ {message.dbc_id}"
        send_type = chance.randrange(5)
        cycle = chance.choice((5, 10, 12, 20, 50, 100, 1000))
        delay = chance.choice((0, 0, 0, 5, 20, 25, 200))
        attributes.append(f'BA_ "GenMsgSendType" {place} {send_type};')
        attributes.append(f'BA_ "GenMsgCycleTime" {place} {cycle};')
        attributes.append(f'BA_ "GenMsgDelayTime" {place} {delay};')
    e2e: dict[str, str] = {}
    ids: dict[str, int | tuple[int, ...]] = {}
    if any(signal.name == "Crc8" for message in messages for signal in message.signals):
        e2e["Protected"] = profile
        largest = PROFILES[profile].largest_id
        ids["Protected"] = chance.randint(0, largest)
        if PROFILES[profile].ids > 1:
            ids["Protected"] = tuple(chance.randint(0, largest) for _ in range(16))
    config = DbcConfig(bind=bindings(messages), e2e=e2e, e2e_data_ids=ids)
    return dbc_text(messages, "\n".join(attributes)), config


def layout(
    chance: random.Random,
    escs: Sequence[EscSettings],
    most: int = 8,
) -> MessageLayout:
    """Return a random layout that the gateway accepts."""
    while True:
        try:
            text, chosen = dbc(chance, escs, most)
            return prepare(read(text), "x.dbc", escs, chosen, is_fd_allowed=True)
        except UserError:
            continue


def protected(chance: random.Random, escs: Sequence[EscSettings], profile: Profile) -> Msg:
    """Return a message with an alive counter, and perhaps with the CRC of a profile."""
    prefix = f"Esc{chance.randint(1, len(escs))}" if len(escs) > 1 else ""
    at = 0 if profile.crc_byte == 0 else chance.choice((0, 4))
    value_at = 0 if at else 5
    counter_at = 8 * at + profile.crc_bits
    counter_bits = profile.counter_bits or chance.choice((2, 4, 8, 16))
    signals = [
        Sig(f"{prefix}BatteryVoltage", 8 * value_at, 16, unit="V", factor="0.01"),
        Sig("Alive", counter_at, counter_bits),
    ]
    if chance.random() < 0.9:
        signals.append(Sig("Crc8", 8 * at, profile.crc_bits))
        if profile.mode is DataIdMode.NIBBLE:
            signals.append(Sig("DataIdNibble", 16 if at else 32, 4))
    return Msg("Protected", 0x7F0, chance.choice((7, 8, 8, 12, 64)), signals)


def stream(chance: random.Random) -> bytes:
    """Return some frames. A few are damaged or cut, and some have garbage around them."""
    data = b""
    for _ in range(chance.choice((1, 1, 1, 1, 1, 2, 3, 12))):
        wire = WireLayout.V4 if chance.random() < 0.95 else WireLayout.LEGACY
        is_live = chance.random() < 0.8
        one = encode(random_live(chance) if is_live else random_info(chance), wire)
        if chance.random() < 0.1:
            at = chance.randrange(len(one))
            flipped = one[at] ^ 1 << chance.randrange(8)
            one = one[:at] + bytes((flipped,)) + one[at + 1 :]
        if chance.random() < 0.1:
            one = one[: chance.randrange(len(one))]
        if chance.random() < 0.03:  # a CRC that covers 34 bytes
            one = one[:34] + crc32(one[:34]).to_bytes(4, "little")
        if chance.random() < 0.08:
            garbage = chance.choices(b"KODLI\0\xff\xf0a", k=chance.randrange(60))
            one = bytes(garbage) + one
        data += one
    return data


@cache
def _streams() -> list[bytes]:
    """Return many streams. Creating one takes longer than both cores need to read it."""
    chance = random.Random(0)
    return [stream(chance) for _ in range(1000)]


def _difference(*sides: Sequence[CanFrame]) -> str:
    """Describe the first frame that differs."""
    texts = []
    for frames in sides:
        texts.append([f"{frame.can_id:X} {frame.data.hex()} {frame.page}" for frame in frames])
    lengths = f"{len(texts[0])} and {len(texts[1])}"
    for place, (one, other) in enumerate(zip_longest(*texts)):
        if one != other:
            return f"frame {place} of {lengths}: {one}, {other}"
    raise AssertionError("no frame differs")


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
    "shaft_divisor",
    "gear_denominator",
    "energy_mw_ns",
    "run_time_ns",
)


class BothSlots:
    """A slot of both cores that gets the same calls.

    It has random objects of the shipped EDS, or is a transfer of random values.
    """

    def __init__(self, chance: random.Random, *both: Slot) -> None:
        self.chance = chance
        self.both = both
        self.is_transfer = chance.random() < 0.4
        self.settings: SlotSettings | None = self._random()
        self.started = False
        self._call("configure", self.settings, START)

    def act(self, now: int) -> None:
        """Do something with the slot. Most often it is started."""
        chance = self.chance
        action = chance.random()
        if action < 0.3:
            other = None if chance.random() < 0.3 else self._random()
            if self.started and self.settings is not None and other is not None:
                # Only a stopped slot gets another plan.
                other = other._replace(plan=self.settings.plan)
            self.settings = other
            self._call("configure", other, now)
        elif action < 0.6 or not self.started:
            self.started = True
            self._call("start", now)
        elif action < 0.7:
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
        inhibit_ns = chance.choice((0, 0, 5, 20, 25)) * MS
        timer_ns = chance.choice((0, 0, 7, 500)) * MS
        if self.is_transfer:
            fill = chance.getrandbits(8 * FILL)
            page = 64 + 3 * chance.randrange(40)
            can_id = chance.choice((0x18040A2A, 0x18040A2A, 0x18040A2B))
            by_event = chance.random() < 0.9
            plan = transfer_plan(chance)
            return SlotSettings(plan, can_id, by_event, inhibit_ns, timer_ns, fill, page)
        plan = compile_pdo(mapped)
        can_id = chance.randrange(1, 0x700)
        return SlotSettings(plan, can_id, chance.random() < 0.8, inhibit_ns, timer_ns)


FILL = 2
"""Bytes at the beginning of a transfer that its owner fills."""


def transfer_plan(chance: random.Random) -> SlotPlan:
    """Return a transfer of up to seven values as integers or floats of any length.

    The code for an error is the limit of the type. The C core can express the transfer: slots of
    one id must all be in the same core, and they count together.
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
        pieces = [Piece(cut, length - cut, at)]
        if cut > 0:
            pieces.append(Piece(0, cut, at + length - cut))
        codes = (0x7E00, 0x7BFF) if is_float else (0, high)
        signal = SignalPlan(
            source.name,
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
        (at + 7) // 8,
        tuple(signals),
        frozenset({0}),
        frozenset({Group.LIVE}),
        extended=True,
    )
    seed = chance.randrange(1 << 16)
    paced = chance.random() < 0.7
    found = SlotPlan(
        plan,
        compile_pack(plan),
        Event.LIVE,
        seed=seed,
        is_paced=paced,
    )
    try:
        slot_rows(found, EscSettings().protocol)
    except NotInCore:
        return transfer_plan(chance)
    return found


@cache
def _mappable() -> list[Variable]:
    eds = load(shipped("eds/kontronik_esc.eds").read_bytes(), "kontronik_esc.eds")
    found = []
    for entry in eds.entries:
        if entry.is_mappable and (entry.index, entry.sub) in BINDINGS:
            found.append(Variable(entry))
            found[-1].bound = BINDINGS[entry.index, entry.sub]
    return found


OF_THE_CORE = ("escs_ok", "heard_ns", "is_quiet")
"""Values of the gateway's status that the core writes."""


class Both:
    """Both cores, which get the same calls."""

    def __init__(
        self,
        library: Any,
        chance: random.Random,
        escs: Sequence[EscSettings],
        layout: MessageLayout,
    ) -> None:
        self.chance = chance
        self.escs = escs
        self.layout = layout
        self.silent_on_loss = chance.random() < 0.3
        self.now = START
        self.quiet_after_ns = chance.choice((0, 30 * MS, SECOND, 10 * SECOND))
        self.quiet_begins = 0
        self.silent_steps = 0
        """Number of further steps without bytes of an ESC."""
        self.events: tuple[list[Any], list[Any]] = ([], [])
        settings = CoreSettings(escs, layout, self.silent_on_loss, self.quiet_after_ns)
        self.python = PythonCore(settings, self.now)
        slots = chance.choice((0, 1, 3))
        self.native = NativeCore(library, replace(settings, slots=slots), self.now)
        self.slots = []
        for esc in range(len(self.escs)):
            for _ in range(slots):
                both = BothSlots(chance, self.python.slot(esc), self.native.slot(esc))
                self.slots.append(both)
        events = Event.ALL | Event.QUIET
        self.python.followers = [Follower(events, lambda *event: self.events[0].append(event))]
        self.native.followers = [Follower(events, lambda *event: self.events[1].append(event))]
        self.count = self.compared = 0
        self._tell(self.python.status)

    def _tell(self, status: GatewayStatus) -> None:
        """Give both cores the state of the gateway."""
        for row in GATEWAY:
            if row in OF_THE_CORE:
                continue
            name = row.removeprefix("gateway_")
            for core in (self.python, self.native):
                setattr(core.status, name, getattr(status, name))

    def call(self, name: str, *arguments: Any) -> None:
        """Call the same method of both cores."""
        getattr(self.python, name)(*arguments)
        getattr(self.native, name)(*arguments)

    def compare(self) -> None:
        """Compare the output each time, and the state of the ESCs every tenth time.

        A wrong state remains, so it is found later.
        """
        for slot in self.slots:
            assert slot.both[0].is_pending == slot.both[1].is_pending
        frames = self.python.take(self.now)
        others = self.native.take(self.now)
        assert frames == others, _difference(frames, others)
        self.count += len(frames)
        assert self.events[0] == self.events[1], self.events
        self.quiet_begins += self._compare_quiet()
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

    def _compare_quiet(self) -> bool:
        """Compare the states of quiet mode. Return True if it has just begun."""
        for name in ("is_quiet", "heard_ns", "state"):
            assert getattr(self.python.status, name) == getattr(self.native.status, name), name
        has_changed = any(events & Event.QUIET for _, events, _ in self.events[0])
        return has_changed and self.python.status.is_quiet

    def run(self, steps: int) -> int:
        """Run this number of steps. Return the number of compared frames."""
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
        """Let time pass and a random event happen."""
        chance = self.chance
        if chance.random() < 0.99:
            self.now += chance.choice(_STEPS)
        else:
            self.now += chance.randrange(30 * SECOND)
        if chance.random() < 0.01:
            self.silent_steps = chance.randrange(60)
        self.silent_steps = max(0, self.silent_steps - 1)
        esc = chance.randrange(len(self.escs))
        event = chance.random()
        if event < 0.1:
            pass
        elif event < 0.12:
            self.call("port", esc, chance.random() < 0.5, self.now)
        elif event < 0.13:
            self.call("apply", esc, settings(chance, esc))
        elif event < 0.14:
            self.call("repeat", self.now)
        elif event < 0.16:
            self._tell(random_gateway(chance, self.now))
            self.call("gateway_changed", self.now)
        elif event < 0.24 and self.slots:
            chance.choice(self.slots).act(self.now)
        elif not self.silent_steps:
            self._receive(esc)
        self.call("advance", self.now)

    def _receive(self, esc: int) -> None:
        chance = self.chance
        data = self.chance.choice(_streams())
        count = chance.randrange(6) if chance.random() < 0.2 else 0
        cuts = sorted(chance.choices(range(len(data) + 1), k=count))
        for begin, end in zip([0, *cuts], [*cuts, len(data)], strict=True):
            since = self.now - chance.choice((0, 0, 0, MS, 10 * MS, 200 * MS, 2 * SECOND))
            self.call(
                "receive",
                esc,
                data[begin:end],
                self.now,
                since,
            )
            if chance.random() < 0.3:
                self.now += chance.randrange(3 * MS)


def some_escs(chance: random.Random) -> list[EscSettings]:
    return [settings(chance, n) for n in range(chance.randint(1, 3))]


def made(library: Any, seed: int, most: int = 8) -> Both:
    """Return both cores with a random layout. NotInCore if the C core cannot express it."""
    chance = random.Random(seed)
    escs = some_escs(chance)
    return Both(library, chance, escs, layout(chance, escs, most))


def run(
    library: Any,
    seed: int,
    steps: int = 300,
    most: int = 8,
) -> int:
    """Return the number of compared frames, or 0 for a layout that the C core cannot express."""
    try:
        return made(library, seed, most).run(steps)
    except NotInCore:
        return 0
