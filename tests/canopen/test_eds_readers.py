"""Other people's readers take the shipped EDS, and the DCF made from it, without a finding: dcf-tools, canmatrix."""

import logging
from pathlib import Path

import pytest
from eds_text import SHIPPED as SHIPPED_TEXT
from eds_text import dcfchk, with_key

from kontronik_can_gw.canopen import dcf
from kontronik_can_gw.canopen import eds as reader
from kontronik_can_gw.canopen.eds import Eds

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


def test_dcfchk_would_have_said_so(tmp_path: Path) -> None:
    file = tmp_path / "broken.eds"
    file.write_bytes(with_key(SHIPPED_TEXT, "2100", "SubNumber", "0x8").encode("ascii"))
    assert "1 extra sub-object(s) for object 0x2100" in dcfchk(file, 1)


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
