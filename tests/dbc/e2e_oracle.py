"""The receivers of the package autosar-e2e as oracles of protected frames."""

import random
from collections.abc import Callable
from functools import partial

from e2e import p01, p02, p05, p11

Protect = Callable[..., None]
SINGLE_ID: dict[str, Protect] = {
    "1A": partial(p01.e2e_p01_protect, data_id_mode=p01.E2E_P01_DATAID_BOTH),
    "1B": partial(p01.e2e_p01_protect, data_id_mode=p01.E2E_P01_DATAID_ALT),
    "1C": partial(p01.e2e_p01_protect, data_id_mode=p01.E2E_P01_DATAID_NIBBLE),
    "5": p05.e2e_p05_protect,
    "11A": partial(p11.e2e_p11_protect, data_id_mode=p11.E2E_P11_DATAID_BOTH),
    "11C": partial(p11.e2e_p11_protect, data_id_mode=p11.E2E_P11_DATAID_NIBBLE),
}
"""The function of autosar-e2e for each profile with one data ID."""
IDS_OF_2 = tuple(random.Random(2).randbytes(16))
DATA_IDS: dict[str, int | tuple[int, ...]] = {
    "1A": 0xABCD,
    "1B": 0xABCD,
    "1C": 0xACD,
    "2": IDS_OF_2,
    "5": 0x8001,
    "11A": 0x123,
    "11C": 0x123,
    "22": IDS_OF_2,
}
COUNTER_BITS = {"5": 8}
"""Length of the counter, if it is not 4 bits."""


def is_right(name: str, data: bytes) -> bool:
    """Return whether the receiver of the autosar-e2e package accepts a frame."""
    data_ids = DATA_IDS[name]
    if isinstance(data_ids, tuple):
        return p02.e2e_p02_check(data, bytes(data_ids))
    expected = bytearray(data)
    SINGLE_ID[name](expected, data_ids, increment_counter=False)
    return data == expected


def counter_of(name: str, data: bytes) -> int:
    return data[2] if name == "5" else data[1] & 0xF
