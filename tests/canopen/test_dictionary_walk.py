"""Reads and writes the whole index space by SDO.

Size, access and limits of each object are tested, and the values of 2000h in each link state.
"""

import struct

import pytest
from dialogue import QUIET, Bench, shipped_eds

from kontronik_can_gw.canopen.eds import EdsEntry
from kontronik_can_gw.esc.kontronik.codec import WireLayout
from kontronik_can_gw.esc.kontronik.codec import encode as uart
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData, rows
from kontronik_can_gw.status import GatewayState

pytestmark = pytest.mark.promise("object-access")

NO_OBJECT = 0x06020000
NO_SUB = 0x06090011
READ_ONLY = 0x06010002
WRITE_ONLY = 0x06010001
TOO_LONG = 0x06070012
TOO_SHORT = 0x06070013
TOO_HIGH = 0x06090031
TOO_LOW = 0x06090032
DEVICE_STATE = 0x08000022
NO_DATA = 0x08000024
FORMATS = {0x01: "?", 0x02: "b", 0x03: "h", 0x04: "i", 0x05: "B", 0x06: "H", 0x07: "I", 0x08: "f"}
TEXTS = (0x09, 0x0F)

LIVE = LiveData(
    70_000,
    2442,
    -12,
    34,
    56,
    789,
    1234,
    5678,
    1500,
    -50,
    60,
    -7,
    8,
    1 << 17,
    26,
    9,
)
# fmt: off
INFO = InfoData(
    1 << 10 | 120, 4 << 8 | 17, 3, 6, 100_000, 2000, 2520, 100, 200, 300, 4, 5000, 99, 100,
    -10, 90, -11, 50,
)
# fmt: on


@pytest.fixture(scope="module")
def bench() -> Bench:
    """Return a bench for all tests of this file. No write may change it permanently."""
    return Bench(changes=QUIET)


def entries() -> dict[tuple[int, int], EdsEntry]:
    return {(e.index, e.sub): e for e in shipped_eds().entries}


def of(entry: EdsEntry) -> str:
    return f"{entry.index:04X}h:{entry.sub:02X} {entry.name}"


def ends(entry: EdsEntry) -> tuple[int, int]:
    """Return the smallest and the largest value of the type."""
    bits = 8 * struct.calcsize(FORMATS[entry.data_type])
    is_signed = FORMATS[entry.data_type].islower()
    if is_signed:
        return -(1 << bits - 1), (1 << bits - 1) - 1
    return 0, (1 << bits) - 1


def test_unknown_indices_and_sub_indices_abort_with_their_codes(bench: Bench) -> None:
    known = entries()
    indices = {index for index, _ in known}
    found = {index: bench.read(index) for index in set(range(0x10000)) - indices}
    assert set(found.values()) == {NO_OBJECT}
    unknown = "0000 0001 1006 1201 1400 1600 1806 2003 5FFF 6000 A000 FFFF"
    for index in (int(text, 16) for text in unknown.split()):
        assert bench.write(index, 0, 0) == NO_OBJECT
    for index in indices:
        for sub in range(256):
            if (index, sub) not in known:
                assert bench.read(index, sub) == NO_SUB
                assert bench.write(index, sub, 0) == NO_SUB


@pytest.mark.parametrize("entry", shipped_eds().entries, ids=of)
def test_every_object_has_its_size_and_access(bench: Bench, entry: EdsEntry) -> None:
    at = entry.index, entry.sub
    data = bench.read(*at)
    if entry.access == "wo":
        assert data == WRITE_ONLY
    elif isinstance(data, int):
        assert data == NO_DATA  # no frame of the ESC has arrived
        assert entry.index in (0x1003, 0x2000, 0x2001, 0x2010, 0x2011, 0x2020, 0x606C, 0x6079)
    elif entry.data_type not in TEXTS:
        assert len(data) == struct.calcsize(FORMATS[entry.data_type])
    if entry.access in ("ro", "const"):
        for size in (1, 2, 4, 9):
            assert bench.write(*at, bytes(size)) == READ_ONLY
        return
    size = struct.calcsize(FORMATS[entry.data_type])
    before = bench.read(*at)
    for other in {1, 2, 3, 4, 5, 8, 300} - {size}:
        assert bench.write(*at, bytes(other)) == (TOO_LONG if other > size else TOO_SHORT)
    assert bench.write(*at, b"") == TOO_SHORT
    assert bench.read(*at) == before


LIMITED = [entry for entry in shipped_eds().entries if "w" in entry.access]
RULED = {0x1003, 0x1005, 0x1010, 0x1011, 0x1014, 0x1F80, 0x2101, 0x2102}
"""Objects with further rules than limits, which dialogues test."""


@pytest.mark.parametrize("entry", LIMITED, ids=of)
def test_every_object_enforces_its_limits(entry: EdsEntry, bench: Bench) -> None:
    at = entry.index, entry.sub
    least, most = ends(entry)
    low = least if entry.low is None else entry.low
    high = most if entry.high is None else entry.high
    size = struct.calcsize(FORMATS[entry.data_type])
    before = bench.read(*at)
    if low > least:
        assert bench.write(*at, low - 1, size=size) == TOO_LOW
    if high < most:
        assert bench.write(*at, high + 1, size=size) == TOO_HIGH
        assert bench.write(*at, most, size=size) == TOO_HIGH
    assert bench.read(*at) == before
    if entry.index in RULED or 0x1800 <= entry.index < 0x1C00:
        return
    for value in (low, high):
        assert bench.write(*at, value, size=size) is None
        assert bench.number(*at) == value
    if isinstance(before, bytes):
        assert bench.write(*at, before) is None


def test_serial_number_and_vendor_are_taken_from_the_configuration() -> None:
    bench = Bench(2, vendor_id=0x12345, version="1.2.3")
    assert [bench.number(0x1018, 4, node) for node in (1, 2)] == [77, 78]
    assert bench.number(0x1018, 1) == 0x12345
    assert bench.read(0x100A) == b"1.2.3"


# --- values of the ESC


def values(data: LiveData | InfoData) -> list[bytes]:
    """Return the wire bytes of each field."""
    wires = {name: row.wire for name, row in rows(type(data)).items()}
    return [struct.pack(f"<{wire}", getattr(data, name)) for name, wire in wires.items()]


ALL_LIVE = [
    *((0x2000, sub) for sub in range(1, 17)),
    *((0x2001, sub) for sub in (1, 2, 3, 5)),
    (0x606C, 0),
    (0x6079, 0),
]
"""Objects that are available only with fresh live data."""
INFORMATION = [*((0x2010, sub) for sub in range(1, 8)), *((0x2011, sub) for sub in range(1, 15))]


def fed(behaviour: int = 0) -> Bench:
    """Return a node whose ESC has just sent both frames. ``behaviour`` is the value of 2100h:5."""
    bench = Bench(changes=QUIET)
    assert bench.write(0x2100, 5, behaviour, size=1) is None
    bench.wait(10)
    bench.uart(uart(INFO, WireLayout.V4))
    bench.uart(uart(LIVE, WireLayout.V4))
    bench.take()
    return bench


def test_fresh_values_equal_those_of_the_uart_frame() -> None:
    bench = fed()
    assert [bench.read(0x2000, sub) for sub in range(1, 17)] == values(LIVE)
    assert [bench.number(0x2010, sub) for sub in range(1, 6)] == [1, 120, 0x0411, 3, 6]
    assert [bench.read(0x2010, sub) for sub in (6, 7)] == [b"KOSMIK", b"4.17"]
    assert [bench.read(0x2011, sub) for sub in range(1, 15)] == values(INFO)[4:]
    assert bench.number(0x2001, 1) == bench.number(0x606C) == 70_000
    # 24.42 V and -1.2 A give -29.304 W.
    assert bench.read(0x2001, 3) == (-293).to_bytes(4, "little", signed=True)
    assert bench.number(0x2001, 5) == 4070
    assert bench.number(0x6079) == 24420
    assert bench.number(0x2020, 1) == 0x82


def lose(bench: Bench) -> None:
    bench.wait(300)
    bench.take()
    assert bench.number(0x2020, 1) == 4


@pytest.mark.promise("true")
@pytest.mark.parametrize("behaviour", [0, 1, 2])
def test_lost_values_abort_or_remain_or_are_codes_as_configured(
    behaviour: int,
) -> None:
    bench = fed(behaviour)
    known = entries()
    kept = [*INFORMATION, (0x2001, 4), (0x2001, 6)]
    fresh = {at: bench.read(*at) for at in [*ALL_LIVE, *kept]}
    assert not any(isinstance(data, int) for data in fresh.values())
    lose(bench)
    for at in ALL_LIVE:
        low, high = ends(known[at])
        code = struct.pack("<" + FORMATS[known[at].data_type], high if low == 0 else low)
        assert bench.read(*at) == (DEVICE_STATE, fresh[at], code)[behaviour], at
    assert {at: bench.read(*at) for at in kept} == {at: fresh[at] for at in kept}
    assert bench.number(0x2020, 3) == 300
    bench.wait(100_000)
    assert bench.number(0x2020, 3) == bench.number(0x2020, 4) == 0xFFFE
    assert bench.number(0x2020, 10) == 1


def test_status_registers_show_link_and_controller_state() -> None:
    bench = fed()
    bench.can_state("ERROR_PASSIVE")
    assert bench.number(0x1002) == 0x00030382
    lose(bench)
    assert bench.number(0x1002) == 0x00000304
    bench.gateway.status.state = GatewayState.REPLAY
    assert bench.number(0x1002) & 0xFF == bench.number(0x2020, 1) == 0x44
