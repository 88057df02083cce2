"""A field that is added to fields.py, and nowhere else, is found in both cores and in the export.

A copy of the package gets the field and is compiled anew. A new type of fields does not compile
until the core in C can read it.
"""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
from built import STRICT

pytestmark = pytest.mark.promise("one-place")

PACKAGE = Path(__file__).resolve().parents[2] / "kontronik_can_gw"
FIRST_OF_LIVE = "    electrical_speed: ElectricalSpeed = 0\n"
LAST_OF_INFO = "    max_bec_temperature: Temperature = 0\n"
SENT = (0, 1, 100, 127, 7)
NOTE = "/* 0.1 V; new */"
"""Comment of the generated line."""
"""Values that every type holds."""
SHOW = """
import json, sys
from collections.abc import Iterable
from pathlib import Path
from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.core.python_core import PythonCore
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.dbc.reader import parse_database
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.desk.export_c import exported
from kontronik_can_gw.native.load import make_core

MS = 1_000_000
DBC = '''VERSION ""
NS_ :
BS_:
BU_: Gw Car
BO_ 256 M: 8 Gw
 SG_ Dummy : 0|32@1- (0.1,0) [0|0] "V" Car
 SG_ BatteryVoltage : 32|16@1+ (0.01,0) [0|0] "V" Car
 SG_ CellCount : 48|8@1+ (1,0) [0|0] "" Car
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 1000;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ 256 10;
'''
escs = (EscSettings(),)
database = parse_database(DBC.encode(), "t.dbc")
layout = prepare(database, "t.dbc", escs, DbcConfig(), is_fd_allowed=True)


def stream(wire_layout):
    for number in json.loads(sys.argv[1]):
        fields = {"dummy": number}
        in_live = fields if "dummy" in LiveData._fields else {}
        in_info = {} if in_live else fields
        yield encode(InfoData(cell_count=6, **in_info), wire_layout)
        yield encode(LiveData(battery_voltage=2442, **in_live), wire_layout)


def frames(core):
    found = []
    now = 0
    for wire_layout in (WireLayout.LEGACY, WireLayout.V4):
        for data in stream(wire_layout):
            core.receive(0, data, now, now)
            core.advance(now)
            found += [[now, frame.data.hex()] for frame in core.take(now)]
            now += 10 * MS
    return found


settings = CoreSettings(escs, layout)
core = make_core(settings, 0)
folder = Path("firmware")
folder.mkdir()
for name, text in exported(settings, "licence").items():
    (folder / name).write_text(text)
(folder / "uart.bin").write_bytes(b"".join(stream(WireLayout.V4)))
print(json.dumps({
    "why": core.note,
    "in Python": frames(PythonCore(settings, 0)),
    "in C": frames(core),
}))
"""


@pytest.mark.parametrize(
    ("before", "type_code", "line"),
    [
        (FIRST_OF_LIVE, "B", f"#define KCG_LIVE_DUMMY(live) kcg_field(live, 0, KCG_U8) {NOTE}"),
        (LAST_OF_INFO, "h", f"#define KCG_INFO_DUMMY(info) kcg_field(info, 32, KCG_I16) {NOTE}"),
    ],
    ids=["first byte of live data", "signed word of info"],
)  # fmt: skip
def test_new_field_is_in_both_cores_and_in_the_export(
    c_compiler: Callable[..., str], tmp_path: Path, before: str, type_code: str, line: str
) -> None:
    compiler = c_compiler()
    copy = _copied(tmp_path)
    fields = copy / "esc" / "kontronik" / "fields.py"
    text = fields.read_text(encoding="utf-8")
    assert text.count(before) == 1
    row = f'FieldRow("{type_code}", "V", 10, note="new")'
    text = text.replace(before, f"    dummy: Annotated[int, {row}] = 0\n{before}")
    fields.write_text(text, encoding="utf-8")

    run = [sys.executable, "-m", "kontronik_can_gw.native.compile"]
    subprocess.run(run, cwd=tmp_path, check=True, timeout=300)
    run = [sys.executable, "-c", SHOW, json.dumps(SENT)]
    done = subprocess.run(run, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    shown = json.loads(done.stdout)
    assert shown["why"] == ""
    assert shown["in C"] == shown["in Python"]
    assert _values(data for _, data in shown["in C"]) >= set(SENT)

    folder = tmp_path / "firmware"
    assert line in (folder / "wire.h").read_text(encoding="ascii").splitlines()
    sources = ["core.c", "tables.c", "example_main.c"]
    run = [compiler, "-std=c99", *STRICT, "-O1", "-o", "example", *sources]
    subprocess.run(run, cwd=folder, check=True, timeout=300)
    run = ["./example", "uart.bin"]
    done = subprocess.run(run, cwd=folder, capture_output=True, text=True, check=True, timeout=60)
    sent = (words.partition("#")[2] for words in done.stdout.split())
    assert SENT[-1] in _values(filter(None, sent))


@pytest.mark.usefixtures("c_compiler")
def test_wire_type_that_c_cannot_read_does_not_compile(tmp_path: Path) -> None:
    c_header = _copied(tmp_path) / "esc" / "kontronik" / "c_header.py"
    text = c_header.read_text(encoding="utf-8")
    last_type = '"I": "U32"}'
    assert text.count(last_type) == 1
    text = text.replace(last_type, '"I": "U32", "i": "I32"}')
    c_header.write_text(text, encoding="utf-8")
    run = [sys.executable, "-m", "kontronik_can_gw.native.compile"]
    done = subprocess.run(
        run, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 1
    assert "kcg_field_has_a_case_for_each_type" in done.stderr


def _copied(folder: Path) -> Path:
    """Return a copy of the package without its shared objects."""
    copy = folder / "kontronik_can_gw"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__", "*.so"))
    return copy


def _values(frames: Iterable[str]) -> set[int]:
    """Return the numbers in the Dummy signal of frames that also hold the other values."""
    found = set()
    for frame in frames:
        data = bytes.fromhex(frame)
        if data[4:7] == (2442).to_bytes(2, "little") + b"\6":
            found.add(int.from_bytes(data[:4], "little", signed=True))
    return found
