"""Notices the events for which a capture is recorded.

Both cores call ``_follow`` with each change. An error bit is therefore an event even if it is set
in a single frame, and so is a limit that a single frame crosses. Without conditions about live data
there is no call for a live frame that changes nothing else.
"""

import time
from collections.abc import Callable, Sequence

from kontronik_can_gw.config.conditions import Condition, condition
from kontronik_can_gw.config.keys import RecordConfig
from kontronik_can_gw.core.interface import Follower
from kontronik_can_gw.esc.decoder import ErrorBit, Severity, bit_texts
from kontronik_can_gw.esc.telemetry import EscTelemetry, Event
from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.esc.values import Group, Value, physical, steps, values_of
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.times import SECOND

OnEvent = Callable[[int, float, str, str], None]
"""Takes monotonic time in ns, Unix time in seconds, name of the ESC, and the reason."""
_WORDS = ("operating_errors", "selftest_errors")
_ALL_BITS = -1
_REARM_NS = SECOND
"""Time for which a condition must be unmet, or a bit clear, before it can be an event again."""


class EventWatch:
    """Watches the ESCs of a gateway. It only reads."""

    def __init__(
        self,
        gateway: Gateway,
        config: RecordConfig,
        on_event: OnEvent,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self._status = gateway.status
        self._on_event = on_event
        self._wall = wall
        self._escs = [_WatchedEsc(esc, config) for esc in gateway.escs]
        events = Event.LINK | Event.STATE | Event.INFO
        for esc in self._escs:
            for limit in esc.limits:
                events |= limit.events
        follower = Follower(events, self._follow)
        gateway.core.followers = [*gateway.core.followers, follower]

    def _follow(self, index: int, events: int, now: int) -> None:
        esc = self._escs[index]
        reasons = []
        if events & Event.LINK and esc.has_lost_telemetry():
            reasons.append("telemetry lost")
            esc.forget_values()
        if events & (Event.STATE | Event.INFO):
            reasons += esc.new_errors(now)
        for limit in esc.limits:
            is_known = esc.was_heard or limit.value.group is not Group.LINK
            if events & limit.events and is_known:
                count = steps(limit.value, esc.state, self._status, now)
                if limit.is_crossed(physical(limit.value, esc.state, count), now):
                    reasons.append(limit.condition.text)
        for reason in reasons:
            self._on_event(now, self._wall(), esc.state.settings.name, reason)


class _Limit:
    """A condition about one ESC."""

    def __init__(self, about: Condition, value: Value) -> None:
        self.condition = about
        self.value = value
        self.events = _EVENTS[value.pace or value.group]
        """Events that may change the value."""
        self.forget()

    def forget(self) -> None:
        """Begin again: the next value is the first one that is known."""
        self._is_armed = False
        self._rearm_ns = 0
        """Time for which the condition must be unmet before it can be an event."""
        self._unmet_since: int | None = None

    def is_crossed(self, number: float | None, now: int) -> bool:
        """Return True if the condition is met, and was unmet before.

        After it was met, it must be unmet for a second, so a value that is noisy at its limit makes
        one event. A value that is not available changes nothing.
        """
        if number is None:
            return False
        if not self.condition.compare(number, self.condition.limit):
            if self._unmet_since is None:
                self._unmet_since = now
            if now - self._unmet_since >= self._rearm_ns:
                self._is_armed = True
            return False
        was_armed = self._is_armed
        self._is_armed = False
        self._rearm_ns = _REARM_NS
        self._unmet_since = None
        return was_armed


_EVENTS = {
    Group.LIVE: Event.LIVE,
    Group.INFO: Event.INFO,
    Group.LINK: Event.LINK | Event.SECOND,
}


class _Bits:
    """The error bits of a word."""

    def __init__(self, bits: Sequence[ErrorBit], chosen: Sequence[str]) -> None:
        self._bits = bits
        self._mask = _mask(bits, chosen)
        self._word = 0
        self._clear_since: dict[int, int] = {}
        """Time of the last change to 0, by number of the bit."""

    def risen(self, word: int, now: int) -> list[str]:
        """Return the texts of the bits that are set now, and were clear for a second before.

        So a bit that flickers makes one event.
        """
        changed = word ^ self._word
        self._word = word
        risen = 0
        for number in range(changed.bit_length()):
            bit = 1 << number
            if changed & bit and not word & bit:
                self._clear_since[number] = now
            elif changed & bit & self._mask:
                since = self._clear_since.get(number)
                if since is None or now - since >= _REARM_NS:
                    risen |= bit
        return bit_texts(risen, self._bits)


class _WatchedEsc:
    """One ESC, with its last words of error bits and the state of its conditions."""

    def __init__(self, state: EscTelemetry, config: RecordConfig) -> None:
        self.state = state
        self.limits = []
        name = normalize(state.settings.name)
        for text in config.when:
            about = condition(text)
            if about.esc in ("", name):
                value = values_of(state.protocol)[about.value.name]
                self.limits.append(_Limit(about, value))
        errors = state.protocol.errors
        self._words = [_Bits(errors.get(word, ()), config.errors) for word in _WORDS]
        self._had_telemetry = False
        self.was_heard = False
        """True after the first live data."""

    def has_lost_telemetry(self) -> bool:
        """Return True if live data has expired since the last call."""
        had_telemetry = self._had_telemetry
        self._had_telemetry = self.state.up
        self.was_heard |= self.state.up
        return had_telemetry and not self._had_telemetry

    def forget_values(self) -> None:
        """Forget the values that become unknown with a loss of telemetry."""
        for limit in self.limits:
            if limit.value.group is not Group.LINK:
                limit.forget()

    def new_errors(self, now: int) -> list[str]:
        """Return the texts of the error bits that have been set since the last call.

        While a word is not available, its bits keep their state.
        """
        texts = []
        for place, reading in enumerate((self.state.live, self.state.info)):
            word = self.state.protocol.value(_WORDS[place], reading)
            if word is not None:
                texts += self._words[place].risen(word, now)
        return texts


def _mask(bits: Sequence[ErrorBit], chosen: Sequence[str]) -> int:
    """Return the bits of a word that are in ``chosen``: names of bits, or severities.

    A bit without a name is an error.
    """
    mask = 0
    if Severity.ERROR.value in chosen:
        mask = _ALL_BITS
    for bit in bits:
        is_chosen = bit.text in chosen or bit.severity.value in chosen
        if is_chosen:
            mask |= 1 << bit
        else:
            mask &= ~(1 << bit)
    return mask
