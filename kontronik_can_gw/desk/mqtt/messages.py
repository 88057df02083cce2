"""Makes MQTT messages from the frames of a layout: topics, JSON, and their timing. Pure; time is an argument.

Every topic but those of discovery begins with ``<topic>/<gateway>/``; ESC is the name of an ESC.

    online            "online" or "offline": the publisher's connection to the broker (retained; "offline" is the last will)
    available         "online" or "offline": frames of the gateway arrive over CAN (retained)
    state             JSON: the gateway's own values
    ESC/available     "online" or "offline": live telemetry of this ESC arrives (retained)
    ESC/state         JSON: every value of the ESC

A state is published at a fixed rate, and at once when errors, the kind of operating state, the link or the availability change. Such
changes are at least 0.2 s apart, and limited to one a second after a burst of 30.
"""

import json
from datetime import UTC, datetime
from typing import Any

from kontronik_can_gw.dbc.view import View
from kontronik_can_gw.desk.mqtt.discovery import device
from kontronik_can_gw.desk.mqtt.topics import OFFLINE, ONLINE, Message, Topics
from kontronik_can_gw.desk.mqtt.values import Published
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.esc.telemetry import MS, SECOND
from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.signals.unpacker import SignalReader

MIN_PAUSE_NS = 200 * MS
MAX_CHANGES = 30
IDENTITY_NS = 6 * SECOND
"""Time to wait for device and firmware: an ESC sends them about every second, some every five."""
_CHANGE_EVERY_NS = SECOND
_FIRST_NS = SECOND // 2
"""Delay of the first state, so that the first frames of all messages can arrive."""


class _Timing:
    """When the state of one member is published."""

    def __init__(self, period: int) -> None:
        self._period = period
        self._due: int | None = None
        self._shown: tuple[object, ...] | None = None
        self._published_ns = 0
        self._budget, self._budget_ns = float(MAX_CHANGES), 0

    def publishes(self, notable: tuple[object, ...], now: int) -> bool:
        """True if the state is to be published now: it is due, or something notable has changed."""
        if self._due is None:
            self._due = now + _FIRST_NS
        if now >= self._due:
            # on a fixed grid; missed times are skipped
            self._due += self._period * ((now - self._due) // self._period + 1)
        elif self._shown is None or notable == self._shown or not self._may_change(now):
            return False
        self._shown, self._published_ns = notable, now
        return True

    def _may_change(self, now: int) -> bool:
        """True if a change may be published now, within the pause and the rate limit."""
        if now - self._published_ns < MIN_PAUSE_NS:
            return False
        grown = self._budget + (now - self._budget_ns) / _CHANGE_EVERY_NS
        self._budget, self._budget_ns = min(MAX_CHANGES, grown), now
        if self._budget < 1:
            return False
        self._budget -= 1
        return True


class Publisher:
    """Takes frames, returns messages. ``now``: nanoseconds of one clock; ``wall_ns``: Unix time."""

    def __init__(
        self,
        bus: BusLayout,
        topics: Topics,
        rate: float,
        *,
        retain: bool = False,
        discovery: str | None = None,
        replay: bool = False,
    ) -> None:
        self.topics = topics
        self.view = View(SignalReader(bus.layout))
        self._retain, self._discovery, self._replay = retain, discovery, replay
        columns = self.view.reader.columns
        indices = sorted({column.esc for column in columns if column.esc is not None})
        self._members = [Published(self.view, None, None)]
        self._members += [Published(self.view, bus.escs[index], index) for index in indices]
        self._timings = [_Timing(round(SECOND / rate)) for _ in self._members]
        self._live = {at: m for m in self._members for at in m.of_group[Group.LIVE]}
        self._published: dict[str, bytes] = {}
        """Lasting messages as published, by topic."""
        self._discovered: dict[str, tuple[str | None, str | None]] = {}
        """Device and firmware in the published discovery, by topic."""

    @property
    def escs(self) -> list[str]:
        """Names of the ESCs with values in the layout."""
        return [member.name for member in self._members if member.name]

    def take(self, frame: CanFrame, now: int) -> None:
        """Take a frame."""
        for first, values in self.view.take(frame.key, frame.data, now) or ():
            for at, value in enumerate(values, first):
                if value is not None and at in self._live:
                    self._live[at].heard(now)

    def messages(self, now: int, wall_ns: int) -> list[Message]:
        """The messages to publish now."""
        self.view.expire(now)
        made: list[Message] = []
        for member, timing in zip(self._members, self._timings, strict=True):
            if timing.publishes(member.notable(now), now):
                made += self._lasting(member, now)
                state: dict[str, Any] = {"time": iso(wall_ns)}
                if self._replay:
                    state["replay"] = True
                topic = self.topics.state(member.name)
                made.append(
                    Message(topic, _json(state | member.document(now)), retain=self._retain)
                )
        return made

    def _lasting(self, member: Published, now: int) -> list[Message]:
        """Availability and discovery, where they are not published as they are now."""
        wanted = self._discovery_of(member, now)
        available = member.is_available(now)
        wanted[self.topics.available(member.name)] = ONLINE if available else OFFLINE
        news = {t: payload for t, payload in wanted.items() if self._published.get(t) != payload}
        self._published |= news
        return [
            Message(topic, payload, lasting=True, retain=True) for topic, payload in news.items()
        ]

    def _discovery_of(self, member: Published, now: int) -> dict[str, bytes]:
        """The new discovery of a member: once device and firmware are known, or stay unknown for long.

        Not before, since the retained discovery of an earlier run may be more complete.
        """
        member.update_identity()
        if self._discovery is None:
            return {}
        topic, known = self.topics.discovery(self._discovery, member.name), member.identity
        first = member.first_heard_ns
        waited = first is not None and now - first >= IDENTITY_NS
        if self._discovered.get(topic) == known or not (
            member.index is None or None not in known or waited
        ):
            return {}
        self._discovered[topic] = known
        return {topic: _json(device(self.topics, member, self.view.reader.columns))}


def _json(made: dict[str, Any]) -> bytes:
    return json.dumps(made, ensure_ascii=False).encode()


def iso(wall_ns: int) -> str:
    """ISO 8601 in UTC, with milliseconds."""
    moment = datetime.fromtimestamp(wall_ns // MS / 1000, UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
