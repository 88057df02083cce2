"""Removes passwords and keys from text. Pure.

A text can hold a secret in four ways, and each has a rule:

1. It has a telling name: ``password = hunter2``. The rest of the line is removed, because a
   password may contain blanks. ``is_secret_name`` recognises the names.
2. It has a typical form: user and password in a URL, a private key, a token with a known beginning.
3. The configuration contains it: user name and password of the broker. ``known`` has these values.
   They are removed everywhere.
4. No rule can recognise it, because a person has written it in a sentence. So comments are removed
   as a whole (files.py).

It is better to remove too much than too little.
"""

import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any
from urllib.parse import quote

REMOVED = "<removed>"
_PARTS_OF_NAMES = re.compile(
    "passw|passphrase|passcode|kennwort|secret|geheim|credential|zugangsdaten|token|apikey"
    "|accesskey|sharedkey|privatekey|schlüssel|schluessel|losung"
)
"""A name that contains one of these, without dashes and underscores, marks a secret."""
_WORDS_OF_NAMES = frozenset(
    {
        *("key", "keys", "keyfile", "psk", "pass", "pw", "pwd", "pin", "puk"),
        *("auth", "authorization", "bearer", "login"),
        *("user", "username", "benutzer", "benutzername"),
    }
)
"""A name with one of these words marks a secret. Some brokers use a token as user name."""
_WORD = re.compile(r"[A-ZÄÖÜ]+(?![a-zäöü])|[A-ZÄÖÜ]?[a-zäöüß]+|[0-9]+")
_NAME_AND_VALUE = re.compile(
    r"(?<![\wÀ-ÿ.-])(?P<name>[\wÀ-ÿ.-]+)[\"'\]]*\s*(?::=|=>?|:(?!//))[\"'\[(]*\s*(?=\S)"
    r"|(?<!\S)--?(?P<option>[\w-]+)[ \t]+(?=\S)"
)
_PASSWORD_FILE = re.compile(r"(?m)^[^\n]*?(?=: (?:the password (?:cannot|is)|has no password))")
"""The name of a password file in our own errors. A user may write the password itself there."""
_FORMS = {
    "private key": re.compile(
        r"-----BEGIN [A-Z0-9 ]*PRIVATE KEY.*?(?:-----END [A-Z0-9 ]*PRIVATE KEY[A-Z ]*-----|\Z)"
        r"|AGE-SECRET-KEY-1[A-Z0-9]+",
        re.DOTALL,
    ),
    "user and password in a URL": re.compile(
        r"(?<=://)[^\s\"'<>]{0,1000}@"  # up to the last @, because a password may contain one
        r"|(?<=://)[^\n\"'<>@:]{0,200}:[^\n\"'<>@]{0,200}@"  # also with blanks
        r"|(?<![\w.@/%+-])[\w.%+-]{1,200}:[^\s\"'<>@/]{1,200}(?=@[\w\[])"
    ),
    "token": re.compile(
        r"\b(?:gh[pousr]_|github_pat_|glpat-|xox[abeoprs]-|sk-|pypi-|npm_|hf_|dop_v1_)[\w-]{16,}"
        r"|\b(?:AKIA|ASIA|AIza|ya29\.)[\w-]{12,}"
        r"|\beyJ[\w-]{6,}\.[\w-]{6,}(?:\.[\w-]*)?"
        r"|(?i:\b(?:bearer|basic)[ \t]+)[\w+/=.~-]{8,}"
    ),
    "excerpt of a DBC": re.compile(r"\"[^\n]*>>!<<[^\n]*"),
    "hexadecimal key": re.compile(
        r"\b(?:0x)?[0-9A-Fa-f]{32,}\b"
        r"|\b(?:0x)?[0-9A-Fa-f]{2}(?:[ ,:-]+(?:0x)?[0-9A-Fa-f]{2}){15,}\b"
    ),
}
_SHORT = 8
"""A shorter value is removed only as a whole word, because it may be a part of any word."""
_SHORTEST = 3
"""Values with fewer characters are removed only behind their names."""


def is_secret_name(name: str) -> bool:
    """Return True if a value with this name may be a password, a key, or a user's name."""
    words = [word.lower() for word in _WORD.findall(name)]
    joined = re.sub(r"[\W_]+", "", name).lower()
    return not _WORDS_OF_NAMES.isdisjoint(words) or _PARTS_OF_NAMES.search(joined) is not None


class Cleaner:
    """Removes secrets, and counts them for each part of the bundle.

    ``known`` maps values that must not leave the machine to their names.
    """

    def __init__(self, known: Mapping[str, str] | None = None) -> None:
        self.removed: dict[str, Counter[str]] = {}
        """For each part, how often each kind of secret was removed."""
        self._known = [
            (_pattern_of(value), name)
            for value, name in sorted((known or {}).items(), key=lambda row: -len(row[0]))
            if len(value) >= _SHORTEST
        ]

    def begin(self, part: str) -> None:
        """Reset the counts of a part that is about to be made again."""
        self.removed.pop(part, None)

    def count(self, part: str, kind: str, number: int = 1) -> None:
        """Count removed secrets of a kind."""
        if number:
            self.removed.setdefault(part, Counter())[kind] += number

    def text(self, text: str, part: str, *, with_hex: bool = True) -> str:
        """Return a text of any kind without secrets."""
        text = self.forms(text, part, with_hex=with_hex)
        if ": the password" in text or ": has no password" in text:
            text, number = _PASSWORD_FILE.subn(REMOVED, text)
            self.count(part, "file named as password file", number)
        return "".join(self._line(line, part) for line in text.splitlines(keepends=True))

    def forms(self, text: str, part: str, *, with_hex: bool = True) -> str:
        """Remove secrets that their form or their value shows, and keep everything else."""
        text = self.known(text, part)
        for kind, form in _FORMS.items():
            if with_hex or kind != "hexadecimal key":
                text, number = form.subn(
                    lambda found: f"{REMOVED}@" if found[0].endswith("@") else REMOVED, text
                )
                self.count(part, kind, number)
        return text

    def known(self, text: str, part: str) -> str:
        """Remove the known values."""
        for pattern, name in self._known:
            text, number = pattern.subn(REMOVED, text)
            self.count(part, f"value of {name}", number)
        return text

    def document(self, value: Any, part: str) -> Any:
        """Return a JSON value without secrets. The names in it stay."""
        if isinstance(value, Mapping):
            return {name: self._entry(name, entry, part) for name, entry in value.items()}
        if isinstance(value, list | tuple):
            return [self.document(entry, part) for entry in value]
        if isinstance(value, str):
            return self.text(value, part)
        return value

    def _entry(self, name: str, value: Any, part: str) -> Any:
        if value in (None, "") or isinstance(value, bool) or not is_secret_name(name):
            return self.document(value, part)
        self.count(part, name)
        return REMOVED

    def _line(self, line: str, part: str) -> str:
        """Remove the rest of a line after a secret's name."""
        for found in _NAME_AND_VALUE.finditer(line):
            name = found["name"] or found["option"]
            if is_secret_name(name) and not line.startswith(REMOVED, found.end()):
                self.count(part, "value behind a name such as password or key")
                end = line[len(line.rstrip("\r\n")) :]
                return f"{line[: found.end()]}{REMOVED}{end}"
        return line


def _pattern_of(value: str) -> re.Pattern[str]:
    """Return a pattern of all spellings of a value: as it is, escaped, or in a URL."""
    spellings: set[str] = set()
    # in captures, UTF-8 is read as Latin-1
    for text in (value, value.encode("utf-8", "replace").decode("latin-1")):
        spellings |= {text, quote(text, safe=""), quote(text), repr(text)[1:-1]}
        spellings |= {json.dumps(text)[1:-1], json.dumps(text, ensure_ascii=False)[1:-1]}
    longest_first = sorted(spellings, key=len, reverse=True)
    # a blank may have become the end of a line
    parts = "|".join(re.escape(each).replace(r"\ ", r"\s+") for each in longest_first)
    if len(value) < _SHORT:
        return re.compile(rf"(?<![^\W_])(?:{parts})(?![^\W_])")
    return re.compile(parts)


def values_of_secrets(tables: Any, path: str = "") -> Iterable[tuple[str, str]]:
    """Yield the values with secret names in TOML or JSON, each with its name."""
    if isinstance(tables, Mapping):
        for name, value in tables.items():
            place = f"{path}.{name}" if path else str(name)
            if is_secret_name(str(name)):
                yield from ((text, place) for text in _texts(value))
            else:
                yield from values_of_secrets(value, place)
    elif isinstance(tables, list):
        for value in tables:
            yield from values_of_secrets(value, path)


def _texts(value: Any) -> Iterable[str]:
    """Yield all texts and numbers in a value."""
    if isinstance(value, Mapping):
        for entry in value.values():
            yield from _texts(entry)
    elif isinstance(value, list):
        for entry in value:
            yield from _texts(entry)
    elif value is not None and not isinstance(value, bool):
        yield str(value)
