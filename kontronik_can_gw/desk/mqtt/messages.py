"""Makes MQTT messages from the frames of a layout: topics, JSON, and their timing. Pure; time is an argument.

Every topic but those of discovery begins with ``<topic>/<gateway>/``; ESC is the name of an ESC.

    online            "online" or "offline": the publisher's connection to the broker (retained; "offline" is the last will)
    available         "online" or "offline": frames of the gateway arrive over CAN (retained)
    state             JSON: the gateway's own values
    ESC/available     "online" or "offline": live telemetry of this ESC arrives (retained)
    ESC/state         JSON: every value of the ESC

A state is published at a fixed rate, and at once when errors, the kind of operating state, the link or the availability change. Such
changes are at least 0.2 s apart.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, NamedTuple

from kontronik_can_gw.config.keys import MqttConfig
from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.dbc.view import View
from kontronik_can_gw.desk.member import Alarm, Member
from kontronik_can_gw.desk.mqtt.discovery import device
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.esc.decoder import Severity
from kontronik_can_gw.esc.telemetry import MS, SECOND, EscSettings
from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.signals.unpacker import SignalReader

ONLINE, OFFLINE = b"online", b"offline"
MIN_PAUSE_NS = 200 * MS
SILENCE_NS = 3 * SECOND
"""After this time without a frame the gateway is not available."""
_FIRST_NS = SECOND // 2
"""Delay of the first state, so that the first frames of all messages can arrive."""


class Publication(NamedTuple):
    """A message to publish. ``lasting``: retained, and published again after each reconnection."""

    topic: str
    payload: bytes
    lasting: bool = False
    retain: bool = False


@dataclass(frozen=True)
class Topics:
    """The topics of one gateway. ``esc`` empty: the gateway's own."""

    prefix: str
    gateway: str

    def of(self, *levels: str) -> str:
        """The topic below this gateway's; empty levels are left out."""
        return "/".join(filter(None, (self.prefix, self.gateway, *levels)))

    def discovery(self, prefix: str, esc: str = "") -> str:
        return f"{prefix}/device/{self.identifier(esc)}/config"

    def identifier(self, esc: str = "") -> str:
        """Home Assistant's identifier of a device, constant as long as gateway and ESC keep their names."""
        return "_".join(filter(None, ("kontronik", self.gateway, esc)))


class Published(Member):
    """What is published of the gateway or an ESC, and when."""

    def __init__(self, view: View, settings: EscSettings | None, index: int | None) -> None:
        super().__init__(view, settings, index)
        self.signs = self.of_group[Group.LIVE] or [*self.no_flags.values()]
        """Columns that show that it is heard: of live values, where the DBC has any."""
        self.heard_ns: int | None = None
        """Time of the newest value of these."""
        self.identity: tuple[str | None, str | None] | None = None
        """Device and firmware of the published discovery."""
        self._kinds = {normalize(each.text): each.kind for each in self.protocol.states.values()}
        self._due: int | None = None
        self._shown: tuple[object, ...] | None = None
        self._published_ns = 0

    def is_available(self, now: int) -> bool:
        """True while frames of the gateway, or values of the ESC, come."""
        if self.index is None:
            last = self.view.last_ns
            return last is not None and now - last <= SILENCE_NS
        return any(self.view.values[at] is not None for at in self.signs)

    def is_due(self, now: int, period: int) -> bool:
        """True if the state is to be published now: it is time, or something notable has changed."""
        if self._due is None:
            self._due = now + _FIRST_NS
        notable = self._notable(now)
        if now >= self._due:
            # on a fixed grid; missed times are skipped
            self._due += period * ((now - self._due) // period + 1)
        elif self._shown in (None, notable) or now - self._published_ns < MIN_PAUSE_NS:
            return False
        self._shown, self._published_ns = notable, now
        return True

    def _notable(self, now: int) -> tuple[object, ...]:
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

    def is_news(self) -> bool:
        """True where device and firmware are others than announced, of an ESC once it was heard. What was known stays."""
        if self.index is not None and self.heard_ns is None:
            return False
        before = self.identity
        device, firmware = before or (None, None)
        self.identity = self.device or device, self.firmware or firmware
        return self.identity != before

    def _kind(self) -> str | None:
        return self._kinds.get(normalize(self.state or ""))


def _in_words(flags: Sequence[Alarm] | None) -> list[dict[str, str]] | None:
    if flags is None:
        return None
    return [{"name": f.text, "severity": f.severity.value, "meaning": f.meaning} for f in flags]


class Publisher:
    """Takes frames, returns messages. ``now``: nanoseconds of one clock; ``wall_ns``: Unix time."""

    def __init__(self, bus: BusLayout, topics: Topics, config: MqttConfig) -> None:
        self._topics, self._config = topics, config
        self._view = View(SignalReader(bus.layout))
        columns = self._view.reader.columns
        indices = sorted({column.esc for column in columns if column.esc is not None})
        self._members = [Published(self._view, None, None)]
        self._members += [Published(self._view, bus.escs[index], index) for index in indices]
        self._signs = {at: m for m in self._members for at in m.signs}
        self._lasting: dict[str, bytes] = {}
        """Lasting messages as published, by topic."""

    @property
    def escs(self) -> list[str]:
        """Names of the ESCs with values in the layout."""
        return [member.name for member in self._members if member.name]

    def take(self, frame: CanFrame, now: int) -> None:
        """Take a frame."""
        for first, values in self._view.take(frame.key, frame.data, now) or ():
            for at, value in enumerate(values, first):
                if value is not None and at in self._signs:
                    self._signs[at].heard_ns = now

    def messages(self, now: int, wall_ns: int) -> list[Publication]:
        """The messages to publish now."""
        self._view.expire(now)
        made: list[Publication] = []
        for member in self._members:
            if member.is_due(now, round(SECOND / self._config.rate)):
                for topic, payload in self._lasting_of(member, now).items():
                    if self._lasting.get(topic) != payload:
                        made.append(Publication(topic, payload, lasting=True, retain=True))
                        self._lasting[topic] = payload
                topic = self._topics.of(member.name, "state")
                state = {"time": iso(wall_ns)} | member.document(now)
                made.append(Publication(topic, _json(state), retain=self._config.retain))
        return made

    def _lasting_of(self, member: Published, now: int) -> dict[str, bytes]:
        """Availability and, where it is new, discovery."""
        available = ONLINE if member.is_available(now) else OFFLINE
        found = {self._topics.of(member.name, "available"): available}
        if (prefix := self._config.discovery) is not None and member.is_news():
            found[self._topics.discovery(prefix, member.name)] = _json(device(self._topics, member))
        return found


def _json(made: dict[str, Any]) -> bytes:
    return json.dumps(made, ensure_ascii=False).encode()


def iso(wall_ns: int) -> str:
    """ISO 8601 in UTC, with milliseconds."""
    moment = datetime.fromtimestamp(wall_ns // MS / 1000, UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
