"""Makes MQTT messages from the CAN frames of a layout: topics, JSON and timing.

No I/O, no clock: time is an argument. Every topic except those of discovery begins with
``<topic>/<gateway>/``. In the following, ESC is the name of an ESC.

    online         "online" or "offline": the publisher is connected to the broker (last will)
    available      "online" or "offline": frames of the gateway are received over CAN
    state          JSON with the gateway's own values
    ESC/available  "online" or "offline": telemetry of this ESC is received over CAN
    ESC/state      JSON with every value of the ESC

The texts "online" and "offline" are retained. A state is published at a fixed rate. It is also
published at once if errors, the kind of operating state, the link or the availability change, but
at most every 0.2 s.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, NamedTuple

from kontronik_can_gw.config.keys import MqttConfig
from kontronik_can_gw.dbc.view import View
from kontronik_can_gw.desk.member import Alarm, Member
from kontronik_can_gw.desk.mqtt.discovery import device
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.esc.decoder import Severity
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.signals.unpacker import SignalReader
from kontronik_can_gw.times import MS, SECOND

ONLINE = b"online"
OFFLINE = b"offline"
MIN_PAUSE_NS = 200 * MS
"""Minimum time between two states of a member that are published because of a change."""
SILENCE_NS = 3 * SECOND
"""The gateway is not available after this time without a frame."""
_FIRST_NS = SECOND // 2
"""Delay of the first state, in which the first frames of all messages can arrive."""


class Publication(NamedTuple):
    """A message to publish."""

    topic: str
    payload: bytes
    lasting: bool = False
    """True if the message is published again after each reconnection."""
    retain: bool = False
    """True if the broker keeps the message for later subscribers."""


@dataclass(frozen=True)
class Topics:
    """The topics of one gateway. An empty ``esc`` stands for the gateway itself."""

    prefix: str
    gateway: str

    def of(self, *levels: str) -> str:
        """Return a topic of this gateway. Empty levels are left out."""
        return "/".join(filter(None, (self.prefix, self.gateway, *levels)))

    def discovery(self, prefix: str, esc: str = "") -> str:
        """Return the topic of a device's discovery below Home Assistant's ``prefix``."""
        return f"{prefix}/device/{self.identifier(esc)}/config"

    def identifier(self, esc: str = "") -> str:
        """Return Home Assistant's identifier of a device. It depends on the two names only."""
        return "_".join(filter(None, ("kontronik", self.gateway, esc)))


class Published(Member):
    """The gateway or an ESC, with the content of its messages and their timing."""

    def __init__(self, view: View, settings: EscSettings | None, index: int | None) -> None:
        super().__init__(view, settings, index)
        self.signs = self.of_group[Group.LIVE] or [*self.no_flags.values()]
        """Columns whose values prove that telemetry is received.

        They are the live values, or all values if the DBC has no live ones.
        """
        self.heard_ns: int | None = None
        """Time of the newest value in these columns."""
        self.identity: tuple[str | None, str | None] | None = None
        """Device and firmware of the published discovery."""
        self._kinds = {normalize(each.text): each.kind for each in self.protocol.states.values()}
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
        found: dict[str, Any] = {"available": self.is_available(now), "age": None}
        if heard_ns is not None:
            found["age"] = (now - heard_ns) // MS
        values = {source: self.value(source) for source in self.no_flags}
        if self.index is None:
            return found | values
        errors = self.flags("operating_errors")
        found["motor"] = self._kind_of_state()
        found["errors"] = _describe(errors)
        found["problem"] = None
        if errors is not None:
            found["problem"] = any(error.severity is Severity.ERROR for error in errors)
        found["selftest"] = _describe(self.flags("selftest_errors"))
        found["link_state"] = None  # present even if the DBC has no signal for it
        return found | values | {"firmware": self.firmware}

    def update_identity(self) -> bool:
        """Update device and firmware. Returns True if the discovery must be published with them.

        A device or firmware that is not available replaces nothing. An ESC has no identity until
        telemetry was received.
        """
        if self.index is not None and self.heard_ns is None:
            return False
        before = self.identity
        device, firmware = before or (None, None)
        self.identity = (self.device or device, self.firmware or firmware)
        return self.identity != before

    def _kind_of_state(self) -> str | None:
        return self._kinds.get(normalize(self.state or ""))


def _describe(flags: Sequence[Alarm] | None) -> list[dict[str, str]] | None:
    if flags is None:
        return None
    return [
        {"name": flag.text, "severity": flag.severity.value, "meaning": flag.meaning}
        for flag in flags
    ]


class Publisher:
    """Takes CAN frames and returns the MQTT messages to publish.

    ``now`` is nanoseconds of one monotonic clock, ``wall_ns`` Unix time in nanoseconds.
    """

    def __init__(self, bus: BusLayout, topics: Topics, config: MqttConfig) -> None:
        self._topics = topics
        self._config = config
        self._view = View(SignalReader(bus.layout))
        columns = self._view.reader.columns
        indices = sorted({column.esc for column in columns if column.esc is not None})
        self._members = [Published(self._view, None, None)]
        self._members += [Published(self._view, bus.escs[index], index) for index in indices]
        self._member_of_sign = {at: member for member in self._members for at in member.signs}
        self._lasting: dict[str, bytes] = {}
        """The last payload of each topic with lasting messages."""

    @property
    def escs(self) -> list[str]:
        """Names of the ESCs with values in the layout."""
        return [member.name for member in self._members if member.name]

    def take(self, frame: CanFrame, now: int) -> None:
        """Decode a received frame. Frames that the layout does not contain are ignored."""
        for first, values in self._view.take(frame.key, frame.data, now) or ():
            for at, value in enumerate(values, first):
                if value is not None and at in self._member_of_sign:
                    self._member_of_sign[at].heard_ns = now

    def messages(self, now: int, wall_ns: int) -> list[Publication]:
        """Return the messages to publish now. Call it several times a second."""
        self._view.expire(now)
        period_ns = round(SECOND / self._config.rate)
        found: list[Publication] = []
        for member in self._members:
            if not member.is_due(now, period_ns):
                continue
            for topic, payload in self._lasting_of(member, now).items():
                if self._lasting.get(topic) != payload:
                    found.append(Publication(topic, payload, lasting=True, retain=True))
                    self._lasting[topic] = payload
            topic = self._topics.of(member.name, "state")
            state = {"time": iso(wall_ns)} | member.document(now)
            found.append(Publication(topic, _json(state), retain=self._config.retain))
        return found

    def _lasting_of(self, member: Published, now: int) -> dict[str, bytes]:
        """Return availability, and discovery if it has changed, as payloads by topic."""
        available = ONLINE if member.is_available(now) else OFFLINE
        found = {self._topics.of(member.name, "available"): available}
        prefix = self._config.discovery
        if prefix is not None and member.update_identity():
            topic = self._topics.discovery(prefix, member.name)
            found[topic] = _json(device(self._topics, member))
        return found


def _json(content: dict[str, Any]) -> bytes:
    return json.dumps(content, ensure_ascii=False).encode()


def iso(wall_ns: int) -> str:
    """Return a Unix time as ISO 8601 in UTC, with milliseconds."""
    moment = datetime.fromtimestamp(wall_ns // MS / 1000, UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
