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
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any, NamedTuple

from kontronik_can_gw.config.keys import MqttConfig
from kontronik_can_gw.desk.mqtt.discovery import device
from kontronik_can_gw.desk.mqtt.published import Published, Topics
from kontronik_can_gw.desk.receiver.unpacker import SignalReader
from kontronik_can_gw.desk.receiver.view import View
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.times import MS, SECOND

ONLINE = b"online"
OFFLINE = b"offline"


class Publication(NamedTuple):
    """A message to publish."""

    topic: str
    payload: bytes
    is_lasting: bool = False
    """True if the message is published again after each reconnection."""
    retain: bool = False
    """True if the broker keeps the message for later subscribers."""


class Publisher:
    """Takes CAN frames and returns the MQTT messages to publish.

    ``now`` is nanoseconds of one monotonic clock, ``wall_ns`` Unix time in nanoseconds.
    """

    def __init__(self, bus: BusLayout, topics: Topics, config: MqttConfig) -> None:
        self._topics = topics
        self._config = config
        self._view = View(SignalReader(bus.layout))
        self._members = [Published(self._view, None, None)]
        escs = {column.esc for column in self._view.reader.columns}
        for index, settings in enumerate(bus.escs):
            if index in escs:
                self._members.append(Published(self._view, settings, index))
        self._member_of_sign = {at: member for member in self._members for at in member.signs}
        """The member whose telemetry a value in a column proves."""
        self._lasting: dict[str, bytes] = {}
        """The last payload of each topic with lasting messages."""

    @property
    def escs(self) -> list[str]:
        """Names of the ESCs with values in the layout."""
        return [member.name for member in self._members if member.name]

    def take(self, frame: CanFrame, now: int) -> None:
        """Decode a received frame. Frames that the layout does not contain are ignored."""
        decoded = self._view.take(frame.key, frame.data, now)
        for first, values in decoded or ():
            for at, value in enumerate(values, first):
                member = self._member_of_sign.get(at)
                if value is not None and member is not None:
                    member.heard_ns = now

    def messages(self, now: int, wall_ns: int) -> list[Publication]:
        """Return the messages to publish now. Call it several times a second."""
        self._view.expire(now)
        period_ns = round(SECOND / self._config.rate)
        found: list[Publication] = []
        for member in self._members:
            if not member.is_due(now, period_ns):
                continue
            found += self._changed(self._lasting_of(member, now))
            topic = self._topics.of(member.name, "state")
            state = _json({"time": iso(wall_ns)} | member.document(now))
            found.append(Publication(topic, state, retain=self._config.retain))
        return found

    def _changed(self, payloads: dict[str, bytes]) -> Iterator[Publication]:
        """Yield the lasting messages whose payload differs from the last one of their topic."""
        for topic, payload in payloads.items():
            if self._lasting.get(topic) != payload:
                self._lasting[topic] = payload
                yield Publication(topic, payload, is_lasting=True, retain=True)

    def _lasting_of(self, member: Published, now: int) -> dict[str, bytes]:
        """Return availability, and discovery if it has changed, as payloads by topic."""
        topic = self._topics.of(member.name, "available")
        found = {topic: ONLINE if member.is_available(now) else OFFLINE}
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
