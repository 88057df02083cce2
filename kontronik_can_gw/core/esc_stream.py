"""One ESC's stream in plain Python: takes bytes and time, keeps the ESC's state, returns events.

Arrival times. ``since`` of a read is a time at which none of its bytes had arrived yet, and bytes
follow one another on the wire. So byte k of a read (1, 2, ...) arrived no earlier than ``since``
plus k - 1 byte times. This time is called the bound.

1. Timeouts count from the bound. So no value outlives its timeout, however late it is read.
2. Ages, energy and run time count from the estimated arrival. It is the time of the read minus the
   wire time of the bytes after the frame. If this estimate is later than the bound by more than the
   usual interval between frames, they count from the bound, too. So an age is shown at most one
   interval too low.

An adapter that bundles bytes delays them further: by 1 ms, or by 16 ms if that cannot be set.
"""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from copy import copy
from typing import Any, Self

from kontronik_can_gw.esc.decoder import Counters, Data, Decoder, Reading
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import (
    INFO_TIMEOUT_NS,
    EscSettings,
    EscTelemetry,
    Event,
    LinkState,
)
from kontronik_can_gw.times import NEVER, SECOND

_DEGRADED_BYTES_PER_DROPPED = 10
"""A link is degraded if more than one byte in this many is dropped."""
_MOST_FRAMES = 100_000_000
"""The rate counts at most so many live frames in a second. The core in C has the same limit, so
that the rate stays in 32 bits."""


class EscStream(EscTelemetry):
    """The byte stream of one ESC and the state computed from it."""

    def __init__(self, settings: EscSettings, now: int) -> None:
        self.protocol = protocol_named(settings.protocol)
        self.decoder: Decoder = self.protocol.make()
        fields = self.protocol.by_name
        words = {name: field.word for name, field in fields.items()}
        self._errors_word = words.get("operating_errors")
        self._speed_word = words.get("electrical_speed")
        factors = [
            fields[name] for name in ("battery_voltage", "battery_current") if name in fields
        ]
        self._power_words: list[int] | None = None
        if len(factors) == 2:
            self._power_words = [factor.word for factor in factors]
        self._steps_per_watt = math.prod(factor.per_unit for factor in factors)
        self.apply(settings)
        self.base: Counters = self.counters.copy()
        self._arrivals: deque[tuple[int, int]] = deque()
        """The reads whose last bytes are not decoded yet: the end of each as a stream position, and
        the bound of its last byte. The first one tells how old a part of a frame is.
        """
        self._interval_ns = 0
        """Usual interval between live frames. 0: unknown."""
        self._window_ns = now
        """Start of the current window of rate and quality."""
        self._window_counts = _window_counts(self.base)
        """Live frames, dropped bytes, bytes and CRC errors at its start."""

    @property
    def counters(self) -> Counters:
        """Counters of the whole stream. The decoder keeps changing this object."""
        counters: Counters = self.decoder.counters
        return counters

    def frozen(self) -> Self:
        twin = copy(self)
        decoder: Any = copy(self.decoder)
        decoder.counters = self.counters.copy()
        twin.decoder = decoder
        return twin

    @property
    def window(self) -> list[int]:
        rate = -1 if self.frame_rate is None else self.frame_rate
        return [self._window_ns, *self._window_counts, rate, self._interval_ns]

    def set_window(self, window: Sequence[int]) -> None:
        self._window_ns, frames, dropped, received, crc_errors, rate, self._interval_ns = window
        self._window_counts = (frames, dropped, received, crc_errors)
        self.frame_rate = None if rate < 0 else rate

    @property
    def held_bytes(self) -> int:
        return self.decoder.pending

    def set_counters(self, counters: Any) -> None:
        shift = counters.bytes - self.counters.bytes
        self.decoder.adopt_counters(counters)
        self._arrivals = deque([(end + shift, bound) for end, bound in self._arrivals])

    def apply(self, settings: EscSettings) -> None:
        super().apply(settings)
        self._update_cells()

    def receive_each(self, data: bytes, now: int, since: int) -> Iterator[int]:
        """Take bytes that were read at ``now`` and all arrived after ``since``.

        Yields the events of one frame after another; meanwhile the state is the state after that
        frame. Iterate to the end, otherwise the remaining frames are lost. Call ``expire`` first:
        this method does not drop values that are too old at ``now``. A pending part of a frame is
        given up if it is older than the timeout.
        """
        decoder = self.decoder
        arrivals = self._arrivals
        byte_ns = self.protocol.byte_ns
        timeout = self.settings.timeout_ns
        if arrivals and now - arrivals[0][1] > timeout:
            self.late_frames += len(decoder.flush())
            arrivals.clear()
        # A pseudo terminal is faster than the wire.
        bound = min(since + (len(data) - 1) * byte_ns, now)
        readings = decoder.feed(data, now)
        end = decoder.counters.bytes
        if pending := decoder.pending:
            arrivals.append((end, bound))
            while arrivals[0][0] <= end - pending:
                arrivals.popleft()
        else:
            arrivals.clear()
        shown = bound
        if now - bound <= self._interval_ns:
            shown = now
        for reading in readings:
            form, offset, _ = reading
            after_ns = (end - offset - form.length) * byte_ns
            if now - bound + after_ns > (INFO_TIMEOUT_NS if form.is_info else timeout):
                # More bytes followed it in the same read than its timeout permits.
                self.late_frames += 1
            else:
                yield self.accept(reading, shown - after_ns, bound - after_ns)
        if self.link is LinkState.NEVER_SEEN:
            yield self._set_link(LinkState.SEARCHING)

    def port_opened(self) -> int:
        """Note that the port was opened, for the first time or again. Return the events."""
        if self.link is not LinkState.PORT_ERROR:
            return Event.NONE
        return self._set_link(LinkState.NEVER_SEEN if self.live_ns is None else LinkState.LOST)

    def port_lost(self) -> int:
        """Note that the port was lost: drop pending bytes and all fresh data. Return the events."""
        self.decoder.flush()
        self._arrivals.clear()
        return self._lose(LinkState.PORT_ERROR)

    def advance(self, now: int) -> int:
        """Let time pass: drop expired data, and update rate and link quality once a second.

        Returns the events. A call before ``next_deadline`` changes nothing. After a late call the
        rate is computed over the longer time.
        """
        events = self.expire(now)
        if now - self._window_ns >= SECOND:
            events |= self._close_window(now)
        return events

    def expire(self, now: int) -> int:
        """Drop live and info data that is too old at ``now``. Return the events."""
        events = Event.NONE
        if self.live is not None and now > self.live_until_ns:
            events |= self._lose(LinkState.LOST)
        if self.info_bound_ns is not None and now - self.info_bound_ns > INFO_TIMEOUT_NS:
            self._forget_device()
            events |= Event.INFO
        return events

    def next_deadline(self) -> int:
        """Return the time of the next call of ``advance`` that can change anything."""
        return min(self._window_ns + SECOND, self.expiry())

    def expiry(self) -> int:
        """Return the time at which live or info data expire, or NEVER."""
        deadline = NEVER
        if self.live is not None:
            deadline = min(deadline, self.live_until_ns + 1)
        if self.info_bound_ns is not None:
            deadline = min(deadline, self.info_bound_ns + INFO_TIMEOUT_NS + 1)
        return deadline

    def accept(self, reading: Reading, when: int, bound: int) -> int:
        """Take a reading and return the events.

        ``when`` is its arrival as ages count it, ``bound`` its earliest possible arrival.
        """
        form, _, data = reading
        events = Event.NONE
        if form.layout_number != self.layout:
            self.layout = form.layout_number
            self._forget_device()
            # The old data is from another device.
            self.last_live = None
            self.last_info = None
            self.last_info_ns = None
            self.device = None
            events = Event.INFO | Event.LINK
        if form.is_info:
            return events | self._accept_info(data, when, bound)
        self.suspect_frames += reading.is_suspect
        live = self.live
        before = self.live_ns
        if before is not None:
            # Neither time moves backwards.
            when = max(when, before)
            bound = max(bound, self.live_bound_ns)
            if live is not None:
                self._integrate(live, when - before)
        word = self._errors_word
        if word is not None and (live is None or live[word] != data[word]):
            events |= Event.STATE
        self.live = data
        self.last_live = data
        self.live_ns = when
        self.live_bound_ns = bound
        if self.link not in (LinkState.OK, LinkState.DEGRADED):
            events |= self._set_link(LinkState.OK)
            self.frame_rate = None
            self._interval_ns = 0
            self._window_ns = when
            self._window_counts = _window_counts(self.counters)
        return events | Event.LIVE

    def _integrate(self, live: Data, ns: int) -> None:
        """Add the energy and run time of the ``ns`` after the reading ``live``.

        Its power and speed count until the next reading. Regeneration does not reduce the energy.
        """
        if self._power_words is not None:
            voltage_word, current_word = self._power_words
            power = live[voltage_word] * live[current_word]
            if power > 0:
                self.energy_mw_ns += power * ns * 1000 // self._steps_per_watt
        if self._speed_word is not None and live[self._speed_word]:
            self.run_time_ns += ns

    def _accept_info(self, data: Data, when: int, bound: int) -> int:
        old = self.info
        self.info = data
        self.last_info = data
        self.last_info_ns = when
        self.info_bound_ns = bound
        self._update_cells()
        self.device = self.protocol.value("device_raw", data)
        if old is None:
            return Event.INFO | Event.STATE
        value = self.protocol.value
        for name in ("device_raw", "variant"):
            if value(name, data) != value(name, old):
                return Event.INFO | Event.LINK | Event.STATE
        return Event.INFO

    def _update_cells(self) -> None:
        """Use the configured number of cells, or else the number in fresh info data."""
        reported = self.protocol.value("cell_count", self.info) or 0
        self.cells = self.settings.cell_count or reported

    def _forget_device(self) -> None:
        self.info = None
        self.info_bound_ns = None
        self._update_cells()

    def _lose(self, state: LinkState) -> int:
        """Drop all fresh data and set the link to ``state``. Return the events."""
        events = self._set_link(state)
        if self.live is not None:
            self.live = None
            self.losses += 1
            events |= Event.LIVE
        if self.info is not None:
            self._forget_device()
            events |= Event.INFO
        self.frame_rate = 0
        return events

    def _set_link(self, state: LinkState) -> int:
        if state is self.link:
            return Event.NONE
        self.link = state
        return Event.LINK

    def _close_window(self, now: int) -> int:
        """Compute rate, interval and link quality since the last call. Return the events."""
        old_frames, old_dropped, old_bytes, old_crc_errors = self._window_counts
        new = self.counters
        window_ns = now - self._window_ns
        self._window_ns = now
        self._window_counts = _window_counts(new)
        self.frame_rate = 0
        self._interval_ns = 0
        if not self.up:
            return Event.SECOND
        frames = new.live - old_frames
        counted = min(frames, _MOST_FRAMES)
        # In 0.1 frames per second, rounded.
        self.frame_rate = (20 * SECOND * counted + window_ns) // (2 * window_ns)
        if frames:
            self._interval_ns = window_ns // frames
        crc_errors = new.crc_errors - old_crc_errors
        dropped = new.dropped_bytes - old_dropped
        received = new.bytes - old_bytes
        has_crc_errors = crc_errors >= self.settings.crc_error_threshold
        has_gaps = dropped * _DEGRADED_BYTES_PER_DROPPED > received
        is_degraded = has_crc_errors or has_gaps
        return Event.SECOND | self._set_link(LinkState.DEGRADED if is_degraded else LinkState.OK)


def _window_counts(counters: Counters) -> tuple[int, int, int, int]:
    return counters.live, counters.dropped_bytes, counters.bytes, counters.crc_errors
