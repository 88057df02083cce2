"""The text of an EDS as editors on Windows write it too."""

import codecs
import re
import unicodedata

_CTRL_Z = re.compile(r"[\s\x1a]*\x1a[\s\0\x1a]*\Z")
"""The end of a file as DOS editors mark it, also with the padding of a block after it."""
_PLAIN_LETTERS = {"\u00b5": "u", "\u03bc": "u", "\u00b0": "deg", "\u00df": "ss"}


def decode_text(data: bytes) -> str:
    """Returns the text of an EDS with LF as line end, as UTF-16 or UTF-8 if it is that, else as Windows-1252."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        text = data.decode("utf-16", "replace")
    else:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("cp1252", "replace")
    return _CTRL_Z.sub("", text.replace("\r\n", "\n").replace("\r", "\n"))


def to_ascii(text: str) -> str:
    """Replaces letters beyond ASCII by the nearest ones, and others by "?"."""
    if text.isascii():
        return text
    for letter, plain in _PLAIN_LETTERS.items():
        text = text.replace(letter, plain)
    parts = unicodedata.normalize("NFKD", text)
    bare_letters = "".join(each for each in parts if not unicodedata.combining(each))
    return bare_letters.encode("ascii", "replace").decode("ascii")
