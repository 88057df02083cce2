"""Lets vss-tools read the overlay of the KUKSA example. They need 229 MB, so this runs by hand:

.venv/bin/pip install vss-tools && .venv/bin/python -m pytest tests/dbc/overlay_in_vss_tools.py
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from test_kuksa_example import OVERLAY, SENSORS, UNITS_OF_VSS, sensors

pytestmark = pytest.mark.promise("docs")


@pytest.mark.parametrize("celsius", ["celsius", "Celsius"])
def test_vss_tools_accept_the_overlay(celsius: str, tmp_path: Path) -> None:
    """``celsius`` is the name of this unit in VSS 5 or 6, which vss-tools read from a file."""
    vspec = Path(sys.executable).with_name("vspec")
    units = {**UNITS_OF_VSS, celsius: "temperature"}
    entry = "{{definition: x, unit: 'name of {}', quantity: {}, allowed-datatypes: [numeric]}}"
    texts = {
        "base.vspec": "Vehicle:\n  type: branch\n  description: The vehicle.\n",
        "units.yaml": "\n".join(f"{key}: {entry.format(key, of)}" for key, of in units.items()),
        "quantities.yaml": "\n".join(f"{of}: {{definition: x}}" for of in units.values()),
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    command = [str(vspec), "export", "json", "--strict"]
    files = ["-s", "base.vspec", "-u", "units.yaml", "-q", "quantities.yaml", "-l", str(OVERLAY)]
    more = ["-e", "dbc2vss", "-o", "out.json"]
    subprocess.run([*command, *files, *more], cwd=tmp_path, check=True)
    assert dict(sensors(json.loads((tmp_path / "out.json").read_text()))) == SENSORS
