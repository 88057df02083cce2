"""The value table of a signal: texts of values, codes for "not available" and "error"."""

from typing import TYPE_CHECKING

from kontronik_can_gw.dbc.names import normalize

if TYPE_CHECKING:
    from cantools.database.can import Signal

_NOT_AVAILABLE = frozenset({"notavailable", "sna", "na", "signalnotavailable"})
_ERROR = frozenset({"error", "err", "invalid"})


class ValueTable:
    """A value table by raw value, and by normalized text."""

    def __init__(self, signal: "Signal") -> None:
        self.entries = {int(raw): str(text) for raw, text in (signal.choices or {}).items()}
        self.codes = {normalize(text): raw for raw, text in self.entries.items()}
        self.not_available = self._first(_NOT_AVAILABLE)
        self.error = self._first(_ERROR)
        self.special = [raw for text, raw in self.codes.items() if text in _NOT_AVAILABLE | _ERROR]
        """Raw values that are codes and no values."""
        self.texts = {
            raw: text
            for raw, text in self.entries.items()
            if normalize(text) not in _NOT_AVAILABLE | _ERROR
        }
        """Entries that are values."""

    def _first(self, texts: frozenset[str]) -> int | None:
        return next((raw for text, raw in self.codes.items() if text in texts), None)
