"""Frame bytes <-> data, in both layouts.

    V4      live  KODL  16 fields  2 reserved  CRC over 0..35 at 36      40 bytes
    V4      info  KODI  18 fields  3 reserved  CRC over 0..39 at 40      44 bytes
    legacy  live  KODL  16 fields              CRC over 0..31 at 34      38 bytes
    legacy  info  KODI  18 fields              CRC over 0..35 at 37      41 bytes

The CRC is the standard CRC-32 (zlib.crc32), little-endian, over the largest multiple of four bytes in front of it: so in the
legacy layout the last field or two (live: operating state, timing; info: maximum BEC temperature) are not protected.
"""

import struct
from enum import Enum
from zlib import crc32

from kontronik_can_gw.esc.decoder import FrameForm
from kontronik_can_gw.esc.kontronik.fields import Data, DataType, InfoData, LiveData, body_format


class Layout(Enum):
    """Which of the two layouts."""

    V4 = "v4"
    LEGACY = "legacy"


class Form(FrameForm):
    """One of the four frame forms: its length, what its CRC covers, and how its body is packed."""

    def __init__(self, is_info: bool, layout: Layout) -> None:
        self.layout = layout
        self.name = f"{'info' if is_info else 'live'}_{layout.value}"
        self.header = b"KODI" if is_info else b"KODL"
        self.data_type: DataType = InfoData if is_info else LiveData
        body = body_format(self.data_type)
        reserved = 0 if layout is Layout.LEGACY else -struct.calcsize(f"<4s{body}") % 4
        self._struct = struct.Struct(f"<4s{body}{reserved}xI")
        super().__init__(self._struct.size, is_info, list(Layout).index(layout) + 1)
        self.crc_at = self.length - 4
        self.covered = self.crc_at // 4 * 4
        self.crc_goes_on_over = slice(0, self.covered)
        """What its CRC covers; of the longer of two forms: beyond what that of the shorter covers."""
        self.crc_of = struct.Struct(f"<{self.crc_at}xI").unpack_from
        self.fields_of = struct.Struct(f"<4x{body}").unpack_from

    def encode(self, data: Data) -> bytes:
        """The frame with reserved bytes 0 and its CRC. struct.error where a value does not fit its wire type."""
        frame = self._struct.pack(self.header, *data, 0)
        return frame[:-4] + crc32(frame[: self.covered]).to_bytes(4, "little")


FORMS = tuple(Form(info, layout) for info in (False, True) for layout in (Layout.LEGACY, Layout.V4))
"""All four; of one kind the shorter first, which is also the order in which they are tried."""

FORMS_BY_HEADER = {
    header: tuple(form for form in FORMS if form.header == header)
    for header in sorted({form.header for form in FORMS})
}
for _shorter, _longer in FORMS_BY_HEADER.values():
    _longer.crc_goes_on_over = slice(_shorter.covered, _longer.covered)
MAX_LENGTH = max(form.length for form in FORMS)


def encode(data: Data, layout: Layout) -> bytes:
    """The frame bytes of a LiveData or InfoData in the given layout. struct.error where a value does not fit its wire type."""
    of = type(data), layout
    return next(form for form in FORMS if (form.data_type, form.layout) == of).encode(data)
