"""What MQTT publishes of the gateway and of each ESC: values, errors and states, from the receiver's view of the bus. Pure."""

from collections.abc import Sequence
from typing import Any

from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.dbc.view import View
from kontronik_can_gw.desk.member import Flag, Member
from kontronik_can_gw.esc.decoder import Severity
from kontronik_can_gw.esc.telemetry import MS, SECOND, EscSettings
from kontronik_can_gw.esc.values import Group

SILENCE_NS = 3 * SECOND
"""After this time without a frame the gateway is not available."""


class Published(Member):
    """What is published of the gateway or an ESC, with times in ns."""

    def __init__(self, view: View, settings: EscSettings | None, index: int | None) -> None:
        super().__init__(view, settings, index)
        self.heard_ns: int | None = None
        """Time of the newest live value."""
        self.first_heard_ns: int | None = None
        self.identity: tuple[str | None, str | None] = (None, None)
        """Device and firmware last known."""
        states = self.protocol.states.values()
        self._kinds = {normalize(state.text): state.kind for state in states}

    def heard(self, now: int) -> None:
        """Note that a live value has come."""
        self.heard_ns = now
        if self.first_heard_ns is None:
            self.first_heard_ns = now

    def is_available(self, now: int) -> bool:
        """True while frames of the gateway, or live values of the ESC, come."""
        if self.index is None:
            last = self.view.last_ns
            return last is not None and now - last <= SILENCE_NS
        if self.of_group[Group.LIVE]:
            return self.is_known(Group.LIVE)
        return any(self.view.values[at] is not None for at in self.no_flags.values())

    def notable(self, now: int) -> tuple[object, ...]:
        """The values whose change is published at once."""
        available = self.is_available(now)
        if self.index is None:
            return available, self.value("can_state"), self.value("gateway_state")
        errors, selftest = self.flags("operating_errors"), self.flags("selftest_errors")
        return available, errors, selftest, self._kind(), self.value("link_state")

    def document(self, now: int) -> dict[str, Any]:
        """All values as JSON."""
        heard = self.view.last_ns if self.index is None else self.heard_ns
        age = None if heard is None else (now - heard) // MS
        made: dict[str, Any] = {"available": self.is_available(now), "age": age}
        values = {source: self.value(source) for source in self.no_flags}
        if self.index is None:
            return made | values
        errors, is_error = self.flags("operating_errors"), Severity.ERROR
        made["motor"] = self._kind()
        made["errors"] = _in_words(errors)
        made["problem"] = None if errors is None else any(e.severity is is_error for e in errors)
        made |= {"selftest": _in_words(self.flags("selftest_errors")), "link_state": None}
        return made | values | {"firmware": self.firmware}

    def update_identity(self) -> None:
        """Note device and firmware; what was known stays, so that it is never shown as unknown again."""
        device, firmware = self.identity
        self.identity = self.device or device, self.firmware or firmware

    def _kind(self) -> str | None:
        return self._kinds.get(normalize(self.state or ""))


def _in_words(flags: Sequence[Flag] | None) -> list[dict[str, str]] | None:
    if flags is None:
        return None
    return [{"name": f.name, "severity": f.severity.value, "meaning": f.meaning} for f in flags]
