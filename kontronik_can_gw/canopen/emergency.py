"""Emergencies: error register 1001h, history 1003h, COB-ID 1014h, inhibit time 1015h (CiA 301, 7.2.7 and 7.5.2.2/4/17/18)."""

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from operator import itemgetter
from struct import Struct

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.cob_ids import EMERGENCY, INVALID_BIT, Taken, check_free
from kontronik_can_gw.canopen.dictionary import Abort, Dictionary, SdoAbort
from kontronik_can_gw.canopen.emergency_codes import (
    FROM_GATEWAY,
    OF_COMMUNICATION,
    BitCodes,
    Condition,
    GatewayError,
    register_of,
)
from kontronik_can_gw.status import UNCONFIGURED
from kontronik_can_gw.times import MS, NEVER

_MAX_PENDING = 64
_DATA = Struct("<HBBI")


class Emergencies:
    """State of one node's errors.

    ``send`` is called with COB-ID and the 8 bytes of each emergency.

    Emergencies are sent in the order in which the errors happened. The loss of telemetry may be
    noticed late, after a hold-up of the process, and before the frames that waited are read. From
    then on emergencies are delayed until ``advance``, which every turn of the loop ends with.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        send: Callable[[int, bytes], None],
        taken: Taken,
        bits: BitCodes,
    ) -> None:
        self._dictionary = dictionary
        self._bits = bits
        self._send = send
        self._taken = taken
        self._node_id = UNCONFIGURED
        kept = sum(1 for _ in dictionary.subs(0x1003))
        self.history: deque[int] = deque(maxlen=max(1, kept))
        """1003h, newest first: bits 15..0 code, 23..16 byte 3, 31..24 byte 4."""
        self.mask = 0xFFFFFFFF
        self._inhibit_ns = 0
        self._word = 0  # of the ESC
        self._registered = 0
        """Bits of 1001h that the ESC's error word sets."""
        self._active: dict[Condition, None] = {}
        self._unreported: dict[Condition, None] = {}
        self._last_is_error = False  # what was sent last is an error, not 0000h
        self._pending: deque[tuple[Condition | None, bytes]] = deque(maxlen=_MAX_PENDING)
        self._delayed: list[tuple[int, Condition, bytes]] = []
        """Time, condition and data of emergencies that ``advance`` sorts and reports."""
        self._delayed_since = NEVER
        self._open = False
        self._last_ns = -NEVER
        self._risen = False  # since the last reset something was wrong
        bind = dictionary.bind
        bind(0x1001, read=lambda _now: self.register)
        bind(0x1003, read=lambda _now: len(self.history), check=_only_zero, written=self._clear)
        for variable in dictionary.subs(0x1003):
            variable.read = partial(self._kept, variable.entry.sub)
        bind(0x1014, check=self._check_cob_id)
        bind(0x1015, written=lambda _now: self.configure(self._node_id))
        bind(at.ERROR_CODE, read=lambda _now: self.code)

    @property
    def cob_id(self) -> int:
        """1014h; that of the predefined connection set where the EDS has dropped it."""
        return self._dictionary.number(0x1014, otherwise=EMERGENCY + self._node_id)

    @property
    def register(self) -> int:
        """1001h."""
        found = self._registered
        for condition in self._active:
            found |= register_of(condition.code)
        return found

    @property
    def code(self) -> int:
        """The newest error's code that is still there, 0 without one (603Fh)."""
        return next(reversed(self._active)).code if self._active else 0

    @property
    def due(self) -> int:
        """When ``advance`` has something to do."""
        pending = self._last_ns + self._inhibit_ns if self._pending else NEVER
        return min(self._delayed_since, pending)

    def set_word(self, word: int, now: int, at: int | None = None, force: bool = False) -> None:
        """Follows the ESC's error word of a live frame that arrived ``at``, or a new mask (``force``)."""
        if word == self._word and not force:
            return
        self._word = word
        wanted, self._registered = self._bits.of(word, self.mask)
        gone = [c for c in self._active if c.source != FROM_GATEWAY and c not in wanted]
        for condition in gone:
            del self._active[condition]
        for condition in wanted:
            if condition not in self._active:
                self._rise(condition, now, at)
        self._end(now)

    def set(
        self,
        error: GatewayError,
        present: bool,
        now: int,
        detail: int | None = None,
        at: int | None = None,
    ) -> None:
        """Begins or ends one of the gateway's own findings, which happened ``at`` (None: now)."""
        code, which = error.value
        condition = Condition(code, FROM_GATEWAY, which if detail is None else detail)
        if present and condition not in self._active:
            if error is GatewayError.TELEMETRY_LOST and self._open:
                self._delayed_since = min(self._delayed_since, now)
            self._rise(condition, now, at)
        elif not present and condition in self._active:
            del self._active[condition]
            self._end(now)

    def pulse(self, error: GatewayError, now: int) -> None:
        """A finding that is over as soon as it is reported."""
        self.set(error, True, now)
        self.set(error, False, now)

    def open(self, now: int) -> None:
        """Emergencies may be sent (PRE-OPERATIONAL, OPERATIONAL): what rose and is still there is reported."""
        self._open = True
        for condition in self._unreported:
            if condition in self._active:
                self._report(condition)
        self._unreported = {}
        self._end(now)
        self._send_pending(now)

    def close(self) -> None:
        """Sends no more emergencies (STOPPED). Pending ones are reported later if still true then."""
        self._report_delayed()
        self._open = False
        self._unreported |= dict.fromkeys(each for each, _ in self._pending if each is not None)
        self._pending.clear()

    def reset(self) -> None:
        """Reset communication: what is wrong is unreported and all that the history holds; heartbeats and SYNC are watched anew."""
        self.close()
        kept = [each for each in self._active if each.code not in OF_COMMUNICATION]
        self._active = dict.fromkeys(kept)
        self.history.clear()
        for condition in self._active:
            self._note(condition)
        self._last_is_error = False
        self._unreported = dict(self._active)
        self._risen = bool(self._active)
        self._last_ns = -NEVER

    def configure(self, node_id: int) -> None:
        """Take over 1015h, and the node-ID for a dictionary without 1014h."""
        self._node_id = node_id
        self._inhibit_ns = self._dictionary.number(0x1015) * MS // 10

    def repeat(self, now: int) -> None:
        """After an outage in which emergencies were lost: report all that is wrong once more, or that nothing is."""
        was_open = self._open
        self.close()
        self._unreported = dict(self._active)
        self._last_is_error = self._risen
        if was_open:
            self.open(now)

    def advance(self, now: int) -> None:
        """Reports what was delayed, in order, and sends what the inhibit time permits."""
        if self._delayed_since != NEVER:
            self._report_delayed()
            self._end(now)
        self._send_pending(now)

    def _report_delayed(self) -> None:
        """Reports the delayed emergencies, and orders the history, by the times of the errors."""
        now, self._delayed_since = self._delayed_since, NEVER
        delayed = sorted(self._delayed, key=itemgetter(0))
        if delayed != self._delayed:
            self._sort_newest([condition for _, condition, _ in delayed])
        self._delayed = []
        if delayed:
            self._pending += [(condition, data) for _, condition, data in delayed]
            self._send_pending(now)

    def _sort_newest(self, conditions: Sequence[Condition]) -> None:
        """Puts the newest entries of 1003h, and the errors that are still there, into this order."""
        for _ in conditions[: len(self.history)]:
            self.history.popleft()
        for condition in conditions:
            self._note(condition)
            if condition in self._active:
                del self._active[condition]
                self._active[condition] = None

    def _send_pending(self, now: int) -> None:
        while self._pending and now >= self._last_ns + self._inhibit_ns:
            condition, data = self._pending.popleft()
            if not (cob_id := self.cob_id) & INVALID_BIT:
                self._send(cob_id & 0x7FF, data)
                self._last_is_error = condition is not None
                self._last_ns = now

    def _rise(self, condition: Condition, now: int, at: int | None) -> None:
        self._active[condition] = None
        self._risen = True
        self._note(condition)
        if self._delayed_since != NEVER:
            happened_ns = now if at is None else at
            self._delayed.append((happened_ns, condition, self._data_of(condition)))
        elif self._open:
            self._report(condition)
            self._send_pending(now)
        else:
            self._unreported[condition] = None

    def _note(self, condition: Condition) -> None:
        self.history.appendleft(condition.detail << 24 | condition.source << 16 | condition.code)

    def _end(self, now: int) -> None:
        """Reports 0000h if an error was reported, or is pending, and none is left."""
        if self._delayed_since != NEVER:
            return
        last_is_error = self._pending[-1][0] is not None if self._pending else self._last_is_error
        if last_is_error and self._open and not self._active:
            self._report(None)
            self._send_pending(now)

    def _report(self, condition: Condition | None) -> None:
        # a full queue drops its oldest entry
        self._pending.append((condition, self._data_of(condition)))

    def _data_of(self, condition: Condition | None) -> bytes:
        if condition is None:
            return _DATA.pack(0, self.register, FROM_GATEWAY, 0)
        code, source, detail = condition
        last = detail if source == FROM_GATEWAY else self._word
        return _DATA.pack(code, self.register, source, last)

    # --- objects

    def _kept(self, number: int, _now: int) -> int:
        if number > len(self.history):
            raise SdoAbort(Abort.NO_DATA)
        return self.history[number - 1]

    def _clear(self, _now: int) -> None:
        self.history.clear()

    def _check_cob_id(self, value: int) -> None:
        """1014h: bits 0..30 cannot change while it is valid; no 29-bit or restricted id, none that is taken."""
        old, valid = self.cob_id, not value & INVALID_BIT
        if value & 0x7FFFF800 or (valid and not old & INVALID_BIT and old != value):
            raise SdoAbort(Abort.VALUE)
        if valid:
            check_free(value & 0x7FF, self, self._taken)


def _only_zero(value: int) -> None:
    """A new 1003h:0."""
    if value:
        raise SdoAbort(Abort.VALUE)
