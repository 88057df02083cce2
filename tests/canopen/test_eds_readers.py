"""Other people's readers take the shipped EDS, and the DCF made from it, without a finding: dcf-tools, npm canopen, canmatrix."""

import json
import logging
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from eds_text import SHIPPED as SHIPPED_TEXT
from eds_text import dcfchk, device_info, with_key

from kontronik_can_gw.canopen import dcf
from kontronik_can_gw.canopen import eds as reader
from kontronik_can_gw.canopen.eds import Eds
from kontronik_can_gw.canopen.eds_object import Entry

SHIPPED = Path(__file__).parents[2] / "eds" / "kontronik_esc.eds"
PDO_NAMES = [
    ["Electrical speed", "Battery voltage", "Battery current"],
    ["Motor current", "Peak current", "Consumed charge", "Throttle", "Output opening"],
    ["BEC voltage", "PWM input", "BEC current", "Power stage temperature", "BEC temperature"],
    ["Operating errors", "Operating state", "Timing", "Link status", "Live counter"],
]


@pytest.fixture(scope="module")
def shipped() -> Eds:
    return reader.load(SHIPPED.read_bytes(), SHIPPED.name)


def dcf_text(shipped: Eds, node_id: int) -> str:
    """A DCF with a value for every number and text that may be read."""
    values: dict[tuple[int, int], int | float | bytes] = {}
    for entry in shipped.entries:
        default = entry.default
        if entry.access == "wo" or entry.data_type == 0x0F:
            continue
        if default is None:
            default = b"text" if entry.data_type == 0x09 else 1
        if entry.relative:
            assert isinstance(default, int)
            default += node_id
        values[entry.index, entry.sub] = default
    return dcf.dcf(shipped, node_id, 250_000, values, "left", "left.dcf")


# --- dcf-tools ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("node_id", [1, 5, 127])
def test_dcfchk_has_no_finding(node_id: int) -> None:
    assert dcfchk(SHIPPED, node_id) == ""


def test_dcfchk_has_no_finding_in_the_dcf(shipped: Eds, tmp_path: Path) -> None:
    file = tmp_path / "left.dcf"
    file.write_bytes(dcf_text(shipped, 5).encode("ascii"))
    assert dcfchk(file, 5) == ""


@pytest.mark.parametrize(
    ("section", "key", "value", "found"),
    [
        ("MandatoryObjects", "SupportedObjects", "2", "too many entries in [MandatoryObjects]"),
        ("OptionalObjects", "1", "0x2000", "object 0x2000 is manufacturer-specific"),
        ("ManufacturerObjects", "2", "0x2009", "object 0x2009 not found"),
        ("2100", "SubNumber", "0x8", "1 extra sub-object(s) for object 0x2100"),
    ],
)
def test_dcfchk_would_have_said_so(
    tmp_path: Path, section: str, key: str, value: str, found: str
) -> None:
    file = tmp_path / "broken.eds"
    file.write_bytes(with_key(SHIPPED_TEXT, section, key, value).encode("ascii"))
    assert found in dcfchk(file, 1)


# --- npm canopen ----------------------------------------------------------------------------------------------------

NPM_CANOPEN = Path(__file__).parents[1] / "foreign" / ".cache" / "node" / "node_modules" / "canopen"


@pytest.fixture(scope="module")
def javascript() -> dict[str, Any]:
    if shutil.which("node") is None or not NPM_CANOPEN.exists():
        pytest.skip("canopen for node is not installed: run tests/foreign/install.sh")
    script = Path(__file__).with_name("read_with_npm_canopen.js")
    command = ["node", str(script), str(NPM_CANOPEN), str(SHIPPED)]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    assert run.stderr == ""
    found: dict[str, Any] = json.loads(run.stdout)
    return found


@pytest.mark.extended
def test_npm_canopen_reads_the_device(shipped: Eds, javascript: dict[str, Any]) -> None:
    device = device_info(SHIPPED.read_text("ascii"))
    rates = [key for key, value in device.items() if key.startswith("baudrate_") and value]
    assert javascript["bitRates"] == [1000 * int(key.removeprefix("baudrate_")) for key in rates]
    assert javascript["vendor"] == device["vendornumber"]
    assert javascript["product"] == device["productnumber"]
    assert javascript["revision"] == device["revisionnumber"]
    assert javascript["lss"] is True
    assert {int(index): name for index, name in javascript["names"].items()} == shipped.object_names


@pytest.mark.extended
def test_npm_canopen_reads_every_entry_as_we_do(shipped: Eds, javascript: dict[str, Any]) -> None:
    theirs = {(each["index"], each["sub"]): each for each in javascript["entries"]}
    assert set(theirs) == {(entry.index, entry.sub) for entry in shipped.entries}
    for entry in shipped.entries:
        found = theirs[entry.index, entry.sub]
        assert (found["name"], found["type"], found["access"]) == (
            entry.name,
            entry.data_type,
            entry.access,
        )
        if entry.data_type != 0x0F:
            assert found["mappable"] == entry.mappable, entry.name
        # it takes 0 for no limit
        assert (found["low"] or 0, found["high"]) == (entry.low or 0, entry.high), entry.name
        if _has_value(entry):
            value = found["value"].encode() if isinstance(found["value"], str) else found["value"]
            assert value == entry.default, entry.name


def _has_value(entry: Entry) -> bool:
    """It cannot add a node-ID, and sets sub-index 0 to the highest one that it meets."""
    counts = entry.sub == 0 and (entry.index == 0x1003 or 0x1A00 <= entry.index < 0x1C00)
    return entry.default is not None and not entry.relative and not counts


# --- canmatrix ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("node_id", [1, 127])
def test_canmatrix_makes_the_default_pdos_of_it(
    shipped: Eds, caplog: pytest.LogCaptureFixture, node_id: int
) -> None:
    from canmatrix.formats import eds  # type: ignore[import-untyped]  # missing in its list where asammdf loads it

    with caplog.at_level(logging.WARNING), SHIPPED.open("rb") as file:
        matrix = eds.load(file, eds_node_id=node_id)
    assert caplog.records == []
    numbers = {entry.name.replace(" ", "_"): entry for entry in shipped.entries}
    for number, names in enumerate(PDO_NAMES):
        frame = matrix.frame_by_name(f"TPDO_{number + 1}_communication_parameter")
        assert frame is not None
        assert (frame.arbitration_id.id, frame.size) == (0x180 + 0x100 * number + node_id, 8)
        assert [signal.name for signal in frame.signals] == [
            name.replace(" ", "_") for name in names
        ]
        for signal in frame.signals:
            assert signal.is_signed == (numbers[signal.name].data_type in (0x02, 0x03, 0x04))
    sdo = matrix.frame_by_name("SDO_transmit")
    assert {"Throttle", "Pole_pairs", "Reset_of_statistics"} < {
        signal.name for signal in sdo.signals
    }
