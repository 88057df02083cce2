"""Converts between the bytes of a frame and its data, in both layouts.

    layout  kind  header  fields  reserved  CRC at  CRC covers  length
    V4      live  KODL        16         2      36       0..35      40
    V4      info  KODI        18         3      40       0..39      44
    legacy  live  KODL        16         0      34       0..31      38
    legacy  info  KODI        18         0      37       0..35      41

The CRC is the standard CRC-32 (zlib.crc32), sent little-endian. It covers the largest multiple of
four bytes that fits before it. So in the legacy layout it does not protect the last fields:
operating state and timing of a live frame, maximum BEC temperature of an info frame.
"""

import struct
from enum import Enum
from zlib import crc32

from kontronik_can_gw.esc.decoder import FrameForm
from kontronik_can_gw.esc.kontronik.fields import Data, DataType, InfoData, LiveData, body_format

PREFIX = b"KOD"
"""The beginning of a header. L or I follows. No letter is in a header twice."""
CRC_LENGTH = 4


class WireLayout(Enum):
    """The two layouts of frames. Every device uses one of them for all its frames."""

    V4 = "v4"
    LEGACY = "legacy"


class Form(FrameForm):
    """One of the four frame forms: its header, length, CRC and packing."""

    def __init__(self, is_info: bool, layout: WireLayout) -> None:
        self.layout = layout
        self.name = f"{'info' if is_info else 'live'}_{layout.value}"
        self.header = PREFIX + (b"I" if is_info else b"L")
        self.data_type: DataType = InfoData if is_info else LiveData
        body = body_format(self.data_type)
        reserved = 0
        if layout is WireLayout.V4:
            reserved = -struct.calcsize(f"<4s{body}") % 4
        self._struct = struct.Struct(f"<4s{body}{reserved}xI")
        length = self._struct.size
        layout_number = list(WireLayout).index(layout) + 1
        super().__init__(length, is_info, layout_number)
        crc_at = length - 4
        self.covered = crc_at // 4 * 4
        """Number of bytes that the CRC covers."""
        self.crc_part = slice(0, self.covered)
        """Bytes to add to the running CRC when the forms of a header are tried in turn."""
        self.unpack_crc = struct.Struct(f"<{crc_at}xI").unpack_from
        self.unpack_fields = struct.Struct(f"<4x{body}").unpack_from

    def encode(self, data: Data) -> bytes:
        """Return the frame, with its CRC and with reserved bytes set to 0.

        Raises struct.error if a value does not fit its wire type.
        """
        frame = self._struct.pack(self.header, *data, 0)
        crc = crc32(frame[: self.covered])
        return frame[:-4] + crc.to_bytes(4, "little")


FORMS = (
    Form(is_info=False, layout=WireLayout.LEGACY),
    Form(is_info=False, layout=WireLayout.V4),
    Form(is_info=True, layout=WireLayout.LEGACY),
    Form(is_info=True, layout=WireLayout.V4),
)
"""All four forms in the order of the search: the shorter one of each kind is first."""

FORMS_BY_HEADER = {
    header: tuple(form for form in FORMS if form.header == header)
    for header in sorted({form.header for form in FORMS})
}
for _shorter, _longer in FORMS_BY_HEADER.values():
    _longer.crc_part = slice(_shorter.covered, _longer.covered)
MIN_LENGTH = min(form.length for form in FORMS)
MAX_LENGTH = max(form.length for form in FORMS)


def encode(data: Data, layout: WireLayout) -> bytes:
    """Return the frame with this data in the given layout.

    Raises struct.error if a value does not fit its wire type.
    """
    for form in FORMS:
        if form.layout is layout and form.data_type is type(data):
            return form.encode(data)
    raise TypeError(f"{type(data).__name__} is neither LiveData nor InfoData")
