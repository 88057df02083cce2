"""The files of `export c` compile alone without a warning, and send the Python core's frames."""

import ctypes
import re
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from built import COMPILERS, STRICT
from firmware import Case

from kontronik_can_gw.cli import main
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.desk.export_c import exported
from kontronik_can_gw.desk.recordings.layouts import layout_of_dbc
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import EscSettings, LinkState

pytestmark = pytest.mark.promise("firmware")


@pytest.mark.parametrize("seed", range(4))
def test_export_sends_the_frames_of_the_python_core(
    c_compiler: Callable[..., str], tmp_path: Path, seed: int
) -> None:
    case = Case(tmp_path, seed)
    sent = case.run(str(case.build(c_compiler("gcc"), "-O1")))
    assert sent.count("\n") > 100
    assert sent == case.expected()


@pytest.mark.parametrize("program", COMPILERS)
@pytest.mark.parametrize(
    "options",
    [
        "-DKCG_SLICES=0 -DKCG_LEGACY=0",
        "-DKCG_SLICES=1 -DKCG_FOUND=1 -DKCG_SLOTS=1",
        "-DKCG_DATA=64 -DKCG_FLOATS=1",
    ],
)
def test_all_macros_compile_without_a_warning(
    c_compiler: Callable[..., str], tmp_path: Path, program: str, options: str
) -> None:
    bus = layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))
    Case(tmp_path, 1, bus.layout, bus.escs).build(c_compiler(program), "-Os", *options.split())


def test_command_exports_the_messages_of_a_configuration(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = tmp_path / "gateway.toml"
    folder = tmp_path / "firmware"
    config.write_text(
        '[can]\nchannel = "vcan0"\n[canopen]\nenabled = true\n'
        '[[esc]]\nname = "left"\nport = "/dev/null"\npole_pairs = 7\n'
        '[[esc]]\nname = "rear"\nport = "/dev/zero"\ngear = "5/2"\n'
    )
    assert main(["export", "c", "-c", str(config), str(folder)]) == 0
    assert "CANopen nodes are not exported" in capsys.readouterr().err
    header = (folder / "tables.h").read_text()
    assert "enum { KCG_ESC_left, KCG_ESC_rear, KCG_ESCS };" in header
    ids = re.findall(r"#define KCG_ID_(\w+) 0x(\w+)u\n#define KCG_LENGTH_\1 (\d+)", header)
    assert len(ids) == header.count("KCG_MESSAGE_") > 20
    settings = r"\.poles = 7,.*\n.*\.gear_numerator = 5, \.gear_denominator = 2"
    assert re.search(settings, (folder / "tables.c").read_text())
    page = (folder / "README.md").read_text()
    assert "left, rear" in page
    assert "Permission is hereby granted" in page

    own = folder / "example_main.c"
    own.write_text("int main(void) { return 0; }\n")
    (folder / "tables.h").write_text(header.replace("rear", "back"))
    assert main(["export", "c", "-c", str(config), str(folder)]) == 2
    assert main(["export", "c", "-c", str(config), "-o", str(folder), "--force"]) == 0
    assert own.read_text().startswith("int main")
    assert (folder / "tables.h").read_text() == header


def test_existing_files_are_only_replaced_with_force(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "README.md").write_text("# My firmware\n")
    assert main(["export", "c", str(tmp_path)]) == 2
    expected = "README.md: exists. Give another name, or --force to replace it.\n"
    assert capsys.readouterr().err.endswith(expected)
    assert [path.name for path in tmp_path.iterdir()] == ["README.md"]
    assert main(["export", "c", str(tmp_path / "README.md")]) == 1


def test_signal_that_the_core_cannot_express_is_refused(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    dbc = tmp_path / "big.dbc"
    dbc.write_text(
        'VERSION ""\nNS_ :\nBS_:\nBU_: Gw Car\nBO_ 256 M: 8 Gw\n'
        ' SG_ MotorRunTime : 0|32@1+ (3.1415926535897931,0) [0|0] "s" Car\n'
    )
    assert main(["export", "c", "--dbc", str(dbc), str(tmp_path / "out")]) == 2
    reason = "M.MotorRunTime: factor 3.14159265358979 exceeds 64 bits. Factor 3.14159"
    assert f"cannot be exported: {reason}" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_names_never_end_a_comment_and_are_unique() -> None:
    bus = layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))
    names = "a*/b", "a  b", "é\n", "COUNT"
    layout = replace(bus.layout, file='/x/*/"\\\n.dbc')
    files = exported(CoreSettings([EscSettings(name) for name in names], layout), "licence")
    assert "KCG_ESC_a__b, KCG_ESC_a__b_2, KCG_ESC___, KCG_ESC_COUNT_2," in files["tables.h"]
    assert "Messages of ___.dbc:" in files["tables.h"]
    assert all(text.isascii() for text in files.values())


_FROM_CPP = """
#include "core.h"
#include "tables.h"
static int64_t memory[(KCG_MEMORY + 7) / 8];
int main()
{
    kcg *core = kcg_init(memory, &kcg_tables, kcg_esc_settings, 5);
    kcg_frame frames[4];
    kcg_repeat(core, 5);
    if (kcg_next_deadline(core) < 5 || kcg_take(core, 5, frames, 4) > 4)
        return 1;
    return kcg_size(&kcg_tables) != KCG_MEMORY;
}
"""


@pytest.fixture
def shipped_case(tmp_path: Path) -> Case:
    bus = layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))
    return Case(tmp_path, 1, bus.layout, bus.escs)


def test_export_links_with_a_cpp_program(
    c_compiler: Callable[..., str], shipped_case: Case
) -> None:
    case = shipped_case
    (case.folder / "main.cpp").write_text(_FROM_CPP)
    gcc = c_compiler("gcc")
    for source in ("core.c", "tables.c"):
        case.output(gcc, "-std=c99", "-c", source)
    case.output(c_compiler("g++"), "-Wall", "-Werror", "-c", "main.cpp")
    # Not by g++: Zig would first compile its whole C++ library, which the program does not use.
    case.output(gcc, "-o", "cpp", "main.o", "core.o", "tables.o")
    assert case.output("./cpp") == ""


@pytest.mark.parametrize("option", ["-DKCG_DATA=64", "-DKCG_FOUND=3"])
def test_files_that_differ_in_a_structure_do_not_link(
    c_compiler: Callable[..., str], shipped_case: Case, option: str
) -> None:
    """Otherwise the program would write beyond the memory that the other file reserves."""
    case = shipped_case
    gcc = c_compiler("gcc")
    case.output(gcc, "-std=c99", option, "-c", "core.c")
    words = [gcc, "-std=c99", "-o", "differs", "core.o", "tables.c", "example_main.c"]
    done = subprocess.run(
        words,
        cwd=case.folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode != 0
    for name in ("kcg_init", "kcg_take"):
        expected = rf"undefined (reference to|symbol:) .?{name}_with_KCG_DATA_8_KCG_FOUND_2"
        assert re.search(expected, done.stderr)
    case.output(
        *words[:2],
        option,
        "-o",
        "same",
        "core.o",
        "tables.c",
        "example_main.c",
    )


@pytest.mark.parametrize(
    ("option", "count"),
    [
        ("-DKCG_SLOTS=0", 0),
        ("-DKCG_SLOTS=1", 8),
    ],
)
def test_every_declared_function_is_defined(
    c_compiler: Callable[..., str], shipped_case: Case, option: str, count: int
) -> None:
    """core.c defines every function that core.h declares. Slots need KCG_SLOTS."""
    case = shipped_case
    gcc = c_compiler("gcc")
    header = case.output(gcc, "-std=c99", option, "-E", "-P", "core.h")
    declared = set(re.findall(r"(kcg_\w+)\([^;{}]*\);", header))
    # The warning is for a function that is defined and not declared.
    strict = ["-std=c99", option, "-Wmissing-prototypes", "-Werror", "-shared", "-fPIC"]
    case.output(gcc, *strict, "-o", "core.so", "core.c", "tables.c")
    defined = ctypes.CDLL(str(case.folder / "core.so"))
    assert [name for name in declared if not hasattr(defined, name)] == []
    assert sum("slot" in name for name in declared) == count


_FAULTS = """
#define main unused_main
#include "example_main.c"
#undef main
static void feed(const uint8_t *data, size_t size, int ms)
{
    for (size_t k = 0; k < size; k++)
        byte_in(0, data[k]);
    for (; ms; ms--, simulated += MS)
        turn();
}
static void say(const char *text)
{
    long long link = core->esc[0].link;
    long long bus_off_count = core->gateway[KCG_BUS_OFF_COUNT];
    printf("%s %lld %lld\\n", text, link, bus_off_count);
}
int main(void)
{
    static const uint8_t live[] = {LIVE};
    start();
    feed(live, sizeof live, 50);
    say("ok");
    uart_failed(0, 1);
    feed(live, sizeof live, 50);
    say("lost");
    uart_failed(0, 0);
    feed(live, 0, 10);
    say("back");
    feed(live, sizeof live, 50);
    say("again");
    bus_state(BUS_OFF);
    feed(live, sizeof live, 200);
    say("off");
    bus_state(ERROR_ACTIVE);
    feed(live, sizeof live, 1);
    say("on");
    return 0;
}
"""
OK = LinkState.OK
LOST = LinkState.LOST
PORT_ERROR = LinkState.PORT_ERROR


def test_example_survives_a_failed_uart_and_bus_off(
    c_compiler: Callable[..., str], shipped_case: Case
) -> None:
    case = shipped_case
    live = encode(LiveData(battery_voltage=2400), WireLayout.V4)
    text = _FAULTS.replace("LIVE", ", ".join(map(str, live)))
    (case.folder / "faults.c").write_text(text)
    case.output(
        c_compiler("gcc"),
        "-std=c99",
        *STRICT,
        "-o",
        "faults",
        "core.c",
        "tables.c",
        "faults.c",
    )
    blocks = {}
    states = {}
    frames = []
    for line in case.output("./faults").splitlines():
        if line.startswith("("):
            frames.append(line.split()[2].partition("#")[0])
        else:
            name, link, count = line.split()
            blocks[name] = frames
            states[name] = (int(link), int(count))
            frames = []
    assert states == {
        "ok": (OK, 0),
        "lost": (PORT_ERROR, 0),
        "back": (LOST, 0),
        "again": (OK, 0),
        "off": (OK, 1),
        "on": (OK, 1),
    }
    assert blocks["off"] == [], "nothing is sent in bus-off"
    messages = layout_of_dbc(shipped("dbc/kontronik_esc.dbc")).layout.messages
    without_cycle = {f"{each.can_id:03X}" for each in messages if not each.cycle_ns}
    assert set(blocks["on"]) >= without_cycle, "all are sent again"
    assert len(set(blocks["on"])) == len(blocks["on"])
