"""The deframer finds exactly the frames of a brute-force search in all short streams.

The frames are scaled down to a few symbols, so that every stream and every cut can be tried. A
stream is fed as each of its beginnings, symbol by symbol, followed by the rest in one piece. The
result and the state must not depend on this last cut. By induction they then depend on no cuts.
"""

import itertools
import re
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from built import there
from scaled_frames import SCALES, Scale

from kontronik_can_gw.esc.kontronik import deframer
from kontronik_can_gw.native.objects import FOLDER

pytestmark = [
    pytest.mark.promise("brute-force"),
    pytest.mark.usefixtures("c_compiler"),
]
HERE = Path(__file__).parent
SYMBOLS_IN_C = 10
SYMBOLS_IN_PYTHON = 7
LAYOUTS = ("legacy", "v4")
LEGACY, V4 = range(2)
LEAST_FRAMES = 1000
"""A proof that accepts fewer frames would say little about accepted frames."""


def prove_in_c(folder: Path, scale: Scale, symbols: int) -> None:
    """Run all streams of up to so many symbols through the deframer in C."""
    (folder / "wire.h").write_text(scale.wire_header())
    program = folder / "scaled_deframer"
    options = ["-std=c99", "-O2", f"-DSTREAM={symbols}", f"-DKCG_FOUND={symbols}"]
    paths = ["-I", str(folder), "-I", str(FOLDER)]
    command = [there(), *options, *paths, "-o", str(program), str(HERE / "scaled_deframer.c")]
    subprocess.run(command, check=True)
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    streams, _, frames = map(int, re.findall(r"\d+", done.stdout))
    size = len(scale.alphabet)
    assert streams == sum(size**length for length in range(1, symbols + 1))
    assert frames >= LEAST_FRAMES
    print(f"C, {scale.name}: {done.stdout.strip()}")


@pytest.mark.parametrize("scale", SCALES, ids=lambda scale: scale.name)
def test_all_short_streams_give_the_frames_of_brute_force_in_c(
    tmp_path: Path,
    scale: Scale,
) -> None:
    prove_in_c(tmp_path, scale, SYMBOLS_IN_C)


@dataclass(frozen=True)
class Found:
    """An accepted frame, as the brute-force search describes it."""

    form: str
    end: int
    body: str


class Search:
    """A brute-force search in a whole stream. It looks at every position."""

    def __init__(self, scale: Scale, stream: str, ended: bool) -> None:
        self.frames: list[Found] = []
        self.headers = 0
        self.crc_errors = 0
        self.unknown_kinds = 0
        self.decided = 0
        """Symbols that no later symbol can make part of a further frame."""
        at = 0
        while at < len(stream):
            rest = stream[at:]
            if not ended and scale.prefix.startswith(rest):
                break
            at += 1
            if not rest.startswith(scale.prefix) or rest == scale.prefix:
                continue
            kind = rest[len(scale.prefix)]
            if kind not in "LI":
                self.unknown_kinds += 1
                continue
            lengths = scale.lengths[kind == "I"]
            covered = scale.covered[kind == "I"]
            for form in (LEGACY, V4):
                length = lengths[form]
                frame = rest[:length]
                if len(frame) < length or check_of(scale, frame[: covered[form]]) == frame[-1]:
                    break
            else:
                self.headers += 1
                self.crc_errors += 1
                continue
            if len(frame) == length:
                at += length - 1
                name = f"{'info' if kind == 'I' else 'live'}_{LAYOUTS[form]}"
                self.frames.append(Found(name, at, frame[len(scale.prefix) + 1 : -1]))
            elif not ended:
                at -= 1
                break
            self.headers += 1
        self.decided = at


def check_of(scale: Scale, symbols: str) -> str:
    """Return the symbol that checks the others."""
    crc = 0
    for symbol in symbols:
        crc = (crc * scale.crc_factor + scale.alphabet.index(symbol) + 1) % len(scale.alphabet)
    return scale.alphabet[crc]


@pytest.fixture
def scaled(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Scale:
    """Let the deframer in Python look for the frames of a scale."""
    scale: Scale = request.param
    forms = {
        f"{scale.prefix}{kind}".encode(): _forms(scale, is_info)
        for is_info, kind in enumerate("LI")
    }
    all_forms = [form for pair in forms.values() for form in pair]

    def crc_of(data: bytes, crc: int = 0) -> int:
        for byte in data:
            index = scale.alphabet.index(chr(byte))
            crc = (crc * scale.crc_factor + index + 1) % len(scale.alphabet)
        return crc

    monkeypatch.setattr(deframer, "PREFIX", scale.prefix.encode())
    monkeypatch.setattr(deframer, "CRC_LENGTH", 1)
    monkeypatch.setattr(deframer, "FORMS", all_forms)
    monkeypatch.setattr(deframer, "FORMS_BY_HEADER", forms)
    monkeypatch.setattr(deframer, "MAX_LENGTH", max(form.length for form in all_forms))
    monkeypatch.setattr(deframer, "_HEADER_LENGTH", len(scale.prefix) + 1)
    monkeypatch.setattr(deframer, "_LEGACY_LIVE", all_forms[0])
    monkeypatch.setattr(deframer, "crc32", crc_of)
    return scale


def _forms(scale: Scale, is_info: int) -> list[Any]:
    """Return the two forms of a header, with the attributes that the deframer reads."""
    forms = []
    begin = 0
    layouts = zip(
        LAYOUTS,
        scale.lengths[is_info],
        scale.covered[is_info],
        strict=True,
    )
    for layout, length, covered in layouts:
        body = slice(len(scale.prefix) + 1, length - 1)
        form = SimpleNamespace(
            name=f"{'info' if is_info else 'live'}_{layout}",
            length=length,
            crc_part=slice(begin, covered),
            data_type=lambda *symbols: symbols,
            unpack_crc=lambda frame, at=length - 1: (scale.alphabet.index(chr(frame[at])),),
            unpack_fields=lambda frame, body=body: frame[body],
        )
        begin = covered
        forms.append(form)
    return forms


class Fed:
    """A deframer that took a stream, and the frames that it returned since an earlier state."""

    def __init__(self, fed: "Fed | None" = None) -> None:
        self.deframer = deframer.Deframer()
        self.frames: list[Found] = []
        if fed:
            self.deframer.counters = fed.deframer.counters.copy()
            for name in ("_held", "_base", "_needed", "_rejected_for", "_rejected_until"):
                setattr(self.deframer, name, getattr(fed.deframer, name))
            self.frames = [*fed.frames]

    def feed(self, stream: str) -> "Fed":
        self._note(self.deframer.feed(stream.encode()))
        return self

    def flush(self) -> "Fed":
        self._note(self.deframer.flush())
        return self

    def _note(self, frames: Sequence[Any]) -> None:
        for form, start, data in frames:
            body = bytes(data).decode()
            self.frames.append(Found(form.name, start + form.length, body))

    @property
    def state(self) -> tuple[Any, ...]:
        """All that can influence later results."""
        d = self.deframer
        rejected = (d._rejected_for, d._rejected_until) if d._rejected_until > d._base else None
        return d._held, d._base, d._needed, rejected, d.counters.as_dict()

    def check(self, search: Search, stream: str) -> None:
        """Compare the result with the brute-force search in the same stream."""
        counters = self.deframer.counters
        assert self.frames == search.frames, stream
        assert self.deframer._base == search.decided, stream
        assert self.deframer._held.decode() == stream[search.decided :], stream
        found = (counters.headers, counters.crc_errors, counters.unknown_kinds)
        assert found == (search.headers, search.crc_errors, search.unknown_kinds), stream
        assert counters.bytes == len(stream), stream
        assert counters.pending == len(stream) - search.decided, stream


def streams(scale: Scale) -> Iterator[str]:
    """Yield all streams, shorter ones first."""
    for length in range(1, SYMBOLS_IN_PYTHON + 1):
        for symbols in itertools.product(scale.alphabet, repeat=length):
            yield "".join(symbols)


@pytest.mark.parametrize("scaled", SCALES, indirect=True, ids=lambda scale: scale.name)
def test_all_short_streams_give_the_frames_of_brute_force_in_python(scaled: Scale) -> None:
    states = {"": Fed()}
    cuts = 0
    frames = 0
    for stream in streams(scaled):
        search = Search(scaled, stream, ended=False)
        whole = Fed(states[stream[:-1]]).feed(stream[-1])
        whole.check(search, stream)
        if len(stream) < SYMBOLS_IN_PYTHON:
            states[stream] = whole
        for cut in range(len(stream) - 1):
            again = Fed(states[stream[:cut]]).feed(stream[cut:])
            assert again.frames == whole.frames, (stream, cut)
            assert again.state == whole.state, (stream, cut)
            cuts += 1
        ended = Fed(whole).flush()
        ended.check(Search(scaled, stream, ended=True), stream)
        frames += len(ended.frames)
    assert frames >= LEAST_FRAMES
    print(f"Python, {scaled.name}: {cuts} cuts, {frames} frames")
