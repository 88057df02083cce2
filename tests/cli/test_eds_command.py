"""``eds``: the EDS is equal byte for byte, and DCFs have the values of the node."""

import io
import re
from pathlib import Path
from typing import Any

import canopen
import pytest
from command_line import run, written

from kontronik_can_gw.assembly.assemble import load_configuration
from kontronik_can_gw.canopen.eds_changes import without
from kontronik_can_gw.canopen.objects import BINDINGS
from kontronik_can_gw.canopen.setup import shipped_canopen
from kontronik_can_gw.cli.common import canopen_of
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.esc.telemetry import EscSettings

pytestmark = pytest.mark.promise("user-eds")

EDS = shipped("eds/kontronik_esc.eds")
Key = tuple[int, int]


def command(*words: object) -> tuple[object, str, str]:
    """Run ``eds``. Returns the exit code, the output with its line ends, and the messages."""
    done = run("eds", *words)
    return done.code, done.data.decode("ascii"), done.err


def configuration(folder: Path, *more: str) -> Path:
    """Write a configuration with an EDS of the user."""
    lines = [
        "[dbc]",
        "enabled = false",
        "[canopen]",
        "enabled = true",
        'eds = "mine.eds"',
        *more,
        "[[esc]]",
        'port = "/dev/ttyUSB0"',
    ]
    return written(folder / "gateway.toml", "\n".join(lines))


def imported(text: str) -> Any:
    source = io.StringIO(text)
    source.name = "node.dcf"
    return canopen.import_od(source)


def values(dictionary: Any) -> dict[Key, int | bytes]:
    """Return every ParameterValue, as the canopen library reads it."""
    found: dict[Key, int | bytes] = {}
    for item in dictionary.values():
        is_alone = isinstance(item, canopen.objectdictionary.ODVariable)
        for each in [item] if is_alone else item.values():
            value = each.value
            if isinstance(value, str):
                value = value.encode()
            if value is not None:
                found[each.index, each.subindex] = value
    return found


def test_eds_of_a_configuration_is_the_one_in_use(tmp_path: Path) -> None:
    assert command("-o", tmp_path / "out.eds")[0] == 0
    shipped_eds = EDS.read_bytes()
    _, printed, _ = command()
    assert printed.encode() == shipped_eds
    assert (tmp_path / "out.eds").read_bytes() == shipped_eds
    mine = EDS.read_bytes().replace(b"ProductName=KONTRONIK ESC gateway", b"ProductName=my ESC")
    (tmp_path / "mine.eds").write_bytes(mine)
    file = configuration(tmp_path)
    assert command("-c", file)[1].encode() == mine
    file = configuration(tmp_path, "cia402_mirrors = false")
    assert command("-c", file)[1].encode() == without(mine, range(0x6000, 0x6800))


@pytest.mark.parametrize(
    ("output", "named"), [("left.dcf", "left.dcf"), ("mötor.dcf", "mine_1.dcf")]
)
def test_dcf_names_itself_and_the_eds_it_was_made_from(
    tmp_path: Path,
    output: str,
    named: str,
) -> None:
    shipped_name = b"FileName=kontronik_esc.eds\r\n"
    other_names = b"filename = old.eds\r\nLastEDS=older.eds\r\n"
    mine = EDS.read_bytes().replace(shipped_name, other_names)
    (tmp_path / "mine.eds").write_bytes(mine)
    file = configuration(tmp_path)
    assert command("-c", file, "--node-id", 1, "-o", tmp_path / output)[0] == 0
    head = (tmp_path / output).read_text("ascii").partition("[DeviceInfo]")[0]
    assert re.findall("(?im)^(filename|lasteds) ?= ?(.*)", head) == [
        ("FileName", named),
        ("LastEDS", "mine.eds"),
    ]


def test_node_answers_with_the_values_of_the_dcf() -> None:
    """The values encoded by the canopen library are equal to the data of SDO uploads."""
    node = shipped_canopen([5]).nodes([EscSettings()]).nodes[0]
    made = command("--node-id", 5)[1]
    dictionary = imported(made)
    assert "LSS_SerialNumber" not in made  # the node has no serial number
    assert dictionary.node_id == 5
    assert dictionary.bitrate == 500_000
    found = values(dictionary)
    assert len(found) > 100
    # a tool that writes all values must not store, restore or clear anything
    states = (0x1001, 0x1002, 0x1003, 0x1010, 0x1011, 0x1020, 0x1021, 0x2010, 0x2102, 0x603F)
    assert not {index for index, _ in found} & set(states)
    assert not set(found) & set(BINDINGS)
    for (index, sub), value in found.items():
        text = value.decode() if isinstance(value, bytes) else value
        data = dictionary.get_variable(index, sub).encode_raw(text)
        assert data == node.dictionary.upload(index, sub, 0), f"{index:04X}h:{sub:02X}"


def test_eds_dcf_and_node_have_the_configured_vendor_id(tmp_path: Path) -> None:
    (tmp_path / "mine.eds").write_bytes(EDS.read_bytes())
    file = configuration(tmp_path, "vendor_id = 0x319")
    code, eds, _ = command("-c", file)
    assert code == 0
    _, dcf, _ = command("-c", file, "--node-id", 1)
    for text in (eds, dcf):
        assert "VendorNumber=0x00000319" in text
        path = written(tmp_path / "read.eds", text)
        read: Any = canopen.import_od(str(path))
        assert read[0x1018][1].default == 0x319
        assert read.device_information.vendor_number == 0x319
        assert "no CiA vendor-ID" not in read.device_information.vendor_name
    assert "ParameterValue=0x00000319" in dcf
    loaded = load_configuration(file)
    (node,) = canopen_of(loaded).nodes(loaded.escs).nodes
    variable = node.dictionary.get(0x1018, 1)
    assert variable is not None
    assert node.dictionary.value(variable, 0) == 0x319
