"""The exported core on other machines, by cross compilers and QEMU: the same frames, and how much of a Cortex-M4 it needs.

A step of `make release` (tests/run.py): python -m pytest -s tests/native/on_machines.py
"""

import re
import subprocess
import zlib
from pathlib import Path

import pytest
from built import STRICT
from firmware import SOURCES, Case

from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.recordings.layouts import layout_of_dbc

HERE = Path(__file__).parent
FIVE = HERE.parent / "benchmarks" / "five.dbc"
CORTEX_M4 = ("-mcpu=cortex-m4", "-mthumb", "-Os", "-ffunction-sections", "-fdata-sections")
BARE = (
    "--specs=rdimon.specs",
    "-nostartfiles",
    "-Wl,--gc-sections",
    "-T",
    str(HERE / "cortex_m4.ld"),
)
QEMU = ("qemu-system-arm", "-M", "mps2-an386", "-nographic", "-semihosting", "-kernel")
MACHINES = {
    "arm-linux-gnueabihf-gcc": "qemu-arm",
    "aarch64-linux-gnu-gcc": "qemu-aarch64",
    "s390x-linux-gnu-gcc": "qemu-s390x",
}
"""Compilers, and what runs their programs; s390x is big-endian."""
SEEDS = range(8)
KB = 1024


@pytest.fixture(scope="session")
def cases(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Case, str]]:
    """Random layouts that need every macro of the core, with streams and the frames of the core in Python."""
    made = [Case(tmp_path_factory.mktemp("case"), seed) for seed in SEEDS]
    for macro in ("KCG_DATA 64", "KCG_FLOATS 1", "KCG_PAGED 1", "KCG_E2E 1"):
        pattern = re.compile(f"#define {macro.replace(' ', ' +')}\\b")
        assert any(pattern.search((case.folder / "core.h").read_text()) for case in made), macro
    found = [(case, case.expected()) for case in made]
    for case, text in found:
        print(f"{len(case.lines)} ESCs, {text.count(chr(10))} frames: {_crc(text)}")
    return found


def _crc(text: str) -> str:
    return f"{zlib.crc32(text.encode()):08x}"


@pytest.mark.parametrize("compiler", MACHINES)
def test_it_sends_the_same_on(cases: list[tuple[Case, str]], compiler: str) -> None:
    for case, text in cases:
        program = case.build(compiler, "-O2", "-static")
        assert _crc(case.run(MACHINES[compiler], str(program))) == _crc(text)


def test_it_sends_the_same_on_a_cortex_m4(cases: list[tuple[Case, str]]) -> None:
    for case, text in cases:
        inputs = "-DINPUTS=" + ",".join(f'"{name}"' for name in case.inputs)
        start = str(HERE / "cortex_m4.c")
        program = case.build("arm-none-eabi-gcc", *CORTEX_M4, *BARE, "-Wno-pedantic", inputs, start)
        done = subprocess.run(
            [*QEMU, str(program)],
            cwd=case.folder,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=True,
            timeout=300,
        )
        assert _crc(done.stdout) == _crc(text)


@pytest.fixture
def five(tmp_path: Path) -> Case:
    """One ESC and five messages."""
    bus = layout_of_dbc(FIVE)
    return Case(tmp_path, 1, bus.layout, bus.escs)


def objects(case: Case, *options: str) -> dict[str, tuple[int, int, int]]:
    """Bytes of text, data and bss of each object for a Cortex-M4."""
    command = ["arm-none-eabi-gcc", "-std=c99", *STRICT, *CORTEX_M4, *options, "-c", *SOURCES]
    subprocess.run(command, cwd=case.folder, check=True)
    found = {}
    for source in SOURCES:
        name = source.replace(".c", ".o")
        done = subprocess.run(
            ["arm-none-eabi-size", name],
            cwd=case.folder,
            capture_output=True,
            text=True,
            check=True,
        )
        text, data, bss = map(int, done.stdout.splitlines()[1].split()[:3])
        found[source] = text, data, bss
    print(f"Cortex-M4 {' '.join(options)}: text, data, bss: {found}")
    return found


@pytest.mark.parametrize(
    ("options", "flash"),
    [
        (("-DKCG_DATA=64", "-DKCG_PAGED=1", "-DKCG_E2E=1"), 8 * KB),
        (("-DKCG_LEGACY=0",), 7 * KB),
    ],
)
def test_how_much_of_a_cortex_m4_it_needs(five: Case, options: tuple[str, ...], flash: int) -> None:
    sizes = objects(five, *options)
    text, *ram = sizes["core.c"]
    assert text <= flash
    assert ram == [0, 0]
    assert sizes["tables.c"][1:] == (0, 0), "tables are not in flash"
    if "-DKCG_DATA=64" not in options:
        assert sizes["example_main.c"][1] + sizes["example_main.c"][2] <= 2 * KB


def helpers(case: Case) -> set[str]:
    """What core.o needs of the compiler's library."""
    done = subprocess.run(
        ["arm-none-eabi-nm", "-u", "core.o"],
        cwd=case.folder,
        capture_output=True,
        text=True,
        check=True,
    )
    return set(re.findall(r"U (\w+)", done.stdout))


def test_without_floats_it_needs_a_64_bit_division_and_no_more(five: Case) -> None:
    objects(five)
    integers = {"__aeabi_ldivmod", "__aeabi_uldivmod"}
    assert helpers(five) <= integers | {"memcpy", "memset", "memmove", "memchr", "memcmp"}
    objects(five, "-DKCG_FLOATS=1")
    assert "__aeabi_ddiv" in helpers(five)


def test_the_shipped_dbc_fits_too(tmp_path: Path) -> None:
    bus = layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))
    assert objects(Case(tmp_path, 1, bus.layout, bus.escs))["core.c"][0] <= 7 * KB
