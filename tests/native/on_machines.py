"""The exported core on other machines, by cross compilers and QEMU.

It must send the same frames, and needs a limited part of a Cortex-M4. This is a step of
`make release` (tests/run.py): python -m pytest -s tests/native/on_machines.py
"""

import re
from pathlib import Path

import pytest
from built import STRICT
from firmware import SOURCES, Case

from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.recordings.layouts import layout_of_dbc

pytestmark = pytest.mark.promise("firmware")

HERE = Path(__file__).parent
FIVE = HERE.parent / "benchmarks" / "five.dbc"
CORTEX_M4 = ("-mcpu=cortex-m4", "-mthumb", "-Os", "-ffunction-sections", "-fdata-sections")
BARE = ("--specs=rdimon.specs", "-nostartfiles", "-Wl,--gc-sections", "-T", f"{HERE}/cortex_m4.ld")
QEMU = ("qemu-system-arm", "-M", "mps2-an386", "-nographic", "-semihosting", "-kernel")
MACHINES = {
    "arm-linux-gnueabihf-gcc": "qemu-arm",
    "aarch64-linux-gnu-gcc": "qemu-aarch64",
    "s390x-linux-gnu-gcc": "qemu-s390x",
}
"""Compilers, and the emulators that run their programs. s390x is big-endian."""
SEEDS = range(8)
KB = 1024


@pytest.fixture(scope="session")
def cases(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Case, str]]:
    """Return random layouts that need every macro of the core, with frames of the Python core."""
    made = [Case(tmp_path_factory.mktemp("case"), seed) for seed in SEEDS]
    headers = [(case.folder / "core.h").read_text() for case in made]
    for macro in ("KCG_DATA 64", "KCG_FLOATS 1", "KCG_PAGED 1", "KCG_E2E 1"):
        pattern = re.compile(f"#define {macro.replace(' ', ' +')}\\b")
        assert any(pattern.search(header) for header in headers), macro
    return [(case, case.expected()) for case in made]


@pytest.mark.parametrize("compiler", MACHINES)
def test_exported_core_sends_the_same_frames_on_other_machines(
    cases: list[tuple[Case, str]],
    compiler: str,
) -> None:
    for case, text in cases:
        program = case.build(compiler, "-O2", "-static")
        assert case.run(MACHINES[compiler], str(program)) == text


def test_exported_core_sends_the_same_frames_on_a_cortex_m4(
    cases: list[tuple[Case, str]],
) -> None:
    for case, text in cases:
        inputs = "-DINPUTS=" + ",".join(f'"{name}"' for name in case.inputs)
        start = str(HERE / "cortex_m4.c")
        program = case.build(
            "arm-none-eabi-gcc",
            *CORTEX_M4,
            *BARE,
            "-Wno-pedantic",
            inputs,
            start,
        )
        assert case.output(*QEMU, str(program)) == text


def deepest(graph: str) -> int:
    """Return the largest stack in bytes that a function and its callees need.

    The input is the output of GCC's -fcallgraph-info=su.
    """
    nodes = re.findall(r'node: \{ title: "([^"]+)" label: "[^"]*\\n(\d+) bytes', graph)
    edges = re.findall(r'edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"', graph)
    own = {name: int(size) for name, size in nodes}
    calls: dict[str, set[str]] = {}
    for source, target in edges:
        calls.setdefault(source, set()).add(target)

    def needed(name: str, above: tuple[str, ...]) -> int:
        assert name not in above, f"recursion: {name}"
        further = [needed(each, (*above, name)) for each in calls.get(name, ())]
        return own.get(name, 0) + max(further, default=0)

    return max(needed(name, ()) for name in own)


@pytest.mark.parametrize(
    ("options", "limit"),
    [(("-DKCG_LEGACY=0",), 608), (("-DKCG_DATA=64", "-DKCG_PAGED=1", "-DKCG_E2E=1"), 704)],
)
def test_core_needs_little_stack_of_a_cortex_m4(
    tmp_path: Path,
    options: tuple[str, ...],
    limit: int,
) -> None:
    """The limit is for the core alone. The compiler's division and memcpy need < 64 bytes more."""
    bus = layout_of_dbc(FIVE)
    case = Case(tmp_path, 1, bus.layout, bus.escs)
    flags = (*CORTEX_M4, "-fstack-usage", "-fcallgraph-info=su", *options)
    case.output(
        "arm-none-eabi-gcc",
        "-std=c99",
        *STRICT,
        *flags,
        "-c",
        "core.c",
        "example_main.c",
    )
    core = deepest((tmp_path / "core.ci").read_text())
    example = deepest((tmp_path / "example_main.ci").read_text())
    machine = f"Cortex-M4 {' '.join(options)}"
    print(f"{machine}: stack of the core {core}, of the example without it {example}")
    assert 100 < core <= limit


INTEGERS = {"__aeabi_ldivmod", "__aeabi_uldivmod"}
MEMORY = {"memcpy", "memset", "memmove", "memchr", "memcmp"}


@pytest.mark.parametrize(
    ("dbc", "options", "flash", "ram"),
    [
        (FIVE, ("-DKCG_DATA=64", "-DKCG_PAGED=1", "-DKCG_E2E=1"), 9 * KB - 256, None),
        (FIVE, ("-DKCG_LEGACY=0",), 8 * KB - 256, 2 * KB),
        (shipped("dbc/kontronik_esc.dbc"), (), 8 * KB - 256, None),
    ],
)
def test_core_needs_little_flash_and_ram_of_a_cortex_m4(
    tmp_path: Path,
    dbc: Path,
    options: tuple[str, ...],
    flash: int,
    ram: int | None,
) -> None:
    """The limits are for one ESC.

    The core needs only a 64-bit division of the compiler's library. The tables are in flash.
    """
    bus = layout_of_dbc(dbc)
    case = Case(tmp_path, 1, bus.layout, bus.escs)
    case.output(
        "arm-none-eabi-gcc",
        "-std=c99",
        *STRICT,
        *CORTEX_M4,
        *options,
        "-c",
        *SOURCES,
    )
    names = [source.replace(".c", ".o") for source in SOURCES]
    lines = case.output("arm-none-eabi-size", *names).splitlines()[1:]
    core, tables, example = (tuple(map(int, line.split()[:3])) for line in lines)
    print(f"Cortex-M4 {' '.join(options)}: text, data, bss: {core}, {tables}, {example}")
    assert core[0] <= flash
    assert (*core[1:], *tables[1:]) == (0, 0, 0, 0)
    if ram is not None:
        assert sum(example[1:]) <= ram
    needed = set(re.findall(r"U (\w+)", case.output("arm-none-eabi-nm", "-u", "core.o")))
    assert needed <= INTEGERS | MEMORY
