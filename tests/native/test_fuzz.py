"""The core under fuzzers with sanitizers.

Each fuzzer of bytes runs for 10 s here, and 1 350 DBC texts are tried. In `make release`
it is twenty times as much (KCG_FUZZ_SECONDS).
"""

import os
import random
import subprocess
from collections.abc import Callable
from pathlib import Path

import equality
import pytest
from built import run_sanitized
from firmware import Case

SECONDS = int(os.environ.get("KCG_FUZZ_SECONDS", "30"))
SEED = random.Random().randrange(1 << 30) if SECONDS > 30 else 1
"""Seed of the fuzzers. It is always the same in CI."""
HERE = Path(__file__).parent
TEXTS = 45 * SECONDS
"""A number and not a time, so that every machine tries the same texts."""
FUZZED = (1, 2, 5)
"""Seeds of the layouts."""
pytestmark = [
    pytest.mark.promise("no-undefined-behaviour"),
    pytest.mark.extended,
]


@pytest.mark.parametrize("layout", FUZZED)
def test_any_bytes_and_times_do_no_harm(
    c_compiler: Callable[..., str], tmp_path: Path, layout: int
) -> None:
    """libFuzzer makes any calls.

    The core stays in its memory, has no undefined behaviour, and its deadlines advance.
    """
    case = Case(tmp_path / "export", layout)
    corpus = tmp_path / "corpus"
    corpus.mkdir()
    chance = random.Random(layout)
    for number in range(20):
        calls = [b"\0"]
        for _ in range(20):
            data = equality.stream(chance)[:127]
            head = 6 | chance.randrange(16) << 4, chance.randrange(256), len(data), 0
            calls += [bytes(head), data, b"\3"]
        (corpus / str(number)).write_bytes(b"".join(calls))
    program = tmp_path / "fuzz"
    sanitizers = "-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=all"
    command = [c_compiler("clang"), "-std=c99", "-g", "-O1", *sanitizers, "-I", str(case.folder)]
    sources = [case.folder / "core.c", case.folder / "tables.c", HERE / "fuzz_bytes.c"]
    subprocess.run([*command, "-o", str(program), *sources], check=True)
    limits = f"-max_total_time={max(1, SECONDS // len(FUZZED))}", f"-seed={SEED}", "-max_len=4096"
    words = [str(program), *limits, "-timeout=10", "-print_final_stats=1", str(corpus)]
    done = subprocess.run(
        words,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-6000:]
    print(done.stderr[-600:])


@pytest.mark.usefixtures("c_compiler")
def test_any_dbc_text_is_refused_or_read_equally(tmp_path: Path) -> None:
    """Changed DBC text is refused with a message, or both cores agree."""
    printed = run_sanitized(tmp_path, str(HERE / "fuzz_dbc.py"), str(TEXTS), str(SEED))
    print(printed.splitlines()[-1])
