"""The CRCs of AUTOSAR E2E profiles, written a second time from PRS_E2EProtocol.

Only the numbers of a CRC are compared. The tests compare the computation of both cores with other
implementations, and with the examples of the standard.
"""

from typing import Any, NamedTuple

from kontronik_can_gw.signals.e2e import Protection

_COUNTERS = 16
"""Number of entries of ``CrcRule.data_ids``."""


class CrcRule(NamedTuple):
    """The numbers that define the CRC of a message."""

    polynomial: int
    bits: int
    start: int
    final_xor: int
    id_bytes: int
    """Number of bytes of a data ID in the CRC."""
    is_id_last: bool
    """True if the data ID follows the frame, False if it precedes the frame."""
    data_ids: tuple[int, ...]
    """The bytes of the data ID as a number, for each counter modulo 16."""


COUNTERS = {"1A": 15, "1B": 15, "1C": 15, "2": 16, "5": 256, "11A": 15, "11C": 15, "22": 16}
"""Number of values of the alive counter in each profile."""


def expected_rule(profile: str, data_ids: tuple[int, ...]) -> CrcRule:
    """Return the CRC of a message with this profile and these data IDs."""
    if profile in ("2", "22"):
        ids = tuple(number & 0xFF for number in data_ids)
        return CrcRule(0x2F, 8, 0xFF, 0xFF, id_bytes=1, is_id_last=True, data_ids=ids)
    (data_id,) = data_ids
    if profile == "5":
        ids = (data_id & 0xFFFF,) * _COUNTERS
        return CrcRule(0x1021, 16, 0xFFFF, 0, id_bytes=2, is_id_last=True, data_ids=ids)
    id_bytes = 2
    if profile == "1B":
        id_bytes = 1
        ids = (data_id & 0xFF, data_id >> 8 & 0xFF) * (_COUNTERS // 2)
    elif profile in ("1C", "11C"):
        ids = (data_id & 0xFF,) * _COUNTERS  # the high byte is 0 in the CRC
    else:
        ids = (data_id & 0xFFFF,) * _COUNTERS
    return CrcRule(0x1D, 8, 0, 0, id_bytes=id_bytes, is_id_last=False, data_ids=ids)


def rule_of_python(protection: Protection) -> CrcRule:
    """Return the CRC that signals/e2e.py computes."""
    profile = protection.profile
    mask = (1 << 8 * protection.profile.mode.id_bytes) - 1
    return CrcRule(
        polynomial=profile.polynomial,
        bits=profile.crc_bits,
        start=profile.start,
        final_xor=profile.final_xor,
        id_bytes=protection.profile.mode.id_bytes,
        is_id_last=protection.profile.mode.is_id_last,
        data_ids=tuple(number & mask for number in protection.ids_by_counter),
    )


def rule_of_c(row: Any) -> CrcRule:
    """Return the CRC of a row of kcg_e2e. One of 8 bits is the upper half of one of 16 bits."""
    lower_half = 1 << 16 - 8 * row.crc_bytes
    mask = (1 << 8 * row.id_bytes) - 1
    return CrcRule(
        polynomial=_upper_half(row.polynomial, lower_half),
        bits=8 * row.crc_bytes,
        start=_upper_half(row.start, lower_half),
        final_xor=_upper_half(row.final_xor, lower_half),
        id_bytes=row.id_bytes,
        is_id_last=bool(row.is_id_last),
        data_ids=tuple(number & mask for number in row.data_id),
    )


def _upper_half(number: int, lower_half: int) -> int:
    """Return a number without its lower half, which must be 0. Otherwise it is negative."""
    upper, lower = divmod(number, lower_half)
    return -number if lower else upper
