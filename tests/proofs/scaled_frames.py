"""Frames of a few symbols instead of 38 to 44 bytes, for the proof of small scope.

A scale has its own prefix, forms and check. The deframers of both languages take them as
parameters: the one in C from wire.h, the one in Python from names of its module.
"""

from dataclasses import dataclass

from specification import INFO_FIELDS, LIVE_FIELDS


@dataclass(frozen=True)
class Scale:
    """Frames are a prefix, L or I, a body and a check of one symbol."""

    prefix: str
    lengths: tuple[tuple[int, int], tuple[int, int]]
    """Lengths in symbols: the two live forms (legacy, V4), then the two info forms."""
    covered: tuple[tuple[int, int], tuple[int, int]]
    """Symbols that the check covers. As on the wire, it leaves out the end of legacy bodies."""
    crc_factor: int
    """A number without a common factor with the size of the alphabet."""

    @property
    def alphabet(self) -> str:
        """All symbols that the search for frames distinguishes, and one other."""
        return f"{self.prefix}LIx"

    @property
    def name(self) -> str:
        return f"{self.prefix}-{self.lengths[0][0]}-to-{self.lengths[1][1]}"

    def wire_header(self) -> str:
        """Return the wire.h of this scale, for core.c."""
        forms = [
            [f"{{{length}, {covered}}}" for length, covered in zip(*row, strict=True)]
            for row in zip(self.lengths, self.covered, strict=True)
        ]
        body = self.lengths[0][0] - len(self.prefix) - 2
        longest = self.lengths[1][1]
        names = [f"LIVE_{field.name}" for field in LIVE_FIELDS]
        names += [f"INFO_{field.name}" for field in INFO_FIELDS]
        fields = "\n".join(f"#define KCG_{name.upper()}(body) (body)[0]" for name in names)
        return f"""\
#ifndef KCG_WIRE_H
#define KCG_WIRE_H
#define ALPHABET "{self.alphabet}"
#define PREFIX "{self.prefix}"
#define LENGTHS {_rows(self.lengths)}
#define COVERED {_rows(self.covered)}
#define CRC_FACTOR {self.crc_factor}u
enum {{ KCG_U8, KCG_I8, KCG_U16, KCG_I16, KCG_U32, KCG_WIRE_TYPES }};
enum {{ KCG_LIVE_SIZE = {body}, KCG_INFO_SIZE = {body}, KCG_BODY_SIZE = {body} }};
enum {{ KCG_SHORTEST_FRAME = {self.lengths[0][0]}, KCG_LONGEST_FRAME = {longest} }};
enum {{ KCG_MAX_HELD = {longest - 1}, KCG_VARIANT_BITS = 0, KCG_LARGEST_STATE = 0 }};
#define KCG_PREFIX PREFIX
enum {{ KCG_PREFIX_SIZE = {len(self.prefix)}, KCG_CRC_SIZE = 1 }};
#define KCG_CRC(crc, bytes, size) scaled_crc(crc, bytes, size)
#define KCG_READ_CRC(bytes) index_of(bytes)
#define KCG_FRAME_FORMS {{{{{", ".join(forms[0])}}}, {{{", ".join(forms[1])}}}}}
{fields}
#endif
"""


def _rows(numbers: tuple[tuple[int, int], tuple[int, int]]) -> str:
    return "{" + ", ".join(f"{{{one}, {other}}}" for one, other in numbers) + "}"


SCALES = (
    Scale("K", ((4, 5), (5, 6)), ((2, 4), (3, 5)), crc_factor=3),
    Scale("KO", ((5, 6), (6, 7)), ((3, 5), (4, 6)), crc_factor=2),
)
"""Prefixes with one symbol and with two, in which a header can be cut in more ways."""
WHOLE_PREFIX = Scale("KOD", ((6, 7), (7, 8)), ((4, 6), (5, 7)), crc_factor=5)
"""The prefix of the wire. Its six symbols make too many streams for `make prove`."""
