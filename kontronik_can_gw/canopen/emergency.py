"""Emergencies: error register 1001h, history 1003h, COB-ID 1014h, inhibit time 1015h.

See CiA 301, 7.2.7 and 7.5.2.2/4/17/18.
"""

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from operator import itemgetter
from struct import Struct

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.cob_ids import EMERGENCY, INVALID_BIT, Taken, check_free
from kontronik_can_gw.canopen.dictionary import Abort, Dictionary, SdoAbort, only
from kontronik_can_gw.canopen.emergency_codes import (
    FROM_GATEWAY,
    OF_COMMUNICATION,
    BitCodes,
    GatewayError,
    PresentError,
    register_of,
)
from kontronik_can_gw.status import UNCONFIGURED
from kontronik_can_gw.times import MS, NEVER

_MAX_PENDING = 64
_DATA = Struct("<HBBI")


class Emergencies:
    """The errors of one node.

    ``send`` is called with the COB-ID and the 8 bytes of each emergency.

    Emergencies are sent in the order in which the errors happened. After a hold-up of the process,
    the loss of telemetry may be noticed before older frames are read. So each loss of telemetry
    delays emergencies until ``advance``, which the loop calls at the end of every iteration.
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
        history_size = sum(1 for _ in dictionary.subs(0x1003))
        self.history: deque[int] = deque(maxlen=max(1, history_size))
        """1003h, newest first: bits 15..0 code, 23..16 byte 3, 31..24 byte 4."""
        self.mask = 0xFFFFFFFF
        """Bits of the ESC's error word that cause emergencies (2100h:6)."""
        self._inhibit_ns = 0
        self._word = 0
        """The newest error word of the ESC."""
        self._registered = 0
        """Bits of 1001h that the ESC's error word sets."""
        self._active: dict[PresentError, None] = {}
        """Present errors in the order in which they began."""
        self._unreported: dict[PresentError, None] = {}
        """Errors that began while no emergencies could be sent."""
        self._is_last_an_error = False
        """True if the last emergency sent was an error, not 0000h."""
        self._pending: deque[tuple[PresentError | None, bytes]] = deque(maxlen=_MAX_PENDING)
        self._delayed: list[tuple[int, PresentError, bytes]] = []
        """Time, condition and data of emergencies that ``advance`` sorts and reports."""
        self._delayed_since = NEVER
        """Time since which emergencies are delayed. NEVER if they are not."""
        self._is_open = False
        self._last_ns = -NEVER
        self.is_quiet = False
        """True if no emergencies are sent: in quiet mode, or because no frame may leave.

        ``repeat`` sends them afterwards.
        """
        self._has_had_error = False
        """True if there was an error since the last reset."""
        self._bind_objects()

    def _bind_objects(self) -> None:
        bind = self._dictionary.bind

        def clear(_now: int) -> None:
            self.history.clear()

        bind(0x1001, read=lambda _now: self.register)
        bind(
            0x1003,
            read=lambda _now: len(self.history),
            check=only((0,)),
            written=clear,
        )
        for variable in self._dictionary.subs(0x1003):
            variable.read = partial(self._read_history, variable.entry.sub)
        bind(0x1014, check=self._check_cob_id)
        bind(0x1015, written=lambda _now: self.configure(self._node_id))
        bind(at.ERROR_CODE, read=lambda _now: self.code)

    @property
    def cob_id(self) -> int:
        """1014h, or the COB-ID of the predefined connection set if the EDS has no 1014h."""
        return self._dictionary.number(0x1014, otherwise=EMERGENCY + self._node_id)

    @property
    def register(self) -> int:
        """The error register 1001h."""
        register = self._registered
        for condition in self._active:
            register |= register_of(condition.code)
        return register

    @property
    def code(self) -> int:
        """The code of the newest present error, 0 without errors (603Fh)."""
        if not self._active:
            return 0
        newest = next(reversed(self._active))
        return newest.code

    @property
    def due(self) -> int:
        """Earliest time at which ``advance`` acts."""
        pending = self._last_ns + self._inhibit_ns if self._pending else NEVER
        return min(self._delayed_since, pending)

    def set_word(self, word: int, now: int, at: int | None = None) -> None:
        """Take over the ESC's error word from a live frame that arrived ``at``, and the mask."""
        self._word = word
        present, self._registered = self._bits.of(word, self.mask)
        ended = [
            condition
            for condition in self._active
            if condition.source != FROM_GATEWAY and condition not in present
        ]
        for condition in ended:
            del self._active[condition]
        for condition in present:
            if condition not in self._active:
                self._begin(condition, now, at)
        self._end(now)

    def set(
        self,
        error: GatewayError,
        is_present: bool,
        now: int,
        detail: int | None = None,
        at: int | None = None,
    ) -> None:
        """Begin or end an error that the gateway detected.

        The change happened ``at`` (None: now). ``detail`` replaces byte 4 of the emergency.
        """
        code, own_detail = error.value
        if detail is None:
            detail = own_detail
        condition = PresentError(code, FROM_GATEWAY, detail)
        if is_present and condition not in self._active:
            if error is GatewayError.TELEMETRY_LOST and self._is_open:
                self._delayed_since = min(self._delayed_since, now)
            self._begin(condition, now, at)
        elif not is_present and condition in self._active:
            del self._active[condition]
            self._end(now)

    def pulse(self, error: GatewayError, now: int) -> None:
        """Report an error that has already ended."""
        self.set(error, True, now)
        self.set(error, False, now)

    def open(self, now: int) -> None:
        """Allow emergencies, because the node is PRE-OPERATIONAL or OPERATIONAL.

        Errors that began before and are still present are reported.
        """
        self._is_open = True
        for condition in self._unreported:
            if condition in self._active:
                self._report(condition)
        self._unreported = {}
        self._end(now)
        self._send_pending(now)

    def close(self) -> None:
        """Send no emergencies until ``open``, because the node is STOPPED.

        Pending ones are reported later if their errors are still present.
        """
        self._report_delayed()
        self._is_open = False
        for condition, _ in self._pending:
            if condition is not None:
                self._unreported[condition] = None
        self._pending.clear()

    def reset(self) -> None:
        """Reset communication.

        All present errors count as unreported, and the history holds only these. Errors of
        heartbeats and SYNC are dropped, because their watch begins again.
        """
        self.close()
        self._active = {
            condition: None for condition in self._active if condition.code not in OF_COMMUNICATION
        }
        self.history.clear()
        for condition in self._active:
            self._note(condition)
        self._is_last_an_error = False
        self._unreported = dict(self._active)
        self._has_had_error = bool(self._active)
        self._last_ns = -NEVER

    def configure(self, node_id: int) -> None:
        """Take over 1015h, and the node-ID, which is needed if the EDS has no 1014h."""
        self._node_id = node_id
        self._inhibit_ns = self._dictionary.number(0x1015) * MS // 10

    def repeat(self, now: int, ended: GatewayError | None = None) -> None:
        """Report all present errors again, or 0000h, after emergencies may have been lost.

        ``ended`` is an error that has ended and was not reported. It follows the present ones.
        """
        was_open = self._is_open
        self.close()
        if ended is not None:
            self.set(ended, True, now)
        self._unreported = dict(self._active)
        self._is_last_an_error = self._has_had_error
        if was_open:
            self.open(now)
        if ended is not None:
            self.set(ended, False, now)

    def advance(self, now: int) -> None:
        """Report delayed emergencies in order, and send those that the inhibit time permits."""
        if self._delayed_since != NEVER:
            self._report_delayed()
            self._end(now)
        self._send_pending(now)

    def _report_delayed(self) -> None:
        """Report the delayed emergencies, and sort the history, by the times of the errors."""
        now = self._delayed_since
        self._delayed_since = NEVER
        delayed = sorted(self._delayed, key=itemgetter(0))
        if delayed != self._delayed:
            self._sort_newest([condition for _, condition, _ in delayed])
        self._delayed = []
        if delayed:
            self._pending += [(condition, data) for _, condition, data in delayed]
            self._send_pending(now)

    def _sort_newest(self, conditions: Sequence[PresentError]) -> None:
        """Put the newest entries of 1003h, and the present errors, into this order."""
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
            cob_id = self.cob_id
            if not (cob_id & INVALID_BIT or self.is_quiet):
                self._send(cob_id & 0x7FF, data)
                self._is_last_an_error = condition is not None
                self._last_ns = now

    def _begin(self, condition: PresentError, now: int, at: int | None) -> None:
        self._active[condition] = None
        self._has_had_error = True
        self._note(condition)
        if self._delayed_since != NEVER:
            happened_ns = now if at is None else at
            self._delayed.append((happened_ns, condition, self._data_of(condition)))
        elif self._is_open:
            self._report(condition)
            self._send_pending(now)
        else:
            self._unreported[condition] = None

    def _note(self, condition: PresentError) -> None:
        entry = condition.detail << 24 | condition.source << 16 | condition.code
        self.history.appendleft(entry)

    def _end(self, now: int) -> None:
        """Report 0000h if errors were reported or are pending, and all have ended."""
        if self._delayed_since != NEVER:
            return
        is_error_last = self._is_last_an_error
        if self._pending:
            condition, _ = self._pending[-1]
            is_error_last = condition is not None
        if is_error_last and self._is_open and not self._active:
            self._report(None)
            self._send_pending(now)

    def _report(self, condition: PresentError | None) -> None:
        # a full queue drops its oldest entry
        self._pending.append((condition, self._data_of(condition)))

    def _data_of(self, condition: PresentError | None) -> bytes:
        if condition is None:
            return _DATA.pack(0, self.register, FROM_GATEWAY, 0)
        code, source, detail = condition
        detail_or_word = detail if source == FROM_GATEWAY else self._word
        return _DATA.pack(code, self.register, source, detail_or_word)

    # --- objects

    def _read_history(self, number: int, _now: int) -> int:
        if number > len(self.history):
            raise SdoAbort(Abort.NO_DATA)
        return self.history[number - 1]

    def _check_cob_id(self, value: int) -> None:
        """Check a new 1014h.

        SdoAbort 06090030h for a 29-bit or restricted id, and for another id while the present one
        is valid. SdoAbort 06040043h for an id in use.
        """
        old = self.cob_id
        is_valid = not value & INVALID_BIT
        was_valid = not old & INVALID_BIT
        if value & 0x7FFFF800 or (is_valid and was_valid and old != value):
            raise SdoAbort(Abort.VALUE)
        if is_valid:
            check_free(value & 0x7FF, self, self._taken)
