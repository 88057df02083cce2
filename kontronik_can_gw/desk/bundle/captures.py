"""Copies a capture without passwords, keys and comments. Pure.

Only the texts in its headers are changed, so the copy replays to the same frames. Damaged bytes,
and blocks of an unknown kind, cannot be checked. They are left out and counted.
"""

from collections.abc import Iterable, Iterator
from itertools import chain
from typing import Any

from kontronik_can_gw.capture.format import Damage, Scanner, block, json_payload, read_json
from kontronik_can_gw.desk.bundle.files import clean_dbc, clean_eds, clean_toml
from kontronik_can_gw.desk.bundle.secrets import Cleaner


def clean_capture(
    chunks: Iterable[bytes], part: str, cleaner: Cleaner, *, with_dbc: bool
) -> Iterator[bytes]:
    """Yield the bytes of a capture's copy. Without its DBC, a replay sends no messages of a DBC."""
    scanner = Scanner()
    for found in chain(chain.from_iterable(map(scanner.feed, chunks)), scanner.flush()):
        yield _clean(found, part, cleaner, with_dbc)


def _clean(found: Any, part: str, cleaner: Cleaner, with_dbc: bool) -> bytes:
    """Return a block without secrets. Empty if it must be left out."""
    if isinstance(found, Damage):
        cleaner.count(part, "damaged byte", found.length)
        return b""
    payload = found.payload
    if found.kind in (b"H", b"I"):
        try:
            content = read_json(payload)
        except ValueError:
            cleaner.count(part, "block that is not readable")
            return b""
        payload = json_payload(clean_header(content, part, cleaner, with_dbc=with_dbc))
    elif found.kind not in (b"D", b"E"):
        cleaner.count(part, "block of an unknown kind")
        return b""
    return block(found.kind, found.number, payload)


def clean_header(
    header: dict[str, Any], part: str, cleaner: Cleaner, *, with_dbc: bool
) -> dict[str, Any]:
    """Return a header or an information block without secrets."""
    made: dict[str, Any] = {}
    for name, value in header.items():
        if name == "configuration" and isinstance(value, str):
            made[name] = clean_toml(value, part, cleaner)
        elif name == "dbc" and isinstance(value, dict):
            made[name] = _clean_file(value, part, cleaner, clean_dbc) if with_dbc else None
            cleaner.count(part, "DBC", not with_dbc)
        elif name == "canopen" and isinstance(value, dict):
            made[name] = _clean_value(value, part, cleaner)
            if isinstance(value.get("eds"), dict):
                made[name]["eds"] = _clean_file(
                    value["eds"],
                    part,
                    cleaner,
                    clean_eds,
                )
        else:
            made[name] = _clean_value(value, part, cleaner)
    return made


def _clean_file(table: dict[str, Any], part: str, cleaner: Cleaner, clean: Any) -> dict[str, Any]:
    """Return the table of a file in the header, whose text is cleaned by a function."""
    made: dict[str, Any] = _clean_value(
        {key: value for key, value in table.items() if key != "text"}, part, cleaner
    )
    if "text" in table:
        made["text"] = clean(str(table["text"]), part, cleaner)
    return made


def _clean_value(value: Any, part: str, cleaner: Cleaner) -> Any:
    """Clean the texts in a value, and keep names and digests, which a replay needs."""
    if isinstance(value, dict):
        return {key: _clean_value(entry, part, cleaner) for key, entry in value.items()}
    if isinstance(value, list):
        return [_clean_value(entry, part, cleaner) for entry in value]
    if isinstance(value, str):
        return cleaner.text(value, part, with_hex=False)
    return value
