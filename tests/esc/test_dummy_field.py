"""A new first field of the live frame changes no other value, object or frame.

So no code depends on the position of a field.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.promise("one-place")

PACKAGE = Path(__file__).resolve().parents[2] / "kontronik_can_gw"
FIRST = "    electrical_speed: ElectricalSpeed = 0\n"
SHOW = """
import json
from kontronik_can_gw.canopen.objects import BINDINGS
from kontronik_can_gw.assembly.assemble import assemble
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.canopen.setup import shipped_canopen
from kontronik_can_gw.desk.recordings.fields import fields_of_values
from kontronik_can_gw.esc.kontronik.states import Device
from kontronik_can_gw.esc.kontronik.codec import WireLayout
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.kontronik.simulator import EscOptions, SimulatedEsc
from kontronik_can_gw.esc.values import VALUES
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.status.facts import (PortFacts)
from kontronik_can_gw.runtime.status.snapshot import (_esc)

esc = [{"port": "/dev/null"}, {"port": "/dev/zero"}]
config = parse({"can": {"interface": "virtual", "channel": "x"}, "esc": esc}, "x.toml")
gateway = Gateway(assemble(config).core_settings, 0, outputs=[shipped_canopen([1, 2])])
gateway.start(0)
escs = []
for device in (Device.KOSMIK, Device.JIVEPRO):
    escs.append(SimulatedEsc(EscOptions(device=device, layout=WireLayout.V4), seed=device))
frames = []
for now in range(0, 3_000_000_000, 10_000_000):
    for index, esc in enumerate(escs):
        for sent in esc.frames_until(now):
            gateway.receive_bytes(index, sent.wire, now, now)
    gateway.advance(now)
    frames += [f"{now} {f.can_id:X} {f.data.hex()}" for f in gateway.take_frames(now)]
fields = [f for f in fields_of_values(config.escs) if f.source != "dummy"]
read = [f.reader for f in fields if f.esc == 1]
port = PortFacts("esc", "/dev/null", open=True)
status = _esc(gateway.escs[1], port, gateway.status, now)
status["values"].pop("dummy", None)
print(json.dumps({
    "first": LiveData._fields[0],
    "words": VALUES["electrical_speed"].words,
    "frames": frames,
    "values": [
        (v.name, v.unit, v.per_unit, v.low, v.high) for v in VALUES.values() if v.name != "dummy"
    ],
    "objects": sorted((*at, b.source.name, str(b.slope)) for at, b in BINDINGS.items()),
    "row": [one(gateway.escs[1], gateway.status, now) for one in read],
    "status": status,
}))
"""


def _shown(folder: Path) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, "-c", SHOW],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert isinstance(found, dict)
    return found


def test_new_first_field_changes_no_other_value(tmp_path: Path) -> None:
    copy = shutil.copytree(
        PACKAGE,
        tmp_path / "kontronik_can_gw",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    for name in ("dbc", "eds"):
        if (PACKAGE.parent / name).is_dir():
            shutil.copytree(PACKAGE.parent / name, tmp_path / name)
    fields = copy / "esc" / "kontronik" / "fields.py"
    text = fields.read_text(encoding="utf-8")
    assert text.count(FIRST) == 1
    fields.write_text(text.replace(FIRST, f"    dummy: Count = 0\n{FIRST}"), encoding="utf-8")
    before = _shown(PACKAGE.parent)
    after = _shown(tmp_path)
    assert before.pop("first") == "electrical_speed"
    assert before.pop("words") == [0]
    assert after.pop("first") == "dummy"
    assert after.pop("words") == [1]
    assert len(before["frames"]) > 1000
    assert after == before
