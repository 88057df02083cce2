"""Decoding of EDS texts, which Windows editors may have written."""

import codecs
import re
import unicodedata

_CTRL_Z = re.compile(r"[\s\x1a]*\x1a[\s\0\x1a]*\Z")
"""End of a file as DOS editors mark it, with or without the padding of a block."""
_PLAIN_LETTERS = {"\u00b5": "u", "\u03bc": "u", "\u00b0": "deg", "\u00df": "ss"}


def decode_text(data: bytes) -> str:
    """Return the text of an EDS with LF as line end.

    The text is UTF-16 with a byte order mark, UTF-8, or else Windows-1252.
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        text = data.decode("utf-16", "replace")
    else:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("cp1252", "replace")
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    return _CTRL_Z.sub("", text)


def to_ascii(text: str) -> str:
    """Return the text with letters beyond ASCII replaced by the nearest ones, or by "?"."""
    if text.isascii():
        return text
    for letter, plain in _PLAIN_LETTERS.items():
        text = text.replace(letter, plain)
    parts = unicodedata.normalize("NFKD", text)
    bare_letters = "".join(each for each in parts if not unicodedata.combining(each))
    return bare_letters.encode("ascii", "replace").decode("ascii")
