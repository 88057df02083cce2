"""What `export c` writes compiles by itself, without a warning, and sends what the core in Python sends."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
from built import COMPILERS, there
from firmware import Case

from kontronik_can_gw.cli import main
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.recordings.layouts import layout_of_dbc
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.native.export_c import exported


@pytest.mark.parametrize("seed", range(4))
def test_its_frames_are_those_of_the_core_in_python(tmp_path: Path, seed: int) -> None:
    case = Case(tmp_path, seed)
    sent = case.run(str(case.build(there("gcc"), "-O1")))
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
def test_macros_build_without_a_warning(tmp_path: Path, program: str, options: str) -> None:
    bus = layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))
    Case(tmp_path, 1, bus.layout, bus.escs).build(there(program), "-Os", *options.split())


def test_the_command_writes_what_a_configuration_sends(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, folder = tmp_path / "gateway.toml", tmp_path / "firmware"
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
    assert re.search(
        r"\.poles = 7,.*\n.*\.gear_numerator = 5, \.gear_denominator = 2",
        (folder / "tables.c").read_text(),
    )
    page = (folder / "README.md").read_text()
    assert "left, rear" in page and "Permission is hereby granted" in page

    own = folder / "example_main.c"
    own.write_text("int main(void) { return 0; }\n")
    (folder / "tables.h").write_text(header.replace("rear", "back"))
    assert main(["export", "c", "-c", str(config), str(folder)]) == 2
    assert main(["export", "c", "-c", str(config), "-o", str(folder), "--force"]) == 0
    assert own.read_text().startswith("int main")
    assert (folder / "tables.h").read_text() == header


def test_files_that_exist_are_only_replaced_with_force(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "README.md").write_text("# My firmware\n")
    assert main(["export", "c", str(tmp_path)]) == 2
    assert capsys.readouterr().err.endswith(
        "README.md: exists. Give another name, or --force to replace it.\n"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["README.md"]
    assert main(["export", "c", str(tmp_path / "README.md")]) == 1


def test_what_the_core_cannot_express_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dbc = tmp_path / "big.dbc"
    dbc.write_text(
        'VERSION ""\nNS_ :\nBS_:\nBU_: Gw Car\nBO_ 256 M: 8 Gw\n'
        ' SG_ LinkState : 0|32@1+ (0.00592884289493769,89.21540281025877) [0|0] "" Car\n'
    )
    assert main(["export", "c", "--dbc", str(dbc), str(tmp_path / "out")]) == 2
    assert "not in the core in C: M.LinkState: add" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_names_end_no_comment_and_are_never_the_same() -> None:
    bus = layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))
    names = "a*/b", "a  b", "é\n", "COUNT"
    layout = replace(bus.layout, file='/x/*/"\\\n.dbc')
    files = exported(layout, [EscSettings(name) for name in names], False, "licence")
    assert "KCG_ESC_a__b, KCG_ESC_a__b_2, KCG_ESC___, KCG_ESC_COUNT_2," in files["tables.h"]
    assert "Messages of ___.dbc:" in files["tables.h"]
    assert all(text.isascii() for text in files.values())
