"""Builds and runs every_value.c for the shipped DBC, with the core in C as `export c` writes it."""

import re
import subprocess
from dataclasses import dataclass
from pathlib import Path

import sheet
from built import there

from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.recordings.layouts import layout_of_dbc
from kontronik_can_gw.native.export_c import exported

HERE = Path(__file__).parent
DBC = shipped("dbc/kontronik_esc.dbc")
OPTIONS = ("-std=gnu99", "-O2", "-DKCG_SLICES=8")


@dataclass(frozen=True)
class Compared:
    values: int
    signals: int


def export_shipped(folder: Path) -> None:
    """Write the core and the tables of the shipped DBC into a folder."""
    bus = layout_of_dbc(DBC)
    for name, text in exported(bus.layout, bus.escs, False, "").items():
        (folder / name).write_text(text, encoding="utf-8")


def compare_values(folder: Path, part: str) -> Compared:
    """Run a part of the comparison. Raises AssertionError with the first difference."""
    export_shipped(folder)
    (folder / "sheet.h").write_text(sheet.header(DBC))
    program = folder / "every_value"
    sources = [str(HERE / "every_value.c"), str(folder / "tables.c")]
    command = [there(), *OPTIONS, "-I", str(folder), "-o", str(program), *sources]
    subprocess.run(command, check=True)
    done = subprocess.run([str(program), part], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    print(f"{part}: {done.stdout.strip()}")
    values, signals = map(int, re.findall(r"\d+", done.stdout))
    return Compared(values, signals)
