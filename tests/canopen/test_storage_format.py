"""The text of a parameter file is read as it was written, and a damaged text is refused."""

import json
import zlib
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kontronik_can_gw.canopen.storage import Stored, decode, encode

pytestmark = pytest.mark.promise("parameters")

SAMPLE = Stored(
    7,
    {
        0x101700: b"\xf4\x01",
        0x140001: bytes.fromhex("81010040"),
        0x1A0000: b"\0",
        0x210001: b"\x07",
        0x9FFFFF: b"",
        0x200000: bytes(range(16)),
    },
)
TEXT = b"""{"format":"kontronik-can-gw parameters","version":1,"crc32":"%08X"}
{"node_id":7,"communication":{"1017:00":"F401","1400:01":"81010040","1A00:00":"00"},\
"application":{"2000:00":"000102030405060708090A0B0C0D0E0F","2100:01":"07","9FFF:FF":""}}
"""


def with_crc(body: str | bytes, version: object = 1) -> bytes:
    """Return a file with any content and its CRC-32."""
    raw = body.encode() if isinstance(body, str) else body
    return b'{"format":"kontronik-can-gw parameters","version":%s,"crc32":"%08X"}\n%s' % (
        str(version).encode(),
        zlib.crc32(raw),
        raw,
    )


def content(**changed: Any) -> str:
    whole = {"node_id": None, "communication": {}, "application": {}} | changed
    return json.dumps(whole, separators=(",", ":")) + "\n"


def test_text_agrees_with_the_documentation() -> None:
    body = TEXT.split(b"\n", 1)[1]
    assert encode(SAMPLE) == TEXT % zlib.crc32(body)
    assert decode(TEXT % zlib.crc32(body)) == SAMPLE


values = st.binary(max_size=12)
stores = st.builds(
    Stored,
    st.one_of(st.none(), st.integers(1, 127), st.just(255)),
    st.dictionaries(st.integers(0x100000, 0x9FFFFF), values),
)


@given(stores)
def test_any_parameters_are_read_as_they_were_written(stored: Stored) -> None:
    assert decode(encode(stored)) == stored


def refused(data: bytes) -> str:
    with pytest.raises(ValueError) as caught:
        decode(data)
    # The reason is ours, not an exception of a library.
    assert type(caught.value) is ValueError
    return str(caught.value)


def test_every_damaged_byte_and_every_truncation_is_found() -> None:
    data = encode(Stored(7, {0x101700: b"\xf4\x01"}))
    for place, right in enumerate(data):
        refused(data[:place])
        refused(data[len(data) - place :])
        for value in set(range(256)) - {right}:
            refused(data[:place] + bytes((value,)) + data[place + 1 :])


FUTURE = b'{"format":"kontronik-can-gw parameters","version":12}\nsomething of the future'
HEADER, BODY = encode(SAMPLE).splitlines(keepends=True)
DAMAGED = [
    (b"", "empty"),
    (b"node_id = 5\n", "first line"),
    (BODY, "first line"),
    (HEADER, "CRC-32"),
    (with_crc(content(), version=2), "version 2 is not supported"),
    (FUTURE, "version 12 is not supported"),
    (with_crc(content(), version='"1"'), "first line"),
    (with_crc(content()).replace(b"\n", b"\r\n"), "CRC-32"),
]
FORM = "not written by this program"  # the reason for every content with the right CRC
OTHER_CONTENT: list[Any] = [
    b"\xff\xfe\n",
    "[" * 100_000,
    "[]\n",
    '{"node_id":null}\n',
    *(content(node_id=value) for value in (0, 128, True, 5.0, "5")),
    content(communication={"1017": "00"}),
    content(communication={"1018:00": "00", "1017:00": "00"}),
    *(content(communication={key: "00"}) for key in ("1017:00\n", "1a00:00", "2000:00", "0FFF:00")),
    *(content(communication={"1017:00": value}) for value in (5, "f4", "F4 01")),
    content(more=1),
    content(communication=[]),
    content(application=None),
    content(application={"1FFF:FF": "00"}),
    content().replace("{}", '{"1017:00":"00","1017:00":"01"}', 1),
    content().replace(",", ", "),
    content().rstrip("\n"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("data", "reason"),
    [*DAMAGED, *((with_crc(body), FORM) for body in OTHER_CONTENT)],
)
def test_text_that_this_version_does_not_write_is_refused_with_the_reason(
    data: bytes,
    reason: str,
) -> None:
    assert reason in refused(data)
