"""What MQTT publishes of the gateway and of each ESC: values, errors and states, from the receiver's view of the bus. Pure."""

from collections.abc import Mapping, Sequence
from typing import Any

from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.dbc.view import View
from kontronik_can_gw.esc.decoder import EscProtocol, Severity
from kontronik_can_gw.esc.protocols import PROTOCOLS
from kontronik_can_gw.esc.telemetry import MS, SECOND
from kontronik_can_gw.esc.values import VALUES, Group
from kontronik_can_gw.signals.unpacker import Value

SILENCE_NS = 3 * SECOND
"""After this time without a frame the gateway is not available."""


class Member:
    """The gateway (``index`` None) or an ESC, with its signals in the layout."""

    def __init__(
        self,
        view: View,
        index: int | None,
        name: str | None,
        protocol: EscProtocol = PROTOCOLS[0],
    ) -> None:
        self._protocol = protocol
        self.index, self.name = index, name
        self.columns: dict[str, int] = {}
        self.heard_ns: int | None = None
        """Time of the newest live value."""
        self.first_heard_ns: int | None = None
        self.identity: tuple[str | None, str | None] = (None, None)
        """Device and firmware last known."""
        self._view = view
        self.flags: dict[str, tuple[int, int | None]] = {}
        """Flags: column, and the bit in an error word (None: a signal of its own)."""
        self._bits = protocol.bits
        for at, column in enumerate(view.reader.columns):
            if column.esc == index and column.source in self._bits:
                self.flags.setdefault(column.source, (at, None))
            elif column.esc == index:
                self.columns.setdefault(column.source, at)
        for word, bits in protocol.errors.items():
            for bit in bits if word in self.columns else ():
                self.flags.setdefault(bit.text, (self.columns[word], int(bit)))
        self.live = [at for name, at in self.columns.items() if VALUES[name].group is Group.LIVE]
        self._state = _first_of(self.columns, "operating_state", "operating_state_raw")
        self._kinds = self._kinds_of_values()

    def heard(self, now: int) -> None:
        """Note that a live value has come."""
        self.heard_ns = now
        if self.first_heard_ns is None:
            self.first_heard_ns = now

    def is_available(self, now: int) -> bool:
        """True while frames of the gateway, or live values of the ESC, come."""
        if self.index is None:
            last = self._view.last_ns
            return last is not None and now - last <= SILENCE_NS
        checked = self.live or list(self.columns.values())
        return any(self._view.values[at] is not None for at in checked)

    def notable(self, now: int) -> tuple[object, ...]:
        """The values whose change is published at once."""
        if self.index is None:
            return self.is_available(now), self._value("can_state"), self._value("gateway_state")
        errors, selftest = self._flags_set("operating_errors"), self._flags_set("selftest_errors")
        return self.is_available(now), errors, selftest, self._kind(), self._value("link_state")

    def state(self, now: int) -> dict[str, Any]:
        """All values as JSON."""
        heard = self._view.last_ns if self.index is None else self.heard_ns
        age = None if heard is None else (now - heard) // MS
        made: dict[str, Any] = {"available": self.is_available(now), "age": age}
        if self.index is not None:
            errors = self._flags_set("operating_errors")
            problem = None if errors is None else any(map(self._is_error, errors))
            made |= {"motor": self._kind(), "errors": self._in_words(errors), "problem": problem}
            made |= {
                "selftest": self._in_words(self._flags_set("selftest_errors")),
                "link_state": None,
            }
        for source, at in self.columns.items():
            made[source] = self._view.values[at]
        if self.index is not None:
            made["firmware"] = self._firmware()
        return made

    def update_identity(self) -> None:
        """Note device and firmware; what was known stays, so that it is never shown as unknown again."""
        device, firmware = self.identity
        if isinstance(text := self._value("device"), str):
            devices = self._protocol.devices.values()
            device = next((each for each in devices if normalize(each) == normalize(text)), text)
        self.identity = device, self._firmware() or firmware

    def _value(self, source: str) -> Value:
        at = self.columns.get(source)
        return None if at is None else self._view.values[at]

    def _firmware(self) -> str | None:
        parts = self._value("firmware_main"), self._value("firmware_sub")
        return f"{parts[0]}.{parts[1]}" if all(isinstance(part, int) for part in parts) else None

    def _kind(self) -> str | None:
        return None if self._state is None else self._kinds.get(self._view.values[self._state])

    def _kinds_of_values(self) -> Mapping[Value, str]:
        """The kind of each value that the operating state's signal can have."""
        states = self._protocol.states
        if (at := self.columns.get("operating_state")) is None:
            return {number: state.kind for number, state in states.items() if state.kind}
        # by name, since the raw values of a value table may differ from the ESC's numbers
        known = {normalize(state.text): state.kind for state in states.values() if state.kind}
        texts = [text for _, text in self._view.reader.columns[at].texts]
        return {text: known[normalize(text)] for text in texts if normalize(text) in known}

    def _flags_set(self, word: str) -> tuple[str, ...] | None:
        """Names of the flags that are set; None while they are not valid: flags have no 'not available'."""
        values = self._view.values
        if not any(values[at] is not None for at in self._witnesses(word)):
            return None
        found = []
        bits = {bit.text for bit in self._protocol.errors.get(word, ())}
        for flag, (at, bit) in self.flags.items():
            value = values[at]
            if flag not in bits or not isinstance(value, int):
                continue
            if value if bit is None else value >> bit & 1:
                found.append(flag)
        return tuple(found)

    def _witnesses(self, word: str) -> Sequence[int]:
        """Columns one of which is available while flags are valid: state or device, else all of their group."""
        if word == "operating_errors":
            named, others = ("operating_state", "operating_state_raw"), self.live
        else:
            named = ("device", "device_raw")
            others = [at for s, at in self.columns.items() if VALUES[s].group is Group.INFO]
        return [self.columns[source] for source in named if source in self.columns] or others

    def _is_error(self, flag: str) -> bool:
        """True for an error; false for a warning or a status."""
        return self._bits[flag].severity is Severity.ERROR

    def _in_words(self, flags: Sequence[str] | None) -> list[dict[str, str]] | None:
        if flags is None:
            return None
        bits = [self._bits[flag] for flag in flags]
        return [
            {"name": bit.text, "severity": bit.severity.value, "meaning": bit.meaning}
            for bit in bits
        ]


def _first_of(columns: Mapping[str, int], *sources: str) -> int | None:
    return next((columns[source] for source in sources if source in columns), None)
