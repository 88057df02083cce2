"""When each message is sent while a block of frames comes, and with what: DbcOutput and Schedule for many frames at once.

A message is sent without regard to the others, so each is followed by itself. Most have a plain pace, with each frame or by their cycle
alone; their sending times are reckoned in columns. The others are followed step by step from one thing that concerns them to the next.
"""

from bisect import bisect_left
from collections.abc import Sequence
from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kontronik_can_gw.dbc_output.layout import Layout, MessagePlan
from kontronik_can_gw.dbc_output.output import DbcOutput, _Message
from kontronik_can_gw.dbc_output.schedule import LEAST_DISTANCE_NS
from kontronik_can_gw.offline.bulk.columns import Bits, ColumnPacker
from kontronik_can_gw.offline.bulk.state import Numbers, Rare, Steady
from kontronik_can_gw.sources import Group
from kontronik_can_gw.telemetry import Event

MOST_FRAMES = (1 << 14) - 1
"""In a block; of UART frames."""
MOST_PERIOD_NS = (1 << 36) - 1
_MOST_MESSAGES = 1 << 10
_TOLD_WITH_BYTES, _EVENT, _SECOND, _TOLD, _DUE = range(5)
"""What a frame goes out for, in the order in which it is asked within one instant."""
_END = (1 << 14, 0, 0)


class Part(NamedTuple):
    """The frames of one message in a block."""

    message: int
    """Its index in the layout."""
    times: Numbers
    places: Numbers
    """Where each stands among the frames of all messages."""
    data: NDArray[np.uint8]
    """A row each."""


class CanFrames:
    """Many CAN frames, by message."""

    def __init__(self, parts: list[Part]) -> None:
        self.parts = [part for part in parts if len(part.times)]
        self.count = sum(len(part.times) for part in self.parts)

    def __len__(self) -> int:
        return self.count

    @property
    def first_ns(self) -> int:
        """When the first one is sent."""
        return min(int(part.times[0]) for part in self.parts)

    @property
    def last_ns(self) -> int:
        """When the last one is sent."""
        return max(int(part.times[-1]) for part in self.parts)

    def between(self, first_ns: int, last_ns: int) -> "CanFrames":
        """Those that are sent from ``first_ns`` to ``last_ns``."""
        if not self.parts or (first_ns <= self.first_ns and self.last_ns <= last_ns):
            return self
        cuts = [np.searchsorted(part.times, (first_ns, last_ns + 1)).tolist() for part in self.parts]
        before = sum(begin for begin, _ in cuts)
        return CanFrames(
            [
                Part(part.message, part.times[begin:end], part.places[begin:end] - before, part.data[begin:end])
                for part, (begin, end) in zip(self.parts, cuts, strict=True)
            ]
        )


class _Sends(NamedTuple):
    """The frames of one message; a number stands for all. ``number``: counted from the first of the block, replaced ones too."""

    turn: Numbers
    since: "Numbers | int"
    rank: "Numbers | int"
    state: Numbers
    time: Numbers
    place: "Numbers | int"
    number: Numbers
    with_bytes: "NDArray[np.bool_] | bool"
    """What it holds is that of the step of a frame's bytes."""


class Sender:
    """The messages of a layout. ``possible``: False where one of them can only be followed by the packer itself."""

    def __init__(self, layout: Layout, output: DbcOutput) -> None:
        self._output = output
        self._followers = [
            _Follower(output, index, plan, message)
            for index, (plan, message) in enumerate(zip(layout.messages, output._messages, strict=True))
        ]
        self.tells = any(follower.tells for follower in self._followers)
        """True where it makes a difference when the gateway is told that a second is over."""
        self.possible = len(self._followers) <= _MOST_MESSAGES and all(f.possible for f in self._followers)

    @property
    def is_ready(self) -> bool:
        """True where a block may begin now."""
        return all(follower.is_ready for follower in self._followers)

    def send(self, block: Steady) -> CanFrames:
        """The frames of a block; the output's objects are as after its last frame."""
        sent = [follower.send(block) for follower in self._followers]
        heap = self._output._schedule._heap
        heap[:] = sorted(entry for entry in heap if entry[0] > block.times[-1])
        all_places = _places([sends for sends, _ in sent])
        return CanFrames(
            [
                Part(index, sends.time, places, data)
                for index, ((sends, data), places) in enumerate(zip(sent, all_places, strict=True))
            ]
        )


def _places(sent: Sequence[_Sends]) -> list[Numbers]:
    """Where the frames of each message stand among those of all."""
    if not sent:
        return []
    turns, count = sent[0].turn, len(sent)
    if all(
        sends.turn is turns and isinstance(sends.rank, int) and sends.rank == _EVENT for sends in sent
    ):  # each with the same frames
        return [np.arange(index, count * len(turns), count) for index in range(count)]
    keys = [((s.turn << 36 | s.since) << 3 | s.rank) << 10 | index for index, s in enumerate(sent)]
    order = np.argsort(np.concatenate(keys), kind="stable")
    places = np.empty_like(order)
    places[order] = np.arange(len(order))
    return np.split(places, np.cumsum([len(key) for key in keys])[:-1])


class _Follower:
    """One message."""

    def __init__(self, output: DbcOutput, index: int, plan: MessagePlan, message: _Message) -> None:
        self._schedule = output._schedule
        self._index = index
        self._plan = plan
        self._message = message
        self.packer = ColumnPacker(plan)
        self._states: tuple[Steady, dict[int | None, Bits]] | None = None  # of the block in work
        self.tells = Group.GATEWAY in plan.paces and not plan.cycle_ns
        asked = bool(message.triggers & (Event.LIVE | Event.INFO | Event.SECOND)) or self.tells
        self.possible = not message.silent_able and not (
            message.on_change and not message.by_event and self.packer.follows_time and asked
        )

    @property
    def is_ready(self) -> bool:
        schedule, index = self._schedule, self._index
        if not self.packer.follows_time or self._message.by_event or not self._message.on_change:
            return True
        return not schedule._waiting[index] and not self._message.owed

    def send(self, block: Steady) -> tuple[_Sends, NDArray[np.uint8]]:
        """When it is sent, and with what."""
        sends = self._plain_events(block) or self._plain_cycle(block) or _Steps(self, block).sends
        message, plan = self._message, self._plan
        count = len(sends.turn)
        if not count:
            return sends, np.empty((0, plan.length), np.uint8)
        alive = (sends.number + message.alive) % message.alive_modulus if message.alive_modulus > 1 else None
        if len(plan.pages) == 1:
            bits = self._packed(block, sends, alive, plan.pages[0], slice(None))
        else:
            bits = np.empty((count, self.packer.words), np.uint64)
            for place, page in enumerate(plan.pages):
                chosen = np.flatnonzero(sends.place == place)
                if len(chosen):
                    bits[chosen] = self._packed(block, sends, alive, page, chosen)
        message.alive = (message.alive + int(sends.number.max()) + 1) % message.alive_modulus
        return sends, self.packer.data(bits)

    def _packed(
        self, block: Steady, sends: _Sends, alive: Numbers | None, page: int | None, chosen: "slice | Numbers"
    ) -> Bits:
        """What the frames of one page hold."""
        alive = np.zeros(1, np.int64) if alive is None else alive[chosen]
        turns, states, times = sends.turn[chosen], sends.state[chosen], sends.time[chosen]
        message = self._message
        if self._states is not None and self._states[0] is block:
            bits = self._states[1][page][states]
            message.last[page] = number_of(bits, -1)
            self.packer.put_alive(bits, alive)
            return bits
        with_bytes = sends.with_bytes
        if isinstance(with_bytes, np.ndarray):
            with_bytes = with_bytes[chosen]
        if message.on_change:  # what is compared with has no alive counter
            of_last = with_bytes[-1:] if isinstance(with_bytes, np.ndarray) else with_bytes
            last = block.moments(turns[-1:], states[-1:], times[-1:], of_last)
            message.last[page] = number_of(self.packer.bits(last, 0, page), 0)
        if with_bytes is True and isinstance(chosen, slice):
            return self.packer.bits(block.moments_with_bytes(sends.turn), alive, page)
        return self.packer.bits(block.moments(turns, states, times, with_bytes), alive, page)

    def asking(self, block: Steady) -> Numbers:
        """The turns whose frames ask for the message."""
        wanted = self._message.triggers
        return block.turns_of(bool(wanted & Event.LIVE), bool(wanted & Event.INFO))

    def rare(self, block: Steady) -> list[tuple[tuple[int, int, int], Rare]]:
        """What else asks for the message, with its step."""
        found = []
        for one in block.rare:
            if one.events & self._message.triggers:
                found.append(((one.turn, one.since_ns, _SECOND), one))
            if one.is_told and self.tells:
                found.append(((one.turn, one.since_ns, _TOLD_WITH_BYTES if one.with_bytes else _TOLD), one))
        return found

    def _plain_events(self, block: Steady) -> _Sends | None:
        """Sent with each frame that asks, and for nothing else; None where it is not so."""
        message, schedule, index = self._message, self._schedule, self._index
        if not message.by_event or message.owed or schedule._waiting[index] or self._plan.cycle_ns or self.rare(block):
            return None
        turns = self.asking(block)
        times, least = block.times_at(turns)
        delay = self._plan.delay_ns
        if len(times) and (times[0] < schedule._last[index] + delay or least < delay):
            return None
        return self._at_pace(turns, 0, _EVENT, times)

    def _plain_cycle(self, block: Steady) -> _Sends | None:
        """Sent by its cycle and for nothing else; None where it is not so."""
        message, schedule, index, cycle = self._message, self._schedule, self._index, self._plan.cycle_ns
        if not cycle or message.owed or schedule._waiting[index] or self.rare(block):
            return None
        if self._plan.delay_ns > cycle:
            return None
        if len(self.asking(block)) and (message.by_event or not self._never_changes(block)):
            return None
        place = next(at for at, (_, i, waited) in enumerate(schedule._heap) if i == index and not waited)
        first, end = schedule._heap[place][0], int(block.times[-1])
        if first < schedule._last[index] + self._plan.delay_ns:
            return None
        times = np.arange(first, end + 1, cycle, dtype=np.int64)
        schedule._heap[place] = (first + cycle * len(times), index, False)
        turns, since = step_of(block.times, times)
        return self._at_pace(turns, since, _DUE, times)

    def _at_pace(self, turns: Numbers, since: "Numbers | int", rank: int, times: Numbers) -> _Sends:
        message, count, pages = self._message, len(turns), len(self._plan.pages)
        number = np.arange(count)
        place = (number + message.page) % pages if pages > 1 else 0
        message.page = (message.page + count) % pages
        if count:
            self._schedule._last[self._index] = int(times[-1])
            self._schedule._waiting[self._index] = self._schedule._cycle_waits[self._index] = False
        return _Sends(turns, since, rank, turns, times, place, number, rank == _EVENT)

    def _never_changes(self, block: Steady) -> bool:
        """True where no frame that asks finds another page than was sent last."""
        turns = self.asking(block)
        for page, bits in self.bits_by_state(block).items():
            last = self._message.last.get(page)
            if last is None or (bits[turns] != words_of(last, self.packer.words)).any():
                return False
        return True

    def bits_by_state(self, block: Steady) -> dict[int | None, Bits]:
        """Of each page what it holds at each state, alive counter 0; of a message that does not follow time."""
        if self._states is None or self._states[0] is not block:
            states = np.arange(block.count + 1)
            rows = None
            if self._plan.paces == {Group.INFO}:  # they hold until the next information comes
                states, rows = np.concatenate(([0], block.turns_of(False, True))), block.info_rows
            moments = block.moments(states, states, block.times[states], True)
            found = {page: self.packer.bits(moments, 0, page) for page in self._plan.pages}
            self._states = block, found if rows is None else {page: bits[rows] for page, bits in found.items()}
        return self._states[1]


class _Steps:
    """A message step by step: the same rules as DbcOutput and Schedule have, for one message."""

    def __init__(self, follower: _Follower, block: Steady) -> None:
        self._block = block
        message, schedule, index = follower._message, follower._schedule, follower._index
        self._message = message
        self._plan = follower._plan
        self._delay = follower._plan.delay_ns
        self._last_ns = schedule._last[index]
        self._waiting = schedule._waiting[index]
        self._cycle_waits = schedule._cycle_waits[index]
        self._put_offs = sorted(when for when, i, waited in schedule._heap if i == index and waited)
        self._cycle_ns = next((when for when, i, waited in schedule._heap if i == index and not waited), None)
        self._last = dict(message.last)
        asking = follower.asking(block)
        self._turns: list[int] = asking.tolist()
        self._times: list[int] = block.times_at(asking)[0].tolist()
        self._rare = follower.rare(block)
        self._bits: dict[int | None, list[int]] = {}
        self._changes: list[int] = []
        self._state_changes: list[int] = []
        if message.on_change and (self._turns or self._waiting or self._rare or message.owed):
            by_state = follower.bits_by_state(block)
            self._bits = {page: numbers_of(bits) for page, bits in by_state.items()}
            if len(self._plan.pages) == 1:
                found = by_state[self._plan.pages[0]][np.array(self._turns, np.int64)]
                self._changes = changes_of(found)
                self._state_changes = changes_of(by_state[self._plan.pages[0]])
        self._found: list[tuple[int, int, int, int, int, int, int, bool, int]] = []
        """As _Sends, and how many: of more than one, each a cycle behind the one before."""
        self._number = 0
        self._follow()
        schedule._last[index], schedule._waiting[index] = self._last_ns, self._waiting
        schedule._cycle_waits[index] = self._cycle_waits
        heap = [entry for entry in schedule._heap if entry[1] != index]
        heap += [(when, index, True) for when in self._put_offs]
        if self._cycle_ns is not None:
            heap.append((self._cycle_ns, index, False))
        schedule._heap[:] = heap
        self.sends = self._all_found()

    def _all_found(self) -> _Sends:
        columns = [np.ascontiguousarray(column) for column in np.array(self._found, np.int64).reshape(-1, 9).T]
        counts = columns.pop()
        if counts.sum() > len(counts):
            entry = np.repeat(np.arange(len(counts)), counts)
            more = np.arange(len(entry)) - np.repeat(counts.cumsum() - counts, counts)
            columns = [column[entry] for column in columns]
            turn, since, _, state, time, _, number, _ = columns
            time += more * self._plan.cycle_ns
            number += more
            further = np.flatnonzero(more)
            turn[further], since[further] = step_of(self._block.times, time[further])
            state[further] = turn[further]
        turn, since, rank, state, time, place, number, with_bytes = columns
        return _Sends(turn, since, rank, state, time, place, number, with_bytes.astype(bool))

    def _follow(self) -> None:
        times = self._block.time_list
        end = times[-1]
        at, rare_at = 0, 0
        message = self._message
        while True:
            asking = self._next_asking(at)
            asks = (self._turns[asking], 0, _EVENT) if asking < len(self._turns) else _END
            rare = self._rare[rare_at][0] if rare_at < len(self._rare) else _END
            due = self._next_due()
            step = _END
            if due is not None and due <= end:
                turn = bisect_left(times, due, 1)
                step = (turn, 0, _DUE) if times[turn] == due else (turn - 1, due - times[turn - 1], _DUE)
            first = min(asks, rare, step)
            if first is _END or first == _END:
                return
            turn, since, rank = first
            now = times[turn] + since
            at = bisect_left(self._turns, turn if rank < _EVENT else turn + 1, at)  # what asked before has been heard
            if first == asks:
                if (message.by_event or self._note(turn)) and self._request(now):
                    self._send(turn, since, rank, turn, now)
            elif first == rare:
                state = self._rare[rare_at][1].state
                rare_at += 1
                if (message.by_event or self._note(state)) and self._request(now):
                    self._send(turn, since, rank, state, now)
            elif not self._run(turn, since, now, min(asks, rare)):
                self._turn_clock(turn, since, now)

    def _run(self, turn: int, since: int, now: int, until: tuple[int, int, int]) -> bool:
        """Send by the cycle alone, as long as nothing changes and nobody asks (``until``); False where this is no such place."""
        cycle, times = self._plan.cycle_ns, self._block.time_list
        if not self._bits or len(self._plan.pages) > 1 or self._delay > cycle:
            return False
        if self._waiting or self._put_offs or self._message.owed or now < self._last_ns + self._delay:
            return False
        page = self._plan.pages[0]
        if self._bits[page][turn] != self._last.get(page) or (self._found and self._found[-1][:2] == (turn, since)):
            return False
        limit = times[-1] + 1
        if until != _END:
            limit = min(limit, times[until[0]] + until[1])
        change = bisect_left(self._state_changes, turn + 1)
        if change < len(self._state_changes):
            limit = min(limit, times[self._state_changes[change]])
        count = (limit - 1 - now) // cycle + 1
        if count < 2:
            return False
        self._found.append((turn, since, _DUE, turn, now, 0, self._number, False, count))
        self._number += count
        self._cycle_ns = now + count * cycle
        self._last_ns = self._cycle_ns - cycle
        self._cycle_waits = False
        return True

    def _next_asking(self, at: int) -> int:
        """The next of the frames that ask which can make a difference."""
        message = self._message
        alone = len(self._plan.pages) == 1
        if self._waiting and (message.by_event or alone):
            at = max(at, bisect_left(self._times, self._last_ns + self._delay))
        if message.by_event or not alone or at >= len(self._turns):
            return at
        page = self._plan.pages[0]
        if self._bits[page][self._turns[at]] != self._last.get(page):
            return at
        change = bisect_left(self._changes, at + 1)
        return self._changes[change] if change < len(self._changes) else len(self._turns)

    def _next_due(self) -> int | None:
        if self._put_offs and (self._cycle_ns is None or self._put_offs[0] < self._cycle_ns):
            return self._put_offs[0]
        return self._cycle_ns

    def _turn_clock(self, turn: int, since: int, now: int) -> None:
        """As Schedule.due and DbcOutput.advance."""
        found: bool | None = None
        message = self._message
        if self._cycle_ns == now:
            self._cycle_ns += self._plan.cycle_ns
            if self._request(now):
                found = True
            else:
                self._cycle_waits = True
        while self._put_offs and self._put_offs[0] <= now:
            heappop(self._put_offs)
            if not self._waiting:
                continue
            if now < self._last_ns + self._delay:
                heappush(self._put_offs, self._last_ns + self._delay)
                continue
            self._waiting = False
            found = found or self._cycle_waits
            self._cycle_waits = False
        if found is None:
            return
        pages = len(self._plan.pages)
        if found and pages > 1:
            if message.page not in message.owed:
                message.owed.append(message.page)
            message.page = (message.page + 1) % pages
        if found or message.by_event or message.owed or self._note(turn):
            self._send(turn, since, _DUE, turn, now)

    def _request(self, now: int) -> bool:
        if now >= self._last_ns + self._delay:
            return True
        self._put_off(self._last_ns + self._delay)
        return False

    def _put_off(self, until: int) -> None:
        if not self._waiting:
            self._waiting = True
            heappush(self._put_offs, until)

    def _note(self, state: int) -> bool:
        changed = [
            place for place, page in enumerate(self._plan.pages) if self._bits[page][state] != self._last.get(page)
        ]
        if len(self._plan.pages) > 1:
            self._message.owed += [place for place in changed if place not in self._message.owed]
        return bool(changed)

    def _send(self, turn: int, since: int, rank: int, state: int, now: int) -> None:
        message = self._message
        if message.owed:
            place = message.owed.pop(0)
        else:
            place = message.page
            message.page = (place + 1) % len(self._plan.pages)
        page = self._plan.pages[place]
        if self._bits:
            self._last[page] = self._bits[page][state]
        sent = (turn, since, rank, state, now, place, self._number, rank <= _EVENT, 1)
        self._number += 1
        at = len(self._found) - 1
        while at >= 0 and self._found[at][:2] == (turn, since) and self._found[at][5] != place:
            at -= 1
        if at >= 0 and self._found[at][:2] == (turn, since):  # the newest of an instant stands where the first one did
            self._found[at] = (*sent[:2], self._found[at][2], *sent[3:])
        else:
            self._found.append(sent)
        self._last_ns = now
        self._waiting = self._cycle_waits = False
        if message.owed:
            self._put_off(now + max(self._delay, LEAST_DISTANCE_NS))


def step_of(times: Numbers, when: Numbers) -> tuple[Numbers, Numbers]:
    """The turn of each instant at which the clock turns, and how long after its frame."""
    turns = np.searchsorted(times[1:], when, "left") + 1
    turns -= times[np.minimum(turns, len(times) - 1)] != when
    return turns, when - times[turns]


def number_of(bits: Bits, row: int) -> int:
    """A row as one number."""
    return int.from_bytes(bits[row].astype("<u8").tobytes(), "little")


def numbers_of(bits: Bits) -> list[int]:
    """Each row as one number."""
    if bits.shape[1] == 1:
        numbers: list[int] = bits[:, 0].tolist()
        return numbers
    data, size = bits.astype("<u8").tobytes(), 8 * bits.shape[1]
    return [int.from_bytes(data[at : at + size], "little") for at in range(0, len(data), size)]


def changes_of(bits: Bits) -> list[int]:
    """The rows that differ from the one before."""
    found: list[int] = (np.flatnonzero((bits[1:] != bits[:-1]).any(axis=1)) + 1).tolist()
    return found


def words_of(number: int, words: int) -> NDArray[np.uint64]:
    """One number as 64-bit words."""
    return np.frombuffer(number.to_bytes(8 * words, "little"), "<u8")
