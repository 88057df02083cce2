"""One ESC's stream in plain Python: bytes and time in, its state and events out.

Arrival. No byte of a read came before ``since``, and on the wire one byte follows another: byte k of a read (1 ...) came at
``since`` + (k - 1) byte times at the earliest. Time-outs count from there (the bound): nothing outlives its time-out, however late
it is read. Ages, energy and run time count from the time of the read, less the bytes that came after the frame, unless that is
more than the link's usual interval after the bound: then from the bound, too. So an age shown is never smaller than the truth by more than
one interval. An adapter that bundles bytes adds what it holds them back for (1 ms; 16 ms where that cannot be set).
"""

import math
from collections import deque
from collections.abc import Iterator
from copy import copy
from typing import Any, Self

from kontronik_can_gw.esc.decoder import Counters, Data, Decoder, Reading
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import (
    INFO_TIMEOUT_NS,
    SECOND,
    EscSettings,
    EscTelemetry,
    Event,
    LinkState,
)

_DEGRADED_DROPPED_SHARE = 10  # one byte dropped in ten received
# An enumeration's members are slow to look up.
_NEVER_SEEN, _OK, _DEGRADED = LinkState.NEVER_SEEN, LinkState.OK, LinkState.DEGRADED


class EscStream(EscTelemetry):
    """One ESC's stream and what is known from it."""

    def __init__(self, settings: EscSettings, now: int) -> None:
        self.protocol = protocol_named(settings.protocol)
        self.decoder: Decoder = self.protocol.make()
        fields = self.protocol.by_name
        words = {name: field.word for name, field in fields.items()}
        self._errors_at = words.get("operating_errors")
        self._speed_at = words.get("electrical_speed")
        parts = [fields[name] for name in ("battery_voltage", "battery_current") if name in fields]
        self._power_at = [part.word for part in parts] if len(parts) == 2 else None
        self._per_watt = math.prod(part.per_unit for part in parts)
        self.apply(settings)
        self.base: Counters = self.counters.copy()
        self._arrivals: deque[tuple[int, int]] = deque()
        """(stream position after a chunk, the bound of its last byte) while bytes are pending."""
        self._interval_ns = 0  # between live frames, as usual; 0: not known
        self._window_ns = now
        self._window_counters = self.base

    @property
    def counters(self) -> Counters:
        """Counters of the whole stream so far."""
        found: Counters = self.decoder.counters
        return found

    def frozen(self) -> Self:
        twin = copy(self)
        decoder: Any = copy(self.decoder)
        decoder.counters = self.counters.copy()
        twin.decoder = decoder
        return twin

    def apply(self, settings: EscSettings) -> None:
        super().apply(settings)
        self.cells = settings.cell_count or self.protocol.value("cell_count", self.info) or 0

    def receive_each(self, data: bytes, now: int, since: int) -> Iterator[int]:
        """Take bytes that were read at ``now`` and came after ``since``; the events of each frame in turn: iterate to the end.

        What is too old by ``now`` was expired before (``expire``). An unfinished frame older than the time-out is given up first.
        """
        decoder, arrivals = self.decoder, self._arrivals
        byte_ns = self.protocol.byte_ns
        timeout = self.settings.timeout_ns
        if arrivals and now - arrivals[0][1] > timeout:
            self.late_frames += len(decoder.flush())
            arrivals.clear()
        bound = since + (len(data) - 1) * byte_ns
        if bound > now:  # a pseudo terminal is faster than the wire
            bound = now
        readings = decoder.feed(data, now)
        end = decoder.counters.bytes
        if pending := decoder.pending:
            arrivals.append((end, bound))
            while arrivals[0][0] <= end - pending:
                arrivals.popleft()
        elif arrivals:
            arrivals.clear()
        shown = now if now - bound <= self._interval_ns else bound
        for reading in readings:
            form, offset, _ = reading
            after = (end - offset - form.length) * byte_ns
            if now - bound + after > (INFO_TIMEOUT_NS if form.is_info else timeout):
                # the bytes after it in the same read make it old already
                self.late_frames += 1
            else:
                yield self.accept(reading, shown - after, bound - after)
        if self.link is _NEVER_SEEN:
            yield self._set_link(LinkState.SEARCHING)

    def port_opened(self) -> int:
        """The port is open (again)."""
        if self.link is not LinkState.PORT_ERROR:
            return Event.NONE
        return self._set_link(LinkState.NEVER_SEEN if self.live_ns is None else LinkState.LOST)

    def port_lost(self) -> int:
        """The port is gone: what was pending is dropped, nothing is fresh any more."""
        self.decoder.flush()
        self._arrivals.clear()
        return self._lose(LinkState.PORT_ERROR)

    def advance(self, now: int) -> int:
        """Let time pass: expire what is old, close the one-second window of rate and quality."""
        events = self.expire(now)
        if now - self._window_ns >= SECOND:
            events |= self._close_window(now)
        return events

    def expire(self, now: int) -> int:
        """What is too old by ``now`` is not available any more."""
        events = Event.NONE
        if self.live is not None and now - self.live_bound_ns > self.settings.timeout_ns:
            self.losses += 1
            events |= self._lose(LinkState.LOST)
        if self.info_bound_ns is not None and now - self.info_bound_ns > INFO_TIMEOUT_NS:
            self._forget_device()
            events |= Event.INFO
        return events

    def next_deadline(self) -> int:
        """When ``advance`` has something to do."""
        deadline = self._window_ns + SECOND
        if self.live is not None:
            deadline = min(deadline, self.live_bound_ns + self.settings.timeout_ns + 1)
        if self.info_bound_ns is not None:
            deadline = min(deadline, self.info_bound_ns + INFO_TIMEOUT_NS + 1)
        return deadline

    def accept(self, reading: Reading, when: int, bound: int) -> int:
        """Take a reading that came at ``when``, at ``bound`` at the earliest (see Arrival); its events."""
        form, _, data = reading
        events = Event.NONE
        if form.layout_number != self.layout:
            self.layout = form.layout_number
            self._forget_device()
            self.last_live = self.last_info = self.device = None  # of another device
            self.last_info_ns = None
            events = Event.INFO | Event.LINK
        if form.is_info:
            return events | self._accept_info(data, when, bound)
        if reading.suspect:
            self.suspect_frames += 1
        if (before := self.live_ns) is not None:
            if when < before:
                when = before
            if bound < self.live_bound_ns:
                bound = self.live_bound_ns
            if self.live is not None:
                self._draw(self.live, when - before)
        at, live = self._errors_at, self.live
        if at is not None and (live is None or live[at] != data[at]):
            events |= Event.STATE
        self.live = self.last_live = data
        self.live_ns, self.live_bound_ns = when, bound
        if self.link is not _OK and self.link is not _DEGRADED:
            events |= self._set_link(_OK)
            self.frame_rate = None
            self._interval_ns = 0
            self._window_ns = when
            self._window_counters = self.counters.copy()
        return events | Event.LIVE

    def _draw(self, live: Data, ns: int) -> None:
        """Between two readings the power, and whether the motor turns, are those of the first. Regeneration does not count."""
        if self._power_at is not None:
            voltage, current = self._power_at
            power = live[voltage] * live[current]
            if power > 0:
                self.energy_mw_ns += power * ns * 1000 // self._per_watt
        if self._speed_at is not None and live[self._speed_at]:
            self.run_time_ns += ns

    def _accept_info(self, data: Data, when: int, bound: int) -> int:
        value, old = self.protocol.value, self.info
        another = old is not None and any(
            value(name, data) != value(name, old) for name in ("device_raw", "variant")
        )
        self.info = self.last_info = data
        self.last_info_ns, self.info_bound_ns = when, bound
        self.cells = self.settings.cell_count or value("cell_count", data) or 0
        self.device = value("device_raw", data)
        if another:
            return Event.INFO | Event.LINK | Event.STATE
        return Event.INFO | Event.STATE if old is None else Event.INFO

    def _forget_device(self) -> None:
        self.info = None
        self.info_bound_ns = None
        self.cells = self.settings.cell_count

    def _lose(self, state: LinkState) -> int:
        events = self._set_link(state)
        if self.live is not None:
            self.live = None
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
        old, new = self._window_counters, self.counters
        frames = new.live - old.live
        length = now - self._window_ns
        self.frame_rate = (20 * SECOND * frames + length) // (2 * length) if self.up else 0
        self._interval_ns = length // frames if self.up and frames else 0
        dropped, received = new.dropped_bytes - old.dropped_bytes, new.bytes - old.bytes
        bad = (
            new.crc_errors - old.crc_errors >= self.settings.crc_error_threshold
            or dropped * _DEGRADED_DROPPED_SHARE > received
        )
        self._window_ns = now
        self._window_counters = new.copy()
        if self.up:
            return Event.SECOND | self._set_link(LinkState.DEGRADED if bad else LinkState.OK)
        return Event.SECOND
