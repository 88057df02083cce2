"""What is reported of one ESC: its measurements, which the core sends while they are fresh, and the errors that begin and end."""

import re
from collections.abc import Callable, Iterator
from typing import Any

from kontronik_can_gw.dronecan import types
from kontronik_can_gw.dronecan.measured import fill, plans_of
from kontronik_can_gw.dronecan.transport import LOW, message_id
from kontronik_can_gw.esc.decoder import ErrorBit, Severity
from kontronik_can_gw.esc.telemetry import SECOND, EscTelemetry, Event
from kontronik_can_gw.esc.values import steps_of, values_of
from kontronik_can_gw.frames import FIRST_PART, PARTS
from kontronik_can_gw.slots import Slot, SlotSettings

SPEEDS = {"motor": "motor_speed", "output": "output_speed", "electrical": "electrical_speed"}
"""Key ``rpm`` of the configuration to the value that is sent."""
_QUIET_NS = 10 * SECOND
"""A bit is logged at most this often."""
_PARTS = re.compile(rf"\S(?:.{{0,{types.MAX_TEXT - 1}}}(?!\S)|.{{0,{types.MAX_TEXT - 1}}})")
"""A text in parts that end with a word, where there is one; textwrap would be loaded for this alone."""
_LEVELS = {Severity.ERROR: 3, Severity.WARNING: 2}


class EscReport:
    """One ESC with its index on the bus. ``table``: of the configuration."""

    def __init__(self, esc: EscTelemetry, index: int, table: Any) -> None:
        self.esc = esc
        self.index = index
        self._rates = {
            types.STATUS: table.rate_hz,
            types.STATUS_EXTENDED: table.extended_hz,
            types.CIRCUIT_STATUS: 1,
            types.TEMPERATURE: 1,
        }
        self._plans = plans_of(esc.protocol, SPEEDS[table.rpm])
        self._slots: dict[types.DataType, Slot] = {}
        self._node_id = self._page = 0
        values = values_of(esc.protocol)
        self._word, self._speed = values["operating_errors"], values["electrical_speed"]
        self._bits = [
            bit
            for bit in esc.protocol.errors.get("operating_errors", ())
            if bit.severity in _LEVELS and not bit.is_summary
        ]
        self._errors = sum(1 << bit for bit in self._bits if bit.severity is Severity.ERROR)
        self._before = self._logged = self._onsets = 0
        self._turns = False
        self._quiet_until: dict[int, int] = {}

    # --- measurements

    def take_slots(self, slot: Callable[[int], Slot], number: int) -> None:
        """``number``: of the ESC."""
        self._slots = {kind: slot(number) for kind in self._plans if self._rates[kind]}

    def start(self, node_id: int, place: int, now: int) -> None:
        """Send measurements as this node; ``place`` of the ESC among its."""
        self._node_id, self._page = node_id, FIRST_PART + PARTS * place
        self._configure(now)
        for slot in self._slots.values():
            slot.start(now)

    def stop(self) -> None:
        """Send none any more."""
        for slot in self._slots.values():
            slot.stop()

    @property
    def status_sent(self) -> int:
        """esc.Status so far."""
        slot = self._slots.get(types.STATUS)
        return 0 if slot is None else slot.sent

    def _configure(self, now: int) -> None:
        for kind, slot in self._slots.items():
            period = SECOND // self._rates[kind]
            can_id = message_id(kind.number, self._node_id, LOW)
            bits = fill(kind, self.index, self._onsets)
            times = period * 3 // 4, period * 5 // 4
            slot.configure(
                SlotSettings(self._plans[kind], can_id, True, *times, bits, self._page), now
            )

    # --- errors

    @property
    def word(self) -> int:
        """The operating errors; 0 while they are not known."""
        return steps_of(self._word, self.esc, self.esc.live) or 0

    @property
    def health(self) -> int:
        """Of the ESC, as NodeStatus has it."""
        word = self.word
        if word & self._errors:
            return types.ERROR
        is_well = self.esc.up and not any(word >> bit & 1 for bit in self._bits)
        return types.OK if is_well else types.WARNING

    def follow(self, events: int, now: int) -> None:
        """Count errors that begin; not those of the link's return, which may be old. ``events``: bits of Event, or each second none."""
        onsets, word = self._onsets, self.word
        if self.esc.up:
            turns = bool(steps_of(self._speed, self.esc, self.esc.live))
            if turns and not self._turns:
                self._onsets = 0  # errors since the motor was started
            self._turns = turns
        if not events & Event.LINK:
            self._onsets += (word & ~self._before & self._errors).bit_count()
        self._before = word
        if self._onsets != onsets and self._node_id:
            self._configure(now)

    def log(self, now: int) -> Iterator[bytes]:
        """LogMessages of an error or warning that has begun or ended; of one at a time, and none of what is not known now."""
        if not self.esc.up:
            return
        word = self.word
        for bit in self._bits:
            mask = 1 << bit
            if (word ^ self._logged) & mask and now >= self._quiet_until.get(bit, 0):
                self._logged ^= mask
                self._quiet_until[bit] = now + _QUIET_NS
                yield from self._texts(bit, bool(word & mask))
                return

    def log_anew(self) -> None:
        """Log what is on once more: what was logged may never have reached the bus."""
        self._logged = 0

    def _texts(self, bit: ErrorBit, begins: bool) -> Iterator[bytes]:
        name = self.esc.settings.name
        level, text = _LEVELS[bit.severity], f"{name}: {bit.meaning}. {bit.remedy}"
        if not begins:
            level, text = 1, f"{name}: over: {bit.meaning}"
        source = name.encode("ascii", "replace")
        head = types.LOG_MESSAGE.pack(level << 5 | len(source)) + source
        for part in _PARTS.findall(text):
            yield head + part.encode("ascii", "replace")
