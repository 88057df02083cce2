"""What a gateway of one ESC knows after each of many frames, in columns, while nothing but frames happens.

A gateway is steady while its ESC sends intact frames of one layout, live data stays fresh, information is fresh or never comes, and no link
state changes. ``Steady`` follows it over frames of a stretch as far as that holds, and leaves the gateway's objects as if they
had been given each frame in turn, so that the streaming way can go on at any place. Only what is sent is not followed here.

Steps. A state number is how many frames of the block have come: 0 is before the first. With a frame come two steps of one instant, its
bytes and then the turn of the clock; between frames the clock turns alone, where something is due.
"""

from bisect import bisect_left
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.offline.bulk.scan import Stretch, form_of
from kontronik_can_gw.protocol.codec import Kind, Layout
from kontronik_can_gw.protocol.deframer import Counters
from kontronik_can_gw.protocol.fields import InfoData, LiveData
from kontronik_can_gw.protocol.states import LARGEST_STATE, Device
from kontronik_can_gw.telemetry import _DEGRADED_DROPPED_SHARE, INFO_TIMEOUT_NS, MS, SECOND, Event, LinkState

Numbers = NDArray[np.int64]
_ROOM = 1 << 62


class Rare(NamedTuple):
    """What happens besides frames. ``turn``: number of frames that have come, the one of this instant included."""

    turn: int
    since_ns: int
    """After the last frame; 0 in its own instant."""
    with_bytes: bool
    """In the step of the frame's bytes, in front of what they bring."""
    state: int
    time_ns: int
    events: int
    """Of the ESC."""
    is_told: bool
    """The messages with values of the gateway are told that a second is over."""


class Stretched:
    """A stretch with the assumed time of each frame: a live frame each period, an info frame half a period behind it.

    ``lives``: live frames of the recording before it.
    """

    def __init__(self, stretch: Stretch, lives: int, period_ns: int) -> None:
        self.stretch = stretch
        self.period_ns = period_ns
        self.layout = 1 if stretch.layout is Layout.V4 else 2
        count = stretch.live_count + len(stretch.infos)
        self.is_live = np.ones(count, bool)
        self.is_live[stretch.live_before + np.arange(len(stretch.infos))] = False
        self.live_rows = np.concatenate(([0], self.is_live.cumsum()))
        """How many live frames have come, by the number of frames."""
        ahead = self.live_rows[:-1] + lives
        self.times = np.where(self.is_live, ahead * period_ns, ahead * period_ns - period_ns // 2)

    def __len__(self) -> int:
        return len(self.is_live)

    def offset(self, frame: int) -> int:
        """Where in the stretch's bytes a frame begins."""
        live, layout = int(self.live_rows[frame]), self.stretch.layout
        return live * form_of(Kind.LIVE, layout).length + (frame - live) * form_of(Kind.INFO, layout).length


def is_steady(gateway: Gateway, layout: int) -> bool:
    """True where a block of frames of this layout may begin."""
    esc = gateway.escs[0]
    return (
        len(gateway.escs) == 1
        and gateway.nodes is None
        and esc.layout == layout
        and esc.live is not None
        and esc.link in (LinkState.OK, LinkState.DEGRADED)
        and esc.frame_rate is not None
        and not esc._deframer.pending
        and not esc._arrivals
        and gateway._next_expiry > 0
        and not gateway._conflicts
        and not gateway.frames_wait
    )


class Steady:
    """A block of frames: from ``first`` of a stretch up to ``count`` of them, fewer where the gateway does not stay steady.

    ``since_ns``: the instant of the frame before. The gateway is steady and is not changed before ``leave``.
    """

    def __init__(self, gateway: Gateway, stretched: Stretched, first: int, count: int, since_ns: int) -> None:
        self.gateway = gateway
        self.esc = gateway.escs[0]
        stretch = stretched.stretch
        self._first_live = int(stretched.live_rows[first])
        self._first_info = first - self._first_live
        lives = int(stretched.live_rows[first + count])
        self._live = stretch.live[self._first_live : lives]
        self._info = stretch.info[self._first_info : first + count - lives]
        self.layout = stretch.layout
        self.lengths = {kind: form_of(kind, stretch.layout).length for kind in Kind}
        self._live_length = self.lengths[Kind.LIVE]
        self._info_length = self.lengths[Kind.INFO]
        self._is_legacy = stretch.layout is Layout.LEGACY
        self.is_live = stretched.is_live[first : first + count]
        self.times = np.concatenate(([since_ns], stretched.times[first : first + count]))
        """By state number; the first is the instant of the frame before."""
        self.live_rows = stretched.live_rows[first : first + count + 1] - self._first_live
        self.rare: list[Rare] = []
        self._closes: list[tuple[int, int, int]] = []  # (turn, time, frame rate)
        count = self._follow(self._same_device(count))
        self.count = count
        self.is_live, self.times, self.live_rows = (
            self.is_live[:count],
            self.times[: count + 1],
            self.live_rows[: count + 1],
        )
        self._live, self._info = self._live[: self.live_rows[-1]], self._info[: count - self.live_rows[-1]]
        self._columns: dict[tuple[bool, int], Numbers] = {}

    @cached_property
    def time_list(self) -> list[int]:
        """``times`` as Python's numbers."""
        found: list[int] = self.times.tolist()
        return found

    @cached_property
    def info_rows(self) -> Numbers:
        """How many info frames have come, by state number."""
        found: Numbers = np.arange(self.count + 1) - self.live_rows
        return found

    @cached_property
    def _turns(self) -> dict[tuple[bool, bool], Numbers]:
        return {}

    def turns_of(self, live: bool, info: bool) -> Numbers:
        """The turns with live frames, information frames, or both; the same object each time."""
        found = self._turns.get((live, info))
        if found is None:
            if live and info:
                found = np.arange(1, self.count + 1)
            elif live or info:
                found = np.flatnonzero(self.is_live if live else ~self.is_live) + 1
            else:
                found = np.empty(0, np.int64)
            self._turns[live, info] = found
        return found

    @cached_property
    def _times_at(self) -> dict[int, tuple[Numbers, int]]:
        return {}

    def times_at(self, turns: Numbers) -> tuple[Numbers, int]:
        """The times of what ``turns_of`` gives, and the least distance between two; the same object each time."""
        found = self._times_at.get(id(turns))
        if found is None:
            times = self.times[turns]
            least = int(np.diff(times).min()) if len(times) > 1 else _ROOM
            found = self._times_at[id(turns)] = times, least
        return found

    @cached_property
    def _shared(self) -> "dict[int, Moments]":
        return {}

    def moments_with_bytes(self, turns: Numbers) -> "Moments":
        """What is known with the frames of what ``turns_of`` gives; the same object each time."""
        found = self._shared.get(id(turns))
        if found is None:
            found = self._shared[id(turns)] = self.moments(turns, turns, self.times_at(turns)[0], True)
        return found

    def moments(
        self, turns: Numbers, states: Numbers, now: Numbers, with_bytes: "NDArray[np.bool_] | bool"
    ) -> "Moments":
        """What is known at steps. ``with_bytes``: those of frames' bytes; the state then is 0 or 1 behind the turn."""
        return Moments(self, turns, states, now, with_bytes)

    def live_column(self, field: int) -> Numbers:
        """A field of each live frame, behind what it was before."""
        return self._column(True, field)

    def info_column(self, field: int) -> Numbers:
        return self._column(False, field)

    def _column(self, is_live: bool, field: int) -> Numbers:
        found = self._columns.get((is_live, field))
        if found is None:
            records, data = (self._live, LiveData) if is_live else (self._info, InfoData)
            before: Any = self.esc.live if is_live else self.esc.info
            found = np.empty(len(records) + 1, np.int64)
            found[0] = before[field]
            found[1:] = records[data._fields[field]]
            self._columns[is_live, field] = found
        return found

    @cached_property
    def live_ns(self) -> Numbers:
        """The time of each live frame, behind the one before."""
        return np.concatenate(([self.esc.live_ns or 0], self.times[1:][self.is_live]))

    @cached_property
    def energy(self) -> NDArray[Any]:
        """Drawn so far with each live frame, behind what it was before; of Python's numbers where int64 has no room."""
        power = self._power.copy()
        power[0] = self.esc._last_power
        power = np.maximum(power[:-1], 0)
        elapsed = np.diff(self.live_ns)
        longest = int(elapsed.max(initial=0))
        if int(power.sum()) * longest + self.esc.energy >= _ROOM:
            power = power.astype(object)
        drawn = (power * elapsed).cumsum()
        if not len(drawn):
            return np.array([self.esc.energy], object)
        return np.concatenate(([self.esc.energy], drawn + self.esc.energy))

    @property
    def drawn(self) -> int:
        """Drawn in all, with the last live frame."""
        power = np.maximum(np.concatenate(([self.esc._last_power], self._power[1:]))[:-1], 0)
        elapsed = np.diff(self.live_ns)
        if int(power.sum()) * int(elapsed.max(initial=0)) >= _ROOM:
            power = power.astype(object)
        return self.esc.energy + int((power * elapsed).sum())

    @cached_property
    def _power(self) -> Numbers:
        return self.live_column(_VOLTAGE) * self.live_column(_CURRENT)

    @cached_property
    def run_time(self) -> Numbers:
        turning = self.live_column(_SPEED)[:-1] != 0
        return np.concatenate(([0], (np.diff(self.live_ns) * turning).cumsum())) + self.esc.run_time

    @cached_property
    def suspects(self) -> Numbers:
        """Suspect frames so far, with each live frame, behind what it was before."""
        suspect = (self.live_column(_STATE)[1:] > LARGEST_STATE) & self._is_legacy
        return np.concatenate(([0], suspect.cumsum())) + self.esc.suspect_frames

    @cached_property
    def rates(self) -> Numbers:
        """The frame rate by how many windows were closed."""
        return np.array([self.esc.frame_rate, *(rate for _, _, rate in self._closes)], np.int64)

    def rate_at(self, turns: Numbers, now: Numbers, with_bytes: "NDArray[np.bool_] | bool") -> Numbers:
        """The frame rate at steps: with a frame's bytes it is that before the clock turns."""
        closes = np.array([(turn, time) for turn, time, _ in self._closes], np.int64).reshape(-1, 2)
        before = np.searchsorted(closes[:, 0], turns, "left")
        return self.rates[np.where(with_bytes, before, np.searchsorted(closes[:, 1], now, "right"))]

    def counters(self, state: int) -> Counters:
        """The stream's counters at a state number."""
        found = self.esc.counters.copy()
        live = int(self.live_rows[state])
        info = state - live
        found.bytes += live * self._live_length + info * self._info_length
        found.headers += live + info
        if self._is_legacy:
            found.live_legacy += live
            found.info_legacy += info
        else:
            found.live_v4 += live
            found.info_v4 += info
        return found

    def bytes_at(self, states: Numbers) -> Numbers:
        """How many bytes of the block have come."""
        return self.live_rows[states] * self._live_length + self.info_rows[states] * self._info_length

    def _same_device(self, count: int) -> int:
        """How many frames come until information tells of a device for the first time, or of another one."""
        if not len(self._info):
            return count
        if self.esc.info is None:
            other = 0
        else:
            words = self._info["device_and_variant"]
            others = np.flatnonzero(words != self.esc.info.device_and_variant)
            if not len(others):
                return count
            other = int(others[0])
        return int(np.flatnonzero(~self.is_live)[other])

    def _follow(self, count: int) -> int:
        """Go through the instants at which more than a frame happens; how many frames come until the gateway is not steady any more."""
        gateway, esc = self.gateway, self.esc
        times = self.times[: count + 1].tolist()
        lives, timeout = self.live_rows, esc.settings.timeout_ns
        live_times = np.concatenate(([esc.live_ns or 0], self.times[1:][self.is_live]))
        info_at = np.flatnonzero(~self.is_live)
        window, told, due = esc._window_ns, gateway._told_ns, gateway._next_expiry
        old = esc._window_counters
        older = esc._diagnosis_counters
        rate = esc.frame_rate

        def fresh_until(state: int) -> tuple[int, int]:
            """Up to when live data and information are fresh."""
            live_until = int(live_times[lives[state]]) + timeout
            if esc.info_bound_ns is None:
                return live_until, _ROOM
            infos = state - int(lives[state])
            info_ns = times[int(info_at[infos - 1]) + 1] if infos else esc.info_bound_ns
            return live_until, info_ns + INFO_TIMEOUT_NS

        def deadline(state: int) -> int:
            return min(window + SECOND, *(until + 1 for until in fresh_until(state)))

        last_turn = 0
        while (turn := bisect_left(times, due, 1)) <= count:
            with_frame = times[turn] == due
            before = turn - 1
            if turn != last_turn:  # what happens between two frames belongs to the second one
                last_turn = turn
                back = (window, told, due, old, older, rate), len(self.rare), len(self._closes)
            if due > min(fresh_until(before)):
                count = before
                break
            was_due = due
            tells = due - told >= SECOND
            if with_frame:  # its bytes come before the clock turns
                due = deadline(before)
                if tells:
                    told = was_due
                    self.rare.append(Rare(turn, 0, True, before, was_due, Event.NONE, True))
                if due > was_due:
                    continue
                tells = False
            state = turn if with_frame else before
            events = Event.NONE
            if was_due >= deadline(state) and was_due - window >= SECOND:
                new = self.counters(state)
                dropped, received = new.dropped_bytes - old.dropped_bytes, new.bytes - old.bytes
                bad = (
                    new.crc_errors - old.crc_errors >= esc.settings.crc_error_threshold
                    or dropped * _DEGRADED_DROPPED_SHARE > received
                )
                if (LinkState.DEGRADED if bad else LinkState.OK) is not esc.link:
                    count = before
                    break
                rate = round((new.live - old.live) * 10 * SECOND / (was_due - window))
                self._closes.append((state, was_due, rate))
                older, old, window = old, new, was_due
                events = Event.SECOND
            due = deadline(state)
            if tells:
                told = was_due
            if events or tells:
                since = was_due - times[state]
                self.rare.append(Rare(state, since, False, state, was_due, events, tells))
        else:
            self._left = (window, told, due, old, older, rate)
            return count
        self._left, rare, closes = back
        del self.rare[rare:], self._closes[closes:]
        return count

    def leave(self) -> None:
        """Let ESC and gateway be as after the last frame of the block. What was made of the block is not to be used any more."""
        self._shared.clear()  # they know the block: it would wait for the garbage collection, with all its columns
        gateway, esc = self.gateway, self.esc
        after = self.counters(self.count)
        energy, run_time, suspects = self.drawn, self.run_time[-1], self.suspects[-1]
        live_ns = self.live_ns[-1]
        if len(self._live):
            esc.live = esc.last_live = LiveData._make(self._live[-1].item())
            esc.energy, esc.run_time, esc.suspect_frames = int(energy), int(run_time), int(suspects)
            esc.live_ns = esc.live_bound_ns = int(live_ns)
            esc._last_power = esc.live.battery_voltage * esc.live.battery_current
        if len(self._info):
            esc.info = esc.last_info = InfoData._make(self._info[-1].item())
            at = int(np.flatnonzero(~self.is_live)[-1]) + 1
            esc.info_bound_ns = esc.last_info_ns = int(self.times[at])
            esc.cells = esc.settings.cell_count or esc.info.cell_count
        deframer = esc._deframer
        for name in Counters.__dataclass_fields__:
            setattr(deframer.counters, name, getattr(after, name))
        deframer._base = after.bytes
        deframer._blame_until = 0
        window, told, due, old, older, rate = self._left
        esc._window_ns, esc._window_counters, esc._diagnosis_counters, esc.frame_rate = window, old, older, rate
        gateway._told_ns, gateway._next_expiry = told, due


class Quiet(Steady):
    """A block for which it makes no difference when a gateway is told that a second is over: nobody asks.

    Of the instants between frames only the ends of the one-second windows count then; the ESC is never late for them.
    """

    def _follow(self, count: int) -> int:
        esc = self.esc
        count = self._informed(count)
        window, old, older, rate = esc._window_ns, esc._window_counters, esc._diagnosis_counters, esc.frame_rate
        ends = np.arange(window + SECOND, int(self.times[count]) + 1, SECOND)
        if len(ends):
            before = np.searchsorted(self.times[1 : count + 1], ends)
            states = before + (self.times[before + 1] == ends)  # a frame of the same instant comes first
            first = self.counters(int(states[0]))
            dropped, errors = first.dropped_bytes - old.dropped_bytes, first.crc_errors - old.crc_errors
            bad = dropped * _DEGRADED_DROPPED_SHARE > first.bytes - old.bytes
            kept = len(ends)
            if self._link(bad, errors) is not esc.link:
                kept = 0
            elif self._link(False, 0) is not esc.link:  # nothing more is dropped in the further ones
                kept = 1
            if kept < len(ends):
                count = int(before[kept])
                ends, states = ends[:kept], states[:kept]
        if len(ends):
            lives = np.concatenate(([old.live], self.live_rows[states] + esc.counters.live))
            self._closes = list(zip(states.tolist(), ends.tolist(), (np.diff(lives) * 10).tolist(), strict=True))
            times = self.times
            self.rare = [
                Rare(state, end - int(times[state]), False, state, end, Event.SECOND, False)
                for state, end, _ in self._closes
            ]
            older = old if len(ends) == 1 else self.counters(int(states[-2]))
            window, old, rate = int(ends[-1]), self.counters(int(states[-1])), self._closes[-1][2]
        self._left = (window, self.gateway._told_ns, 0, old, older, rate)
        return count

    def _link(self, bad: bool, errors: int) -> LinkState:
        """What the link is behind a window."""
        return LinkState.DEGRADED if bad or errors >= self.esc.settings.crc_error_threshold else LinkState.OK

    def _informed(self, count: int) -> int:
        """How many frames come while information is fresh."""
        if self.esc.info_bound_ns is None:
            return count
        known = np.concatenate(([self.esc.info_bound_ns], self.times[1 : count + 1][~self.is_live[:count]]))
        if np.diff(known, append=self.times[count]).max() <= INFO_TIMEOUT_NS:
            return count
        seen = np.arange(count) - self.live_rows[:count]
        late = np.flatnonzero(self.times[1 : count + 1] > known[seen] + INFO_TIMEOUT_NS)
        return int(late[0]) if len(late) else count

    def leave(self) -> None:
        super().leave()
        self.gateway._next_expiry = self.esc.next_deadline()


_VOLTAGE, _CURRENT, _SPEED, _STATE = (
    LiveData._fields.index(name)
    for name in ("battery_voltage", "battery_current", "electrical_speed", "operating_state")
)


class Moments:
    """What the sources' expressions read, at many steps of a block."""

    def __init__(
        self, block: Steady, turns: Numbers, states: Numbers, now: Numbers, with_bytes: NDArray[np.bool_] | bool
    ) -> None:
        self.count = len(states)
        self.turns = turns
        self.states = states
        self.now = now
        self.gateway = block.gateway.status
        self.live = _Fields(block.live_column, _rows(block.live_rows[states]))
        self.info = None if block.esc.info is None else _InfoFields(block.info_column, block.info_rows[states])
        self.esc = _Esc(block, turns, states, with_bytes, self.live, self.info, now)


def _rows(rows: Numbers) -> "Numbers | slice":
    """As a slice, where they follow each other: that costs no copy."""
    if len(rows) and rows[-1] - rows[0] == len(rows) - 1 and (len(rows) < 2 or (np.diff(rows) == 1).all()):
        return slice(int(rows[0]), int(rows[-1]) + 1)
    return rows


class _Fields:
    def __init__(self, column: Any, rows: "Numbers | slice") -> None:
        self._column = column
        self.rows = rows

    def __getitem__(self, field: int) -> Numbers:
        found: Numbers = self._column(field)[self.rows]
        return found


class _InfoFields(_Fields):
    @property
    def device(self) -> Numbers:
        return self[0] >> 10

    @property
    def variant(self) -> Numbers:
        return self[0] & 0x3FF


class _Esc:
    """As an EscTelemetry."""

    def __init__(
        self,
        block: Steady,
        turns: Numbers,
        states: Numbers,
        with_bytes: NDArray[np.bool_] | bool,
        live: _Fields,
        info: _InfoFields | None,
        now: Numbers,
    ) -> None:
        self._block = block
        self._turns = turns
        self._states = states
        self._with_bytes = with_bytes
        self._live = live
        self._info = info
        self._now = now
        self.link = block.esc.link
        self.layout = block.esc.layout
        self.losses = block.esc.losses

    @property
    def counters(self) -> "_Counters":
        return _Counters(self._block, self._states)

    @property
    def cells(self) -> Any:
        if self._block.esc.settings.cell_count or self._info is None:
            return self._block.esc.cells
        return self._info[InfoData._fields.index("cell_count")]

    @property
    def energy(self) -> NDArray[Any]:
        return self._block.energy[self._live.rows]

    @property
    def run_time(self) -> Numbers:
        return self._block.run_time[self._live.rows]

    @property
    def suspect_frames(self) -> Numbers:
        return self._block.suspects[self._live.rows]

    @property
    def live_ns(self) -> Numbers:
        return self._block.live_ns[self._live.rows]

    @property
    def frame_rate(self) -> Numbers:
        return self._block.rate_at(self._turns, self._now, self._with_bytes)

    def age_ms(self, now: Numbers) -> Numbers:
        found: Numbers = np.maximum(now - self.live_ns, 0) // MS
        return found

    def bec_current_supplied(self, raw: Numbers) -> Any:
        esc = self._block.esc
        if esc.info is not None:  # the same device in the whole block
            return esc.info.device != Device.JIVEPRO
        if esc.last_info is not None and esc.last_info.device == Device.JIVEPRO:
            return False
        return raw != 0


class _Counters:
    """As a Deframer's counters; what is not here does not change while frames are intact."""

    def __init__(self, block: Steady, states: Numbers) -> None:
        self._block = block
        self._states = states
        self.crc_errors = block.esc.counters.crc_errors
        self.dropped_bytes = block.esc.counters.dropped_bytes

    @property
    def bytes(self) -> Numbers:
        return self._block.esc.counters.bytes + self._block.bytes_at(self._states)

    @property
    def live(self) -> Numbers:
        return self._block.esc.counters.live + self._block.live_rows[self._states]

    @property
    def info(self) -> Numbers:
        return self._block.esc.counters.info + self._block.info_rows[self._states]
