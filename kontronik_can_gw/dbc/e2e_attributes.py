"""Reads the attributes that state end-to-end protection in a DBC.

Vector's rules for communication descriptions and OEM templates define them: E2EProfile, E2EDataId
(or E2EDataIds, DataIds) and E2EDataLength of a message or its signals, and GenSigFuncType of a
signal. Case and underscores in their names do not matter. Further names of data IDs are read, too,
if their numbers fit the profile.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.dbc import names
from kontronik_can_gw.dbc.reader import attribute
from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.signals.e2e import PROFILES, Profile
from kontronik_can_gw.signals.plan import Role

if TYPE_CHECKING:
    from cantools.database.can import Database, Message, Signal

_PROFILE = frozenset({"e2eprofile"})
_DATA_IDS = frozenset({"e2edataid", "e2edataids", "e2edataidlist", "dataids", "dataidlist"})
_LIKELY_DATA_IDS = frozenset({"dataid", "e2eid", "e2edataidentifier", "e2edataidentifiers"})
"""Names that usually mean data IDs, but that no rule defines."""
_LENGTH = frozenset({"e2edatalength"})
_FUNCTION = frozenset({"gensigfunctype", "sigfunctype"})
_UNPROTECTED = frozenset({"", "none", "no", "off", "noprofile", "notused", "unused", "0"})
"""Profiles that mean no protection."""
_PROFILE_TEXT = re.compile("(?:autosar)?(?:e2e)?(?:profile|p)?(?:ar)?0*([1-9][0-9]?)([a-c]?)")
"""A normalized spelling of a profile: P01, PROFILE_05, E2E_P11C, Profile 22, PROFILE_AR_01A."""
_COUNTER_FUNCTIONS = frozenset({"snc", "sc", "cntr", "counter"})
_FUNCTION_NUMBERS = {1: Role.ALIVE, 2: Role.CRC}
"""Meanings of a GenSigFuncType that is a number without texts."""


class UnclearAttribute(ValueError):
    """The reason why an attribute cannot be used. It begins with the attribute's name."""


def profile_of(message: "Message", database: "Database") -> Profile | None:
    """Return the profile that the DBC states for a message, or None.

    A default value applies only to a message that has its own data ID. Raises UnclearAttribute if
    the profile is not supported.
    """
    found = _values(message, database, _PROFILE)
    if not found and data_ids_of(message, database) is not None:
        found = [*_defaults(database, _PROFILE)]
    profiles = {normalize(str(text)): (name, text) for name, text in found}
    stated = [entry for key, entry in profiles.items() if key not in _UNPROTECTED]
    if not stated:
        return None
    if len(stated) > 1:
        texts = ", ".join(repr(text) for _, text in stated)
        raise UnclearAttribute(f"{stated[0][0]} has several values: {texts}.")
    ((attribute_name, text),) = stated
    match = _PROFILE_TEXT.fullmatch(normalize(str(text)))
    name = match[1] + match[2].upper() if match else ""
    profile = (PROFILES | {"1": PROFILES["1A"]}).get(name)
    if profile is None:
        known = ", ".join(PROFILES)
        raise UnclearAttribute(
            f"{attribute_name} is {str(text)[:40]!r}, which is none of the profiles {known}."
        )
    return profile


def unprotected(message: "Message", database: "Database") -> str | None:
    """Return the text with which the DBC states that a message has no profile, or None."""
    found = [str(text) for _, text in _values(message, database, _PROFILE)]
    stated = [text for text in found if normalize(text)]
    if stated and all(normalize(text) in _UNPROTECTED for text in stated):
        return stated[0]
    return None


def data_ids_of(message: "Message", database: "Database") -> tuple[int, ...] | None:
    """Return the data IDs that the DBC states for a message, or None.

    They are a number or a text with numbers. Raises UnclearAttribute for another text.
    """
    return _numbers(_values(message, database, _DATA_IDS))


def likely_data_ids_of(
    message: "Message", database: "Database"
) -> tuple[str, str, tuple[int, ...] | None] | None:
    """Return name, text and numbers of an attribute that usually means data IDs, or None.

    The numbers are None if they are unclear.
    """
    found = _values(message, database, _LIKELY_DATA_IDS)
    if not found:
        return None
    name, value = found[0]
    try:
        return name, str(value), _numbers(found)
    except UnclearAttribute:
        return name, str(value), None


def _numbers(attributes: Sequence[tuple[str, Any]]) -> tuple[int, ...] | None:
    """Return the numbers in the only value of these attributes. None without attributes.

    Raises UnclearAttribute for several values, and for another text than numbers.
    """
    found = {str(value): name for name, value in attributes}
    if not found:
        return None
    if len(found) > 1:
        name = next(iter(found.values()))
        raise UnclearAttribute(f"{name} has several values: {', '.join(found)}.")
    ((text, name),) = found.items()
    numbers = re.findall("0[xX][0-9a-fA-F]+|[0-9]+", text)
    rest = re.sub(r"0[xX][0-9a-fA-F]+|[0-9]+|[\s,;()\[\]{}]", "", text)
    if rest or not numbers:
        raise UnclearAttribute(f"{name} is {text[:80]!r}, which is no list of numbers.")
    return tuple(int(number, 16 if number[:2] in ("0x", "0X") else 10) for number in numbers)


def with_data_ids(attributes: Mapping[str, object], data_ids: Sequence[int]) -> dict[str, object]:
    """Return attributes of a message or signal with other data IDs, if they contain data IDs.

    Numbers stay numbers, and texts become decimal lists.
    """
    changed = dict(attributes)
    for name, value in attributes.items():
        if normalize(name) in _DATA_IDS | _LIKELY_DATA_IDS:
            is_number = isinstance(value, (int, float)) and len(data_ids) == 1
            changed[name] = data_ids[0] if is_number else ", ".join(map(str, data_ids))
    return changed


def remove_data_ids(message: "Message", only_likely: bool) -> None:
    """Remove a message's data IDs, or only those in attributes that no rule defines."""
    wanted = _LIKELY_DATA_IDS if only_likely else _LIKELY_DATA_IDS | _DATA_IDS
    owners: list[Any] = [message, *message.signals]
    for owner in owners:
        for name in _own_names(owner, wanted):
            del owner.dbc.attributes[name]


def protected_bits_of(message: "Message", database: "Database") -> int | None:
    """Return the protected length in bits that the DBC states for a message, or None."""
    for _, value in _values(message, database, _LENGTH):
        if isinstance(value, (int, float)) and value:
            return int(value)
    return None


def role_of(signal: "Signal", database: "Database") -> Role | None:
    """Return ALIVE or CRC if the DBC states that a signal is a frame counter or a checksum."""
    for name in _own_names(signal, _FUNCTION):
        value = attribute(signal, name, database)
        if isinstance(value, str):
            if normalize(value) in _COUNTER_FUNCTIONS:
                return Role.ALIVE
            return names.protection(value)
        return _FUNCTION_NUMBERS.get(value)
    return None


def _own_names(owner: Any, wanted: frozenset[str]) -> list[str]:
    """Return the names of an owner's attributes whose normalized name is wanted."""
    attributes = owner.dbc.attributes if owner.dbc else {}
    return [name for name in attributes if normalize(name) in wanted]


def _values(
    message: "Message", database: "Database", wanted: frozenset[str]
) -> list[tuple[str, Any]]:
    """Return names and values of an attribute of a message, or else of its signals."""
    for owners in ([message], message.signals):
        found = []
        for owner in owners:
            for name in _own_names(owner, wanted):
                found.append((name, attribute(owner, name, database)))
        if found:
            return found
    return []


def _defaults(database: "Database", wanted: frozenset[str]) -> Iterator[tuple[str, Any]]:
    """Yield names and defaults of the definitions of an attribute."""
    definitions = database.dbc.attribute_definitions if database.dbc else {}
    for name, definition in definitions.items():
        if normalize(name) in wanted and definition.default_value is not None:
            yield name, definition.default_value
