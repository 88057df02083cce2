"""The gateway or an ESC as it is published: topics, content of its messages and their timing.

No I/O, no clock: time is an argument.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from kontronik_can_gw.desk.member import Alarm, Member
from kontronik_can_gw.desk.receiver.view import View
from kontronik_can_gw.esc.decoder import Severity
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.times import MS, SECOND

MIN_PAUSE_NS = 200 * MS
"""Minimum time between two states of a member that are published because of a change."""
SILENCE_NS = 3 * SECOND
"""The gateway is not available after this time without a frame."""
_FIRST_NS = SECOND // 2
"""Delay of the first state, in which the first frames of all messages can arrive."""


@dataclass(frozen=True)
class Topics:
    """The topics of one gateway. An empty ``esc`` stands for the gateway itself."""

    prefix: str
    gateway: str

    def of(self, *levels: str) -> str:
        """Return a topic of this gateway. Empty levels are left out."""
        path = (self.prefix, self.gateway, *levels)
        return "/".join(filter(None, path))

    def discovery(self, prefix: str, esc: str = "") -> str:
        """Return the topic of a device's discovery below Home Assistant's ``prefix``."""
        return f"{prefix}/device/{self.identifier(esc)}/config"

    def identifier(self, esc: str = "") -> str:
        """Return Home Assistant's identifier of a device. It depends on the two names only."""
        words = ("kontronik", self.gateway, esc)
        return "_".join(filter(None, words))


class Published(Member):
    """The gateway or an ESC, with the content of its messages and their timing."""

    def __init__(self, view: View, settings: EscSettings | None, index: int | None) -> None:
        super().__init__(view, settings, index)
        all_values = list(self.no_flags.values())
        self.signs = self.of_group[Group.LIVE] or all_values
        """Columns whose values prove that telemetry is received.

        They are the live values, or all values if the DBC has no live ones.
        """
        self.heard_ns: int | None = None
        """Time of the newest value in these columns."""
        self.identity: tuple[str | None, str | None] | None = None
        """Device and firmware of the published discovery."""
        states = self.protocol.states.values()
        self._kinds = {normalize(state.text): state.kind for state in states}
        """Kind of each operating state by its name."""
        self._due: int | None = None
        """Time of the next state at the fixed rate. None before the first call of ``is_due``."""
        self._published_notable: tuple[object, ...] | None = None
        """The notable values in the last published state."""
        self._published_ns = 0

    def is_available(self, now: int) -> bool:
        """Return True while frames of the gateway, or values of the ESC, are received."""
        if self.index is None:
            last = self.view.last_ns
            return last is not None and now - last <= SILENCE_NS
        return any(self.view.values[at] is not None for at in self.signs)

    def is_due(self, now: int, period: int) -> bool:
        """Return True if the state must be published now: at the rate, or after a notable change.

        The caller must publish it then, because the next call counts from it. ``period`` is in ns.
        """
        if self._due is None:
            self._due = now + _FIRST_NS
        notable = self._notable(now)
        if now >= self._due:
            # The times form a fixed grid. Missed times are skipped.
            missed = (now - self._due) // period
            self._due += period * (missed + 1)
        else:
            has_changed = self._published_notable not in (None, notable)
            if not has_changed or now - self._published_ns < MIN_PAUSE_NS:
                return False
        self._published_notable = notable
        self._published_ns = now
        return True

    def _notable(self, now: int) -> tuple[object, ...]:
        """Return the values whose change is published at once."""
        is_available = self.is_available(now)
        if self.index is None:
            return is_available, self.value("can_state"), self.value("gateway_state")
        return (
            is_available,
            self.flags("operating_errors"),
            self.flags("selftest_errors"),
            self._kind_of_state(),
            self.value("link_state"),
        )

    def document(self, now: int) -> dict[str, Any]:
        """Return the content of the state: all values, and their age in ms."""
        heard_ns = self.view.last_ns if self.index is None else self.heard_ns
        found: dict[str, Any] = {
            "available": self.is_available(now),
            "age": None if heard_ns is None else (now - heard_ns) // MS,
        }
        values = {source: self.value(source) for source in self.no_flags}
        if self.index is None:
            return found | values
        errors = self.flags("operating_errors")
        found["motor"] = self._kind_of_state()
        found["errors"] = _describe(errors)
        found["problem"] = None
        if errors is not None:
            found["problem"] = Severity.ERROR in {error.severity for error in errors}
        found["selftest"] = _describe(self.flags("selftest_errors"))
        found["link_state"] = None  # present even if the DBC has no signal for it
        found |= values
        found["firmware"] = self.firmware
        return found

    def update_identity(self) -> bool:
        """Update device and firmware. Returns True if the discovery must be published with them.

        A device or firmware that is not available replaces nothing. An ESC has no identity until
        telemetry was received.
        """
        if self.index is not None and self.heard_ns is None:
            return False
        before = self.identity
        device = self.device
        firmware = self.firmware
        if before is not None:
            known_device, known_firmware = before
            device = device or known_device
            firmware = firmware or known_firmware
        self.identity = (device, firmware)
        return self.identity != before

    def _kind_of_state(self) -> str | None:
        return self._kinds.get(normalize(self.state or ""))


def _describe(flags: Sequence[Alarm] | None) -> list[dict[str, str]] | None:
    if flags is None:
        return None
    return [
        {
            "name": flag.text,
            "severity": flag.severity.value,
            "meaning": flag.meaning,
        }
        for flag in flags
    ]
