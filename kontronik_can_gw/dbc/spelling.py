"""Rewrites what other tools write in a DBC and cantools does not understand, before cantools reads it."""

import re
from collections.abc import Mapping, Sequence

from kontronik_can_gw.dbc.bounds import STRING
from kontronik_can_gw.errors import UserError

_PAIRS = r'(?:[^\s";]+\s+"\0\d+\0"\s*)*'
"""Values and their masked texts. Not simply up to a semicolon: NS_ lists keywords without one."""
_NAME = r'("\0\d+\0")'
"""A masked string, such as an attribute's name."""
_MASKED = re.compile(r'"\0(\d+)\0"')
_TABLE = re.compile(rf"^[ \t]*VAL_TABLE_\s+(\w+)\s+({_PAIRS});", re.MULTILINE)
_MESSAGE_OR_SIGNAL = re.compile(r"^[ \t]*(?:BO_\s+0*(\d+)\s+\w+\s*:|SG_\s+(\w+))", re.MULTILINE)
_OF_SIGNAL = re.compile(
    r"^(?P<head>[ \t]*(?P<keyword>VAL_|SIG_VALTYPE_)\s+(?:(?P<message>\d+)\s+)?(?P<signal>[A-Za-z_]\w*+)\s*+)"
    rf"(?P<body>{_PAIRS}|[A-Za-z_]\w*\s*|:?\s*\d+\s*);",
    re.MULTILINE,
)
_DEFINITION = re.compile(rf"^[ \t]*BA_DEF_\s+(?:\w+\s+)?{_NAME}", re.MULTILINE)
_ATTRIBUTE = re.compile(rf"^[ \t]*(BA_|BA_DEF_DEF_)\s+{_NAME}[^;\n]*;", re.MULTILINE)
_ENUMERATION = re.compile(
    rf"^[ \t]*BA_DEF_\s+(?:BO_\s+|SG_\s+|BU_\s+|EV_\s+)?{_NAME}\s+ENUM\s+([^;]*)", re.MULTILINE
)
_TEXT_VALUE = re.compile(rf"^([ \t]*BA_\s+){_NAME}(\s[^\";]*){_NAME}(\s*;)", re.MULTILINE)


def spelled_out(text: str, path: str) -> tuple[str, Mapping[str, Sequence[str]]]:
    """The text of a DBC for cantools: a VAL_ that names a VAL_TABLE_, and enumeration attributes given by text, are written out.

    Entries for missing signals, tables and attributes are removed and returned by reason; cantools would refuse the whole file.
    UserError for a text that the attribute's enumeration lacks.
    """
    rewriting = _Rewriting(text, path)
    rewriting.write_out_tables()
    rewriting.remove_undefined_attributes()
    rewriting.number_enumerations()
    return rewriting.shown(rewriting.text), rewriting.ignored


class _Rewriting:
    """One text. Its strings are masked meanwhile, so that comments and value texts stay unchanged and lines keep their numbers."""

    def __init__(self, text: str, path: str) -> None:
        self._path = path
        self._strings: list[str] = []
        self.ignored: dict[str, list[str]] = {}
        """Reason to what was removed for it."""
        self.text = re.sub(STRING, self._mask, text)

    def _mask(self, found: re.Match[str]) -> str:
        self._strings.append(found[0])
        return f'"\0{len(self._strings) - 1}\0"'

    def shown(self, masked: str) -> str:
        """A text with its strings."""
        return _MASKED.sub(lambda found: self._strings[int(found[1])], masked)

    def _without(self, entry: re.Match[str], reason: str, what: str) -> str:
        self.ignored.setdefault(reason, []).append(self.shown(what))
        return "\n" * entry[0].count("\n")

    def write_out_tables(self) -> None:
        """Replace names of value tables by the tables; remove entries of signals and tables that are not in the file."""
        tables = dict(_TABLE.findall(self.text))
        signals: set[tuple[str, str]] = set()
        message = ""
        for found in _MESSAGE_OR_SIGNAL.finditer(self.text):
            message = found[1] or message
            signals.add((message, found[2]))

        def rewritten(found: re.Match[str]) -> str:
            keyword, number, name, body = found.group("keyword", "message", "signal", "body")
            what = f"{keyword} {number or ''} {name}".replace("  ", " ")
            if number is not None and (number.lstrip("0") or "0", name) not in signals:
                return self._without(found, "for signals that are not in the file", what)
            table = body.strip()
            if keyword != "VAL_" or not re.fullmatch(r"[A-Za-z_]\w*", table):
                return found[0]
            if table not in tables:
                reason = "naming a VAL_TABLE_ that is not in the file"
                return self._without(found, reason, f"{what} {table}")
            return f"{found['head']}{tables[table]};"

        self.text = _OF_SIGNAL.sub(rewritten, self.text)

    def remove_undefined_attributes(self) -> None:
        """Remove values and defaults of attributes that have no BA_DEF_."""
        defined = {self.shown(name) for name in _DEFINITION.findall(self.text)}

        def rewritten(found: re.Match[str]) -> str:
            if self.shown(found[2]) in defined:
                return found[0]
            reason = "of attributes that no BA_DEF_ defines"
            return self._without(found, reason, f"{found[1]} {found[2]}")

        self.text = _ATTRIBUTE.sub(rewritten, self.text)

    def number_enumerations(self) -> None:
        """Replace the texts of enumeration attributes by their numbers."""
        numbers = {
            self.shown(name): {
                self.shown(value[0]): str(number)
                for number, value in enumerate(_MASKED.finditer(values))
            }
            for name, values in _ENUMERATION.findall(self.text)
        }

        def rewritten(found: re.Match[str]) -> str:
            name, value = self.shown(found[2]), self.shown(found[4])
            known = numbers.get(name)
            if known is None:
                return found[0]
            if value not in known:
                raise UserError(
                    f"{self._path}: attribute {name}: {value} is none of its values {', '.join(known)}"
                )
            return f"{found[1]}{found[2]}{found[3]}{known[value]}{found[5]}"

        self.text = _TEXT_VALUE.sub(rewritten, self.text)
