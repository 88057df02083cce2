"""Finds the end-to-end protection of a message, and checks that the message fits the profile.

In this order: [dbc.e2e], the attributes of the DBC, [dbc.e2e_data_ids] alone, and the names of CRC
and counter.
"""

import contextlib
import fnmatch
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.dbc import e2e_attributes
from kontronik_can_gw.dbc.copies import Copy
from kontronik_can_gw.dbc.e2e_attributes import UnclearAttribute
from kontronik_can_gw.dbc.names import is_e2e
from kontronik_can_gw.dbc.reader import is_matched, listed
from kontronik_can_gw.dbc.signal_compiler import Compilation
from kontronik_can_gw.signals.e2e import DATA_IDS, PROFILES, DataIdMode, Profile, Protection
from kontronik_can_gw.signals.plan import MessagePlan, Piece, Role, SignalPlan

if TYPE_CHECKING:
    from cantools.database.can import Database

_DEFAULT = PROFILES["1A"]
"""The profile of a message whose configuration names only a data ID."""


def stated_protection(job: Compilation, copy: Copy) -> Protection | None:
    """Return the protection that configuration or DBC state for a message. None if neither does.

    Adds a line to ``job.problems`` for a statement that is unclear or incomplete. A protection
    without its data ID is returned nevertheless, so that the message's signals can be checked.
    """
    try:
        profile, is_of_dbc = stated_profile(job.settings, job.database, copy)
        if profile is None:
            return None
        data_ids = stated_data_ids(job.settings, job.database, copy, profile)
    except UnclearAttribute as error:
        job.problems.append(
            f"{copy.message.name}: {error} Name the profile: {_profile_key(copy)}, "
            "or leave the message out (dbc.messages)."
        )
        job.protected.update(keys_of(copy, tuple(job.settings.e2e)))
        return None
    if is_of_dbc:
        job.problems += _length_problems(job, copy)
    job.problems += _data_id_problems(copy, profile, data_ids)
    return Protection(profile, data_ids or (0,))


def keys_of(copy: Copy, patterns: Sequence[str]) -> list[str]:
    """Return the keys of [dbc.e2e] that apply to a message, the most specific one first."""
    both = (copy.name, copy.message.name)
    named = [name for name in both if name in patterns]
    matching = [each for each in patterns if any(fnmatch.fnmatchcase(name, each) for name in both)]
    return list(dict.fromkeys([*named, *matching]))


def _profile_key(copy: Copy, name: str = "11C") -> str:
    return f'dbc.e2e.{copy.name} = "{name}"'


def stated_profile(
    settings: DbcConfig,
    database: "Database",
    copy: Copy,
) -> tuple[Profile | None, bool]:
    """Return the profile, and True if it is from an attribute of the DBC."""
    for key in keys_of(copy, tuple(settings.e2e)):
        return PROFILES[settings.e2e[key]], False
    profile = e2e_attributes.profile_of(copy.message, database)
    if profile is not None:
        return profile, True
    return (_DEFAULT if copy.name in settings.e2e_data_ids else None), False


def stated_data_ids(
    settings: DbcConfig,
    database: "Database",
    copy: Copy,
    profile: Profile,
) -> tuple[int, ...]:
    """Return the data IDs of a message. Empty if they are not stated.

    The DBC's data ID is not used for copies for several ESCs, because a data ID identifies one
    message. The default of profile 1A is the CAN id. Raises UnclearAttribute.
    """
    configured = settings.e2e_data_ids.get(copy.name)
    if configured is not None:
        return (configured,) if isinstance(configured, int) else tuple(configured)
    if not copy.prefix:
        found = e2e_attributes.data_ids_of(copy.message, database)
        if found is not None:
            return found
        likely = e2e_attributes.likely_data_ids_of(copy.message, database)
        if likely is not None and _is_usable(likely[2], profile):
            return likely[2] or ()
    return _can_id_as_data_id(copy) if profile.name == _DEFAULT.name else ()


def assumed_data_ids(settings: DbcConfig, database: "Database", copy: Copy) -> tuple[int, ...]:
    """Return the data ID of a message whose profile 1A is only assumed.

    It is the DBC's data ID, or the CAN id if that cannot be used.
    """
    try:
        found = stated_data_ids(settings, database, copy, _DEFAULT)
    except UnclearAttribute:
        return _can_id_as_data_id(copy)
    return found if _is_usable(found, _DEFAULT) else _can_id_as_data_id(copy)


def remove_later_data_ids(database: "Database", settings: DbcConfig) -> None:
    """Remove the data IDs that 0.5.0 did not use, so that its captures replay as they were sent.

    0.5.0 used only the attributes that a rule defines, and only of messages with a profile.
    """
    for message in database.messages:
        has_profile = is_matched(message.name, settings.e2e)
        with contextlib.suppress(UnclearAttribute):
            has_profile = has_profile or e2e_attributes.profile_of(message, database) is not None
        e2e_attributes.remove_data_ids(message, only_likely=has_profile)


def _is_usable(data_ids: Sequence[int] | None, profile: Profile) -> bool:
    """Return True for data IDs of a number and size that the profile needs."""
    if data_ids is None or len(data_ids) != profile.ids:
        return False
    return max(data_ids) <= profile.largest_id


def _can_id_as_data_id(copy: Copy) -> tuple[int, ...]:
    return (copy.frame_id & 0xFFFF,)


def _data_id_warnings(
    job: Compilation, copy: Copy, sent: Protection, *, has_warned: bool
) -> Iterator[str]:
    """Yield a warning if the DBC states a data ID that is not used, or one of an unusual name.

    An earlier warning (``has_warned``) already asks to confirm the data ID that is sent.
    """
    if copy.name in job.settings.e2e_data_ids:
        return
    name = "E2EDataId"
    try:
        stated = e2e_attributes.data_ids_of(copy.message, job.database)
        text = " ".join(f"0x{data_id:X}" for data_id in stated or ())
    except UnclearAttribute as error:
        stated, text = (), str(error)
    if stated is None:
        likely = e2e_attributes.likely_data_ids_of(copy.message, job.database)
        if likely is None:
            return
        name, text, stated = likely
    key = f"dbc.e2e_data_ids.{copy.name}"
    used = ", ".join(f"0x{data_id:X}" for data_id in sent.data_ids)
    value = used if len(sent.data_ids) == 1 else f"[{used}]"
    if stated == sent.data_ids:
        if name != "E2EDataId" and not has_warned:
            yield (
                f"{copy.message.name}: sent with the data ID of the attribute {name}, {text[:80]}. "
                f"To confirm this, set {key} = {value}"
            )
        return
    reason = "it does not fit the profile"
    if copy.prefix:
        reason = "each ESC's copy of the message needs its own"
    yield (
        f"{copy.message.name}: {copy.name} is sent with the data ID {value}, not with the "
        f"{name} of the DBC, {text[:80]}, because {reason}. Receivers must expect {value}: to "
        "confirm or change it, "
        f"set {key} = {value}"
    )


def shared_data_ids(plans: Sequence[MessagePlan]) -> Iterator[str]:
    """Yield a warning for each data ID of several messages, which receivers cannot tell apart."""
    users: dict[tuple[int, ...], list[str]] = {}
    for plan in plans:
        if plan.e2e is not None:
            users.setdefault(plan.e2e.data_ids, []).append(plan.name)
    for data_ids, names in users.items():
        if len(names) > 1:
            shown = ", ".join(f"0x{data_id:X}" for data_id in data_ids)
            yield (
                f"{listed(names)} have the same data ID, {shown}, so a receiver does not "
                "notice if one is received instead of another. Give each its own: "
                f"dbc.e2e_data_ids.{names[-1]}"
            )


def _data_id_problems(copy: Copy, profile: Profile, data_ids: Sequence[int]) -> Iterator[str]:
    key = f"dbc.e2e_data_ids.{copy.name}"
    example = f"{key} = [1, 2, …]" if profile.ids > 1 else f"{key} = 0x123"
    needed = f"{DATA_IDS} data IDs, one for each counter" if profile.ids > 1 else "one data ID"
    if len(data_ids) != profile.ids:
        found = f"has {len(data_ids)}" if data_ids else "has none"
        yield (
            f"{copy.message.name}: E2E profile {profile.name} needs {needed}; it {found}. Set "
            f"{example}."
        )
        return
    for data_id in data_ids:
        if data_id > profile.largest_id:
            yield (
                f"{copy.message.name}: the data ID 0x{data_id:X} is too large for E2E profile "
                f"{profile.name}, at most 0x{profile.largest_id:X}. Set {example}."
            )
            return


def _length_problems(job: Compilation, copy: Copy) -> Iterator[str]:
    bits = e2e_attributes.protected_bits_of(copy.message, job.database)
    if bits not in (None, copy.message.length * 8):
        yield (
            f"{copy.message.name}: E2EDataLength is {bits} bits of {copy.message.length * 8}. "
            "Only a message that is protected as a whole can be sent. To confirm this, set "
            f"{_profile_key(copy)}."
        )


def message_protection(
    job: Compilation,
    copy: Copy,
    signals: Sequence[SignalPlan],
    stated: Protection | None,
) -> Protection | None:
    """Return the protection of a compiled message. None if it has no CRC.

    Adds lines to ``job.problems`` if its signals do not fit, and a warning if the profile is
    assumed because of the signals' names.
    """
    crcs = [signal for signal in signals if signal.role is Role.CRC]
    alive = [signal for signal in signals if signal.role is Role.ALIVE]
    if len(crcs) > 1:
        names = ", ".join(signal.name for signal in crcs)
        job.problems.append(
            f"{copy.message.name}: has several CRC signals: {names}. Bind all but one to constants."
        )
    if not crcs and stated is not None and not _is_replaced(job, copy):
        job.problems.append(
            f"{copy.message.name}: its E2EProfile needs a CRC, but no signal is known to be one. "
            'Bind it: dbc.bind.SIGNAL = "crc".'
        )
    if len(crcs) != 1:
        return None
    job.protected.update(keys_of(copy, tuple(job.settings.e2e)))
    (crc,) = crcs
    found = stated
    warnings_before = len(job.warnings)
    if found is None:
        found = _assumed(job, copy, crc, alive)
    if found is None:
        job.problems.append(
            f"{copy.message.name}.{crc.name}: the DBC does not define how this checksum is "
            f"computed. Name its AUTOSAR E2E profile ({', '.join(PROFILES)}): "
            f"{_profile_key(copy, '2')}. "
            f"Profile 1A is also chosen by {_data_id_key(copy, copy.frame_id & 0xFFFF)}. "
            "Otherwise bind it to a constant, if receivers take "
            "one, or leave the message out (dbc.messages)."
        )
        return None
    job.problems += _fit_problems(copy, found.profile, crc, alive, signals)
    has_warned = len(job.warnings) > warnings_before
    job.warnings += _data_id_warnings(job, copy, found, has_warned=has_warned)
    length = copy.message.length
    if length > found.profile.max_bytes:
        job.warnings.append(
            f"{copy.message.name}: has {length} bytes, but AUTOSAR allows at most "
            f"{found.profile.max_bytes} for E2E profile {found.profile.name}, so its "
            "receivers may refuse it. "
            "Shorten it, or use profile 5 (up to 4096 bytes)"
        )
    return found


def _is_replaced(job: Compilation, copy: Copy) -> bool:
    """Return True if the configuration explains why a message of a profile has no CRC.

    It names the message itself, or it binds a signal to a constant.
    """
    settings = job.settings
    if keys_of(copy, tuple(settings.e2e)) or copy.name in settings.e2e_data_ids:
        return True
    bound = [job.binder.bound(copy, signal.name) for signal in copy.message.signals]
    return any(isinstance(each, (int, float)) for each in bound)


def _data_id_key(copy: Copy, data_id: int) -> str:
    return f"dbc.e2e_data_ids.{copy.name} = 0x{data_id:X}"


def _assumed(
    job: Compilation, copy: Copy, crc: SignalPlan, alive: Sequence[SignalPlan]
) -> Protection | None:
    """Return profile 1A for a CRC that is bound to "crc", or that has a well-known name."""
    own = crc.name.removeprefix(copy.prefix)
    data_ids = assumed_data_ids(job.settings, job.database, copy)
    protection = Protection(_DEFAULT, data_ids)
    if job.binder.bound(copy, own) is not None:
        return protection
    if len(alive) != 1 or [*_fit_problems(copy, _DEFAULT, crc, alive, ())]:
        return None
    counter = alive[0].name.removeprefix(copy.prefix)
    if not is_e2e(own, str(job.binder.bound(copy, counter) or counter)):
        return None
    stated = e2e_attributes.unprotected(copy.message, job.database)
    although = "" if stated is None else f", although its E2EProfile is {stated!r}"
    job.warnings.append(
        f"{copy.message.name}.{crc.name}: sent as AUTOSAR E2E profile 1{although}. To confirm "
        f"this, set {_data_id_key(copy, data_ids[0])}"
    )
    return protection


def _fit_problems(
    copy: Copy,
    profile: Profile,
    crc: SignalPlan,
    alive: Sequence[SignalPlan],
    signals: Sequence[SignalPlan],
) -> Iterator[str]:
    """Yield the problems of signals that do not fit the profile."""
    title = f"E2E profile {profile.name}"
    at = crc.pieces[0].at
    if at % 8 or crc.pieces != (Piece(0, profile.crc_bits, at),):
        order = ", the low byte first" if profile.crc_bits > 8 else ""
        yield (
            f"{copy.message.name}.{crc.name}: an {title} CRC needs {profile.crc_bits} bits on "
            f"a byte border{order}."
        )
        return
    if profile.crc_byte not in (None, at // 8):
        yield (
            f"{copy.message.name}.{crc.name}: an {title} CRC is in byte {profile.crc_byte}, "
            f"not in byte {at // 8}. Profile 22 allows any byte."
        )
    most = profile.counters - 1
    if len(alive) != 1 or alive[0].high < most:
        yield (
            f"{copy.message.name}: {crc.name}: {title} needs exactly one alive counter, 0 to "
            f"{most}, in the message."
        )
    elif profile.counter_bits is not None:
        wanted = Piece(0, profile.counter_bits, at + profile.crc_bits)
        if alive[0].pieces != (wanted,):
            yield (
                f"{copy.message.name}.{alive[0].name}: an {title} counter is in bits 0 to "
                f"{wanted.width - 1} of the byte after the CRC, here byte {wanted.at // 8}."
            )
    nibbles = [signal for signal in signals if signal.role is Role.DATA_ID]
    if len(nibbles) != (profile.mode is DataIdMode.NIBBLE):
        yield (
            f"{copy.message.name}: {title} sends 4 bits of the data ID, but no signal is "
            "known to contain "
            'them. Bind it: dbc.bind.SIGNAL = "data_id".'
        )
    for nibble in nibbles:
        if (nibble.length, nibble.page, nibble.is_float) != (4, None, False):
            yield (
                f"{copy.message.name}.{nibble.name}: has to be 4 bits of every frame, for {title}."
            )
