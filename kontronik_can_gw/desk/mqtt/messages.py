"""Makes MQTT messages from the frames of a layout: topics, JSON, Home Assistant's discovery, and their timing. Pure; time is an argument.

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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, NamedTuple

from kontronik_can_gw import __version__
from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.dbc.view import View
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.esc.kontronik.states import (
    Device,
    ErrorBit,
    OperatingError,
    OperatingState,
    SelfTestError,
    Severity,
)
from kontronik_can_gw.esc.telemetry import MS, SECOND
from kontronik_can_gw.esc.values import VALUES, Group
from kontronik_can_gw.signals.unpacker import Column, SignalReader, Value

ONLINE, OFFLINE = b"online", b"offline"
PROGRAM = "kontronik-can-gw"
MAKER = "KONTRONIK"
SILENCE_NS = 3 * SECOND
"""After this time without a frame the gateway is not available."""
MIN_PAUSE_NS = 200 * MS
MAX_CHANGES = 30
IDENTITY_NS = 6 * SECOND
"""Time to wait for device and firmware: an ESC sends them about every second, some every five."""
_CHANGE_EVERY_NS = SECOND
_FIRST_NS = SECOND // 2
"""Delay of the first state, so that the first frames of all messages can arrive."""

_KINDS = {
    "idle": (
        OperatingState.WaitForSignal,
        OperatingState.WaitForMotorOff,
        OperatingState.WaitForMotorOn,
        OperatingState.Selftest,
        OperatingState.AcousticSignal,
        OperatingState.MotorOff,
        OperatingState.StandBy,
        OperatingState.Programming,
        OperatingState.Sync_StandBy,
    ),
    "start": (
        OperatingState.SpoolUpFromStill,
        OperatingState.SpoolUpFromTurn,
        OperatingState.SpoolUpQuick,
    ),
    "run": (
        OperatingState.Forward,
        OperatingState.Backward,
        OperatingState.Sync_Forward,
        OperatingState.Sync_Backward,
        OperatingState.RPMControl,
    ),
    "brake": (
        OperatingState.Brake,
        OperatingState.BrakeTargetBackward,
        OperatingState.BrakeTargetForward,
    ),
    "fault": (OperatingState.Error_Selftest, OperatingState.CutOffDuringOperation),
}
KIND_OF_STATE = {state: kind for kind, states in _KINDS.items() for state in states}
"""Kind of each operating state, as published in "motor"."""

_FLAGS: dict[str, ErrorBit] = {
    bit.text: bit for bits in (OperatingError, SelfTestError) for bit in bits
}
_SELFTEST = {bit.text for bit in SelfTestError}
_WORDS: tuple[tuple[str, type[ErrorBit]], ...] = (
    ("operating_errors", OperatingError),
    ("selftest_errors", SelfTestError),
)
_SOURCES = VALUES


class Message(NamedTuple):
    """A message to publish. ``lasting``: retained, and published again after each reconnection."""

    topic: str
    payload: bytes
    lasting: bool = False
    retain: bool = False


@dataclass(frozen=True)
class Topics:
    """The topics of one gateway."""

    prefix: str
    gateway: str

    @property
    def base(self) -> str:
        return f"{self.prefix}/{self.gateway}"

    @property
    def online(self) -> str:
        return f"{self.base}/online"

    def available(self, esc: str | None) -> str:
        return f"{self.base}/available" if esc is None else f"{self.base}/{esc}/available"

    def state(self, esc: str | None) -> str:
        return f"{self.base}/state" if esc is None else f"{self.base}/{esc}/state"

    def discovery(self, prefix: str, esc: str | None) -> str:
        return f"{prefix}/device/{self.identifier(esc)}/config"

    def identifier(self, esc: str | None) -> str:
        """Home Assistant's identifier of a device, constant as long as gateway and ESC keep their names."""
        return f"kontronik_{self.gateway}" if esc is None else f"kontronik_{self.gateway}_{esc}"


class _Member:
    """The gateway (``esc`` None) or an ESC: its columns and the state of its publication."""

    def __init__(self, view: View, esc: int | None, name: str | None) -> None:
        self.esc, self.name = esc, name
        self.columns: dict[str, int] = {}
        self.flags: list[tuple[str, int, int | None]] = []
        """Flags: name, column, and the bit in an error word (None: a signal of its own)."""
        for index, column in enumerate(view.reader.columns):
            if column.esc != esc or column.source in self.columns:
                continue
            if column.source in _FLAGS:
                self.flags.append((column.source, index, None))
            else:
                self.columns[column.source] = index
        own = {flag for flag, _, _ in self.flags}
        for word, bits in _WORDS:
            if word in self.columns:
                at = self.columns[word]
                self.flags += [(bit.text, at, int(bit)) for bit in bits if bit.text not in own]
        self.live = [
            at for source, at in self.columns.items() if _SOURCES[source].group is Group.LIVE
        ]
        self.kinds = _kinds(view, self.columns)
        self.changed = True
        """True if something may have changed since the last check."""
        self.shown: tuple[object, ...] | None = None
        """Published values whose change triggers a message."""
        self.published_ns: int | None = None
        self.due: int | None = None
        self.heard_ns: int | None = None
        self.first_heard_ns: int | None = None
        self.budget, self.budget_ns = float(MAX_CHANGES), 0


def _kinds(view: View, columns: Mapping[str, int]) -> dict[Value, str]:
    """The kind of each value that the operating state's signal can have."""
    if (at := columns.get("operating_state")) is not None:
        texts = view.reader.columns[at].texts
        return {text: KIND_OF_STATE[OperatingState(raw)] for raw, text in _by_number(texts)}
    return {int(state): kind for state, kind in KIND_OF_STATE.items()}


def _by_number(texts: Sequence[tuple[int, str]]) -> list[tuple[int, str]]:
    """The operating states of a value table, matched by name, since its raw values may differ from the ESC's numbers."""
    known = {normalize(state.text): int(state) for state in OperatingState}
    return [(known[normalize(text)], text) for _, text in texts if normalize(text) in known]


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
        self._period = round(SECOND / rate)
        self._retain, self._discovery, self._replay = retain, discovery, replay
        indices = sorted(
            {column.esc for column in self.view.reader.columns if column.esc is not None}
        )
        self._members = [_Member(self.view, None, None)]
        self._members += [_Member(self.view, index, bus.escs[index].name) for index in indices]
        self._of_esc = {member.esc: member for member in self._members}
        self._whose = [self._of_esc[column.esc] for column in self.view.reader.columns]
        self._live = frozenset(at for member in self._members for at in member.live)
        self._published: dict[str, bytes] = {}
        """Lasting messages as published, by topic."""
        self._identity: dict[int | None, tuple[str | None, str | None]] = {}
        self._discovered: dict[int | None, tuple[str | None, str | None]] = {}
        """Device and firmware in the published discovery."""

    @property
    def escs(self) -> list[str]:
        """Names of the ESCs with values in the layout."""
        return [member.name for member in self._members if member.name is not None]

    def take(self, key: int, data: bytes, now: int) -> None:
        """Take a frame."""
        chunks = self.view.take(key, data, now)
        if chunks is None:
            return
        self._members[0].changed = True  # its availability
        for first, values in chunks:
            for at, value in enumerate(values, first):
                self._whose[at].changed = True
                if value is not None and at in self._live:
                    self._whose[at].heard_ns = now
                    if self._whose[at].first_heard_ns is None:
                        self._whose[at].first_heard_ns = now

    def due(self, now: int) -> int:
        """Latest time of the next call of ``messages``."""
        times = []
        for member in self._members:
            times.append(now if member.due is None else member.due)
            if member.changed and member.published_ns is not None:
                pause = member.published_ns + MIN_PAUSE_NS
                times.append(pause if pause > now else now + MIN_PAUSE_NS)
        return min(times)

    def messages(self, now: int, wall_ns: int) -> list[Message]:
        """The messages to publish now."""
        if self.view.expire(now) or self._gateway_is_silent(now):
            for member in self._members:
                member.changed = True
        made: list[Message] = []
        for member in self._members:
            if member.due is None:
                member.due = now + _FIRST_NS
            regular = now >= member.due
            if not regular and (member.shown is None or not member.changed):
                continue
            notable = self._notable(member, now)
            if not regular:
                if notable == member.shown:
                    member.changed = False
                    continue
                if not self._may_publish_change(member, now):
                    continue  # it stays changed and is checked again
            else:
                member.due = _next(member.due, self._period, now)
            member.changed, member.shown, member.published_ns = False, notable, now
            made += self._lasting(member, now)
            payload = json.dumps(self.state(member.esc, now, wall_ns), ensure_ascii=False).encode()
            made.append(Message(self.topics.state(member.name), payload, retain=self._retain))
        return made

    def state(self, esc: int | None, now: int, wall_ns: int) -> dict[str, Any]:
        """The state of an ESC (None: of the gateway) as JSON."""
        member, values = self._of_esc[esc], self.view.values
        made: dict[str, Any] = {"time": iso(wall_ns)}
        if self._replay:
            made["replay"] = True
        made["available"] = self._is_available(member, now)
        if esc is None:
            made["age"] = None if self.view.last_ns is None else (now - self.view.last_ns) // MS
        else:
            made["age"] = None if member.heard_ns is None else (now - member.heard_ns) // MS
            errors = self._errors(member)
            made |= {"motor": self._kind(member), "errors": errors, "problem": _problem(errors)}
            made["selftest"] = self._selftest(member)
            made["link_state"] = None
        for source, at in member.columns.items():
            made[source] = values[at]
        if esc is not None:
            made["firmware"] = self._firmware(member)
        return made

    # --- what counts as a change

    def _notable(self, member: _Member, now: int) -> tuple[object, ...]:
        if member.esc is None:
            at = member.columns.get("can_state"), member.columns.get("gateway_state")
            return (
                self._is_available(member, now),
                *(None if i is None else self.view.values[i] for i in at),
            )
        set_flags = None if not self._has_state(member) else self._set_flags(member, False)
        selftest = None if not self._has_info(member) else self._set_flags(member, True)
        link = member.columns.get("link_state")
        return (
            self._is_available(member, now),
            set_flags,
            selftest,
            self._kind(member),
            None if link is None else self.view.values[link],
        )

    def _may_publish_change(self, member: _Member, now: int) -> bool:
        """True if a change may be published now, within the pause and the rate limit."""
        if member.published_ns is not None and now - member.published_ns < MIN_PAUSE_NS:
            return False
        member.budget = min(
            MAX_CHANGES, member.budget + (now - member.budget_ns) / _CHANGE_EVERY_NS
        )
        member.budget_ns = now
        if member.budget < 1:
            return False
        member.budget -= 1
        return True

    def _gateway_is_silent(self, now: int) -> bool:
        """True while the gateway's silence is not published yet."""
        member = self._members[0]
        return (
            member.shown is not None
            and member.shown[0] is True
            and not self._is_available(member, now)
        )

    def _is_available(self, member: _Member, now: int) -> bool:
        if member.esc is None:
            return self.view.last_ns is not None and now - self.view.last_ns <= SILENCE_NS
        checked = member.live or list(member.columns.values())
        return any(self.view.values[at] is not None for at in checked)

    # --- errors and states

    def _has_state(self, member: _Member) -> bool:
        """True while flags are valid: they have no 'not available', so the operating state must be available."""
        known = [
            member.columns[s]
            for s in ("operating_state", "operating_state_raw")
            if s in member.columns
        ]
        return any(self.view.values[at] is not None for at in known or member.live)

    def _has_info(self, member: _Member) -> bool:
        """True while self-test flags are valid: the device must be available."""
        info: list[str] = [s for s in ("device", "device_raw") if s in member.columns]
        info = info or [s for s in member.columns if _SOURCES[s].group is Group.INFO]
        return any(self.view.values[member.columns[s]] is not None for s in info)

    def _set_flags(self, member: _Member, selftest: bool) -> tuple[str, ...]:
        values = self.view.values
        found = []
        for flag, at, bit in member.flags:
            value = values[at]
            if (
                (flag in _SELFTEST) is selftest
                and isinstance(value, int)
                and (value if bit is None else value >> bit & 1)
            ):
                found.append(flag)
        return tuple(found)

    def _errors(self, member: _Member) -> list[dict[str, str]] | None:
        if not self._has_state(member):
            return None
        return [_error(flag) for flag in self._set_flags(member, False)]

    def _selftest(self, member: _Member) -> list[dict[str, str]] | None:
        if not self._has_info(member):
            return None
        return [_error(flag) for flag in self._set_flags(member, True)]

    def _kind(self, member: _Member) -> str | None:
        at = member.columns.get("operating_state", member.columns.get("operating_state_raw"))
        return None if at is None else member.kinds.get(self.view.values[at])

    # --- lasting messages

    def _lasting(self, member: _Member, now: int) -> list[Message]:
        wanted: dict[str, bytes] = {}
        known = self._known_identity(member)
        if (
            self._discovery is not None
            and self._discovered.get(member.esc) != known
            and self._may_discover(member, now)
        ):
            self._discovered[member.esc] = known
            topic = self.topics.discovery(self._discovery, member.name)
            wanted[topic] = json.dumps(self._device(member, *known), ensure_ascii=False).encode()
        wanted[self.topics.available(member.name)] = (
            ONLINE if self._is_available(member, now) else OFFLINE
        )
        news = {
            topic: payload
            for topic, payload in wanted.items()
            if self._published.get(topic) != payload
        }
        self._published |= news
        return [
            Message(topic, payload, lasting=True, retain=True) for topic, payload in news.items()
        ]

    def _device(self, member: _Member, device: str | None, firmware: str | None) -> dict[str, Any]:
        topics, columns = self.topics, self.view.reader.columns
        if member.esc is None:
            about: dict[str, Any] = {
                "name": f"KONTRONIK gateway {topics.gateway}",
                "model": PROGRAM,
            }
        else:
            about = {
                "name": f"{topics.gateway} {member.name}",
                "manufacturer": MAKER,
                "model": device or "ESC",
            }
            about["via_device"] = topics.identifier(None)
            if firmware is not None:
                about["sw_version"] = firmware
        owned = [(source, columns[at]) for source, at in member.columns.items()]
        components: dict[str, dict[str, Any]] = {}
        for source, column in owned:
            if (component := entity(source, column)) is not None:
                components[source] = component
        if member.esc is not None and member.flags:
            components |= _ERROR_ENTITIES
        if member.columns.keys() & {"operating_state", "operating_state_raw"}:
            components["motor"] = _MOTOR
        identifier = topics.identifier(member.name)
        online = {"topic": topics.online}
        for key, component in components.items():
            components[key] = {**component, "unique_id": f"{identifier}_{key}"}
            if key in _SOURCES and _SOURCES[key].group is Group.LINK:
                # values of the link are valid, and most useful, while the ESC sends nothing
                components[key] |= {
                    "availability": [online, {"topic": topics.available(None)}],
                    "availability_mode": "all",
                }
        return {
            "device": {"identifiers": [identifier], **about},
            "origin": {"name": PROGRAM, "sw_version": __version__},
            "availability": [online, {"topic": topics.available(member.name)}],
            "availability_mode": "all",
            "state_topic": topics.state(member.name),
            "components": components,
        }

    def _may_discover(self, member: _Member, now: int) -> bool:
        """True once device and firmware are known, or stay unknown for long: the retained discovery may be more complete."""
        if member.esc is None or None not in self._identity[member.esc]:
            return True
        return member.first_heard_ns is not None and now - member.first_heard_ns >= IDENTITY_NS

    def _known_identity(self, member: _Member) -> tuple[str | None, str | None]:
        """Device and firmware last known, so that Home Assistant never shows "unknown" again."""
        device, firmware = self._identity.get(member.esc, (None, None))
        at = member.columns.get("device")
        if at is not None and isinstance(text := self.view.values[at], str):
            device = _DEVICES.get(normalize(text), text)
        firmware = self._firmware(member) or firmware
        self._identity[member.esc] = device, firmware
        return device, firmware

    def _firmware(self, member: _Member) -> str | None:
        parts = [
            self.view.values[member.columns[s]]
            for s in ("firmware_main", "firmware_sub")
            if s in member.columns
        ]
        if len(parts) == 2 and all(isinstance(part, int) for part in parts):
            return f"{parts[0]}.{parts[1]}"
        return None


def _next(due: int, period: int, now: int) -> int:
    """The next time on a fixed grid; missed times are skipped."""
    return due + period * ((now - due) // period + 1)


def iso(wall_ns: int) -> str:
    """ISO 8601 in UTC, with milliseconds."""
    return (
        datetime.fromtimestamp(wall_ns // MS / 1000, UTC).strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3]
        + "Z"
    )


def _error(flag: str) -> dict[str, str]:
    bit = _FLAGS[flag]
    return {"name": flag, "severity": bit.severity.value, "meaning": bit.meaning}


def _problem(errors: Sequence[Mapping[str, str]] | None) -> bool | None:
    """True where one of them is an error, not only a warning or a status."""
    return (
        None
        if errors is None
        else any(error["severity"] == Severity.ERROR.value for error in errors)
    )


# --- Home Assistant: which units go with which device class

_DEVICES = {normalize(device.text): device.text for device in Device}
_MEASURED: dict[str, tuple[str, str | None]] = {
    "V": ("V", "voltage"),
    "A": ("A", "current"),
    "W": ("W", "power"),
    "degC": ("°C", "temperature"),
    "Hz": ("Hz", "frequency"),
    "ms": ("ms", "duration"),
    "1/min": ("rpm", None),
    "%": ("%", None),
    "us": ("µs", None),
}
"""Our unit: Home Assistant's unit and device class. Speed and charge have no class, and % here is neither humidity nor battery."""
_TOTALS: dict[str, tuple[str, str | None]] = {
    "Wh": ("Wh", "energy"),
    "mAh": ("mAh", None),
    "s": ("s", "duration"),
}
"""Values that only grow until the ESC or the gateway restarts."""
_DIAGNOSTIC = {Group.LINK, Group.INFO, Group.GATEWAY}
_OF_USE = {"energy_used", "motor_run_time", "link_state"}
_SHORT = {
    "bec": "BEC",
    "pwm": "PWM",
    "crc": "CRC",
    "can": "CAN",
    "id": "ID",
    "esc": "ESC",
    "escs": "ESCs",
    "eeprom": "EEPROM",
}
_LEFT_OUT = {
    "operating_state_raw",
    "device_raw",
    "firmware_main",
    "firmware_sub",
    "operating_errors",
    "selftest_errors",
}
"""Sources without an entity, because another one shows the same."""
_MOTOR: dict[str, Any] = {
    "platform": "sensor",
    "name": "Motor",
    "device_class": "enum",
    "options": list(_KINDS),
    "value_template": "{{ value_json.motor }}",
}
_NAMES = (
    "{{% if value_json.{0} is none %}}None{{% else %}}"
    "{{{{ (value_json.{0} | map(attribute='name') | join(', ') or 'none')[:255] }}}}{{% endif %}}"
)
_ERROR_ENTITIES: dict[str, dict[str, Any]] = {
    "problem": {
        "platform": "binary_sensor",
        "name": "Problem",
        "device_class": "problem",
        "value_template": "{% if value_json.problem is none %}None{% elif value_json.problem %}ON{% else %}OFF{% endif %}",
    },
    "errors": {"platform": "sensor", "name": "Errors", "value_template": _NAMES.format("errors")},
    "selftest": {
        "platform": "sensor",
        "name": "Self-test",
        "entity_category": "diagnostic",
        "value_template": _NAMES.format("selftest"),
    },
}


def _in_words(source: str) -> str:
    words = [_SHORT.get(word, word) for word in source.split("_")]
    return " ".join([words[0][0].upper() + words[0][1:], *words[1:]])


def entity(source: str, column: Column) -> dict[str, Any] | None:
    """Home Assistant's entity of a value; None where another one shows the same."""
    if source in _LEFT_OUT:
        return None
    about = _SOURCES[source]
    made: dict[str, Any] = {
        "platform": "sensor",
        "name": _in_words(source),
        "value_template": f"{{{{ value_json.{source} }}}}",
    }
    if about.group in _DIAGNOSTIC and source not in _OF_USE:
        made["entity_category"] = "diagnostic"
    if column.texts:
        return made | {
            "device_class": "enum",
            "options": list(dict.fromkeys(text for _, text in column.texts)),
        }
    if about.names:  # sent as a plain number
        return made
    unit = column.unit or about.unit
    if unit in _TOTALS:
        unit, kind = _TOTALS[unit]
        made |= {"unit_of_measurement": unit, "state_class": "total_increasing"}
    elif unit in _MEASURED:
        unit, kind = _MEASURED[unit]
        made |= {"unit_of_measurement": unit, "state_class": "measurement"}
    else:
        kind = None
        made["state_class"] = "total_increasing" if about.rolls else "measurement"
        if unit:
            made["unit_of_measurement"] = unit
    if kind is not None:
        made["device_class"] = kind
    if column.digits is not None:
        made["suggested_display_precision"] = column.digits
    return made


def is_ours(payload: bytes, topics: Topics) -> bool:
    """True for the discovery of this gateway or one of its ESCs, published by any version."""
    try:
        found = json.loads(payload)
        return (
            found["origin"]["name"] == PROGRAM and {"topic": topics.online} in found["availability"]
        )
    except (ValueError, KeyError, TypeError):
        return False
