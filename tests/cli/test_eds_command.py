"""``eds``: the EDS byte for byte, and DCFs that read back with the values of the node."""

import io
import os
import re
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import canopen
import pytest

from kontronik_can_gw import __version__
from kontronik_can_gw.cia301.bindings import bindings
from kontronik_can_gw.cia301.eds import load, without
from kontronik_can_gw.cia301.storage import Stored, encode
from kontronik_can_gw.cli import main
from kontronik_can_gw.cli.node_setup import shipped_canopen
from kontronik_can_gw.config import shipped
from kontronik_can_gw.telemetry import EscSettings

EDS = shipped("eds/kontronik_esc.eds")
Key = tuple[int, int]
TELEMETRY = bindings(EscSettings())


def command(*words: object) -> tuple[int, str, str]:
    """Exit code, standard output, talk. Standard output keeps its line ends, as in a pipe."""
    out, talk = io.TextIOWrapper(io.BytesIO(), encoding="utf-8"), io.StringIO()
    code: object
    with redirect_stdout(out), redirect_stderr(talk):
        try:
            code = main(["eds", *map(str, words)])
        except SystemExit as end:
            code = end.code
    out.flush()
    assert isinstance(out.buffer, io.BytesIO)
    assert isinstance(code, int)
    return code, out.buffer.getvalue().decode("ascii"), talk.getvalue()


def configuration(folder: Path, canopen_lines: str = "enabled = true", left: str = "", right: str = "") -> Path:
    file = folder / "gateway.toml"
    file.write_text(
        '[can]\ninterface = "virtual"\nbitrate = 250000\n[dbc]\nenabled = false\n'
        f'[canopen]\nstore = "kept"\n{canopen_lines}\n'
        f'[[esc]]\nname = "left"\nport = "/dev/ttyUSB0"\n{left}\n'
        f'[[esc]]\nname = "right"\nport = "/dev/ttyUSB1"\n{right}\n'
    )
    return file


def imported(text: str) -> Any:
    source = io.StringIO(text)
    source.name = "node.dcf"
    return canopen.import_od(source)


def values(dictionary: Any) -> dict[Key, int | bytes]:
    """Every ParameterValue, as the canopen library reads it."""
    found: dict[Key, int | bytes] = {}
    for item in dictionary.values():
        members = [item] if isinstance(item, canopen.objectdictionary.ODVariable) else list(item.values())
        for each in members:
            if each.value is not None:
                found[each.index, each.subindex] = each.value.encode() if isinstance(each.value, str) else each.value
    return found


def dcf_values(*words: object) -> dict[Key, int | bytes]:
    code, text, said = command(*words)
    assert (code, said) == (0, "")
    return values(imported(text))


# --- the EDS --------------------------------------------------------------------------------------------------------------


def test_without_a_node_id_the_shipped_eds_is_written_byte_for_byte(tmp_path: Path) -> None:
    assert command("-o", tmp_path / "out.eds") == (0, "", f"kontronik-can-gw: {tmp_path}/out.eds written\n")
    assert (tmp_path / "out.eds").read_bytes() == EDS.read_bytes()
    assert os.listdir(tmp_path) == ["out.eds"]
    code, text, said = command()
    assert (code, text.encode(), said) == (0, EDS.read_bytes(), "")


def test_the_eds_of_a_configuration_is_the_one_in_use(tmp_path: Path) -> None:
    mine = EDS.read_bytes().replace(b"ProductName=KONTRONIK ESC gateway", b"ProductName=my ESC")
    (tmp_path / "mine.eds").write_bytes(mine)
    file = configuration(tmp_path, 'enabled = true\neds = "mine.eds"')
    assert command("-c", file)[1].encode() == mine
    file = configuration(tmp_path, 'enabled = true\neds = "mine.eds"\ncia402_mirrors = false')
    assert command("-c", file)[1].encode() == without(mine, range(0x6000, 0x6800))


def test_a_process_writes_the_same_bytes_into_a_pipe() -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run(
        [sys.executable, "-m", "kontronik_can_gw", "eds"], capture_output=True, timeout=60, check=True, env=environment
    )
    assert (done.stdout, done.stderr) == (EDS.read_bytes(), b"")


# --- the DCF of the defaults ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("node_id", [1, 5, 127])
def test_the_dcf_of_the_defaults_has_the_default_of_every_object_that_is_configured(node_id: int) -> None:
    found = dcf_values("--node-id", node_id)
    defaults: dict[Key, int | bytes] = {}
    for entry in load(EDS.read_bytes(), "x").entries:
        value = entry.default
        assert not isinstance(value, float)
        if value is not None:
            defaults[entry.index, entry.sub] = value + node_id if entry.relative and isinstance(value, int) else value
    left_out = {0x1001, 0x1002, 0x1003, 0x1010, 0x1011, 0x1020, 0x1021, 0x2010, 0x2102, 0x603F}
    expected = {key: value for key, value in defaults.items() if key[0] not in left_out and key not in TELEMETRY}
    own = {(0x100A, 0), *((0x2101, sub) for sub in (1, 3, 4))}
    assert set(found) == set(expected)
    assert {key: found[key] for key in expected if key not in own} == {
        k: v for k, v in expected.items() if k not in own
    }
    assert found[0x100A, 0] == __version__.encode()
    assert [found[0x2101, sub] for sub in (1, 2, 3, 4)] == [node_id, node_id, 500_000, 500_000]
    assert found[0x1800, 1] == 0x40000180 + node_id


def test_a_dcf_without_a_configuration_names_no_serial_number_to_look_for() -> None:
    text = command("--node-id", 3)[1]
    assert "LSS_SerialNumber" not in text
    assert values(imported(text))[0x1018, 4] == 0
    assert imported(text).node_id == 3
    assert imported(text).bitrate == 500_000


def test_telemetry_states_and_commands_are_not_in_a_dcf() -> None:
    """A tool that writes all values must not store, restore or clear anything."""
    found = dcf_values("--node-id", 1)
    for index in (0x1001, 0x1002, 0x1003, 0x1010, 0x1011, 0x1021, 0x2010, 0x2102, 0x603F):
        assert not [key for key in found if key[0] == index]
    for index in (0x2000, 0x2001, 0x2011, 0x2020, 0x2021):
        assert [key for key in found if key[0] == index] == [(index, 0)]
    assert not {(0x606C, 0), (0x6079, 0)} & set(found)


def test_a_dcf_is_the_eds_with_values_added() -> None:
    lines = command("--node-id", 1)[1].split("\r\n")
    begin = lines.index("[DeviceComissioning]")
    del lines[begin : lines.index("", begin) + 1]
    assert lines[1:3] == ["FileName=kontronik_esc_1.dcf", "LastEDS=kontronik_esc.eds"]
    lines[1:3] = ["FileName=kontronik_esc.eds"]
    assert [line for line in lines if not line.startswith("ParameterValue=")] == EDS.read_text("ascii").split("\n")


@pytest.mark.parametrize(
    ("output", "named"), [("left.dcf", "left.dcf"), ("mötor.dcf", "mine_1.dcf"), ("a;b.dcf", "mine_1.dcf")]
)
def test_a_dcf_names_itself_and_the_eds_it_was_made_from(tmp_path: Path, output: str, named: str) -> None:
    lines = EDS.read_bytes().replace(b"FileName=kontronik_esc.eds\r\n", b"filename = old.eds\r\nLastEDS=older.eds\r\n")
    (tmp_path / "mine.eds").write_bytes(lines)
    file = configuration(tmp_path, 'enabled = true\neds = "mine.eds"')
    assert command("-c", file, "--node-id", 1, "-o", tmp_path / output)[0] == 0
    head = (tmp_path / output).read_text("ascii").partition("[DeviceInfo]")[0]
    assert re.findall("(?im)^(filename|lasteds) ?= ?(.*)", head) == [("FileName", named), ("LastEDS", "mine.eds")]


# --- the DCF of a configured node -----------------------------------------------------------------------------------------


def test_the_dcf_of_a_configured_node_has_its_settings_identity_and_what_a_master_stored(tmp_path: Path) -> None:
    file = configuration(
        tmp_path,
        "enabled = true\nnode_id = 20\nvendor_id = 0x123\nserial = 1000\nself_start = true",
        right='pole_pairs = 7\ngear = "5/2"\ncell_count = 12\ntelemetry_timeout_ms = 400',
    )
    (tmp_path / "kept").mkdir()
    stored = Stored(
        33,
        {0x101700: bytes.fromhex("F401"), 0x180003: bytes.fromhex("E803"), 0x1A0000: b"\x01"},
        {0x210006: bytes.fromhex("FF000000")},
    )
    (tmp_path / "kept" / "right.params").write_bytes(encode(stored))
    code, text, said = command("-c", file, "--node-id", 33)
    assert (code, said) == (0, "")
    dictionary = imported(text)
    assert (dictionary.node_id, dictionary.bitrate) == (33, 250_000)
    assert "NodeName=right\r\n" in text
    assert "LSS_SerialNumber=0x000003E9\r\n" in text
    found = values(dictionary)
    assert [found[0x1018, sub] for sub in (1, 4)] == [0x123, 1001]
    assert [found[0x2100, sub] for sub in range(1, 9)] == [7, 5, 2, 400, 0, 0xFF, 12, 5]
    assert [found[0x2101, sub] for sub in (1, 2, 3, 4)] == [33, 33, 250_000, 250_000]
    assert (found[0x1017, 0], found[0x1800, 3], found[0x1A00, 0], found[0x1F80, 0]) == (500, 1000, 1, 0)
    assert (found[0x1014, 0], found[0x1200, 1], found[0x1803, 1]) == (0xA1, 0x621, 0x400004A1)

    of_left = dcf_values("-c", file, "--node-id", "0x14")
    assert (of_left[0x1018, 4], of_left[0x1017, 0], of_left[0x2100, 1]) == (1000, 1000, 1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["gateway.toml", "kept"]


def test_what_is_in_the_dcf_is_what_the_node_answers() -> None:
    """Byte for byte: encoded by the canopen library, and as an SDO upload gives it."""
    node = shipped_canopen([5]).nodes([EscSettings()]).nodes[0]
    dictionary = imported(command("--node-id", 5)[1])
    found = values(dictionary)
    assert len(found) > 100
    for (index, sub), value in found.items():
        variable = dictionary.get_variable(index, sub)
        text = value.decode() if isinstance(value, bytes) else value
        assert variable.encode_raw(text) == node.dictionary.upload(index, sub, 0), f"{index:04X}h:{sub:02X}"


def test_nodes_of_one_configuration_differ_in_what_is_their_own_only(tmp_path: Path) -> None:
    file = configuration(tmp_path, "enabled = true\nserial = 7", left="pole_pairs = 3")
    left = dcf_values("-c", file, "--node-id", 1)
    right = dcf_values("-c", file, "--node-id", 2)
    assert set(left) == set(right)
    assert {key for key in left if left[key] != right[key]} == {
        *((0x1014, 0), (0x1018, 4), (0x1200, 1), (0x1200, 2), (0x2100, 1), (0x2101, 1), (0x2101, 2)),
        *((0x1800 + n, 1) for n in range(4)),
    }


def test_dcfchk_has_no_finding(tmp_path: Path) -> None:
    pytest.importorskip("dcf", reason="dcf-tools is not installed")
    file = configuration(tmp_path, "enabled = true\nserial = 5", left="pole_pairs = 3")
    for node_id, words in ((9, []), (1, ["-c", file])):
        dcf = tmp_path / f"{node_id}.dcf"
        assert command(*words, "--node-id", node_id, "-o", dcf)[0] == 0
        checker = [sys.executable, "-c", "from dcf.cli import main; main()", "-n", str(node_id), str(dcf)]
        done = subprocess.run(checker, capture_output=True, text=True, check=False, timeout=60)
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


# --- bad input ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["0", "128", "255", "-1", "five", "0x", "1.5", ""])
def test_a_number_that_is_no_node_id_is_told_so(text: str) -> None:
    code, out, said = command(f"--node-id={text}")
    assert (code, out) == (2, "")
    assert said.splitlines()[-1].endswith(f"argument --node-id: {text!r} is not a node-ID, 1 to 127")


@pytest.mark.parametrize(
    ("lines", "right", "expected"),
    [
        ("enabled = true\nnode_id = 20", "", "There are 20, 21."),
        ("enabled = true\nnode_id = 20", "node_id = 255", "There is 20."),
        ("enabled = true\nnode_id = 255", "", "All wait for LSS."),
    ],
)
def test_a_node_id_that_no_node_has_is_refused_with_those_there_are(
    lines: str, right: str, expected: str, tmp_path: Path
) -> None:
    code, out, said = command("-c", configuration(tmp_path, lines, right=right), "--node-id", 5)
    assert (code, out) == (2, "")
    assert said == f"kontronik-can-gw eds: --node-id 5: no node of the configuration has it. {expected}\n"


def one_line(result: tuple[int, str, str], code: int = 2) -> str:
    assert result[:2] == (code, "")
    assert result[2].count("\n") == 1
    return result[2]


def test_bad_files_are_one_line(tmp_path: Path) -> None:
    assert "none.toml: cannot be read" in one_line(command("-c", tmp_path / "none.toml"))
    said = one_line(command("-c", configuration(tmp_path, 'enabled = true\neds = "none.eds"'), "--node-id", 1))
    assert "none.eds: cannot be read" in said
    (tmp_path / "bad.eds").write_bytes(EDS.read_bytes().replace(b"SupportedObjects=3\r", b"SupportedObjects=4\r", 1))
    assert "bad.eds: [MandatoryObjects]" in one_line(
        command("-c", configuration(tmp_path, 'enabled = true\neds = "bad.eds"'))
    )
    file = tmp_path / "off.toml"
    file.write_text('[can]\ninterface = "virtual"\n[[esc]]\nport = "/dev/ttyUSB0"\n')
    for words in (["-c", file], ["-c", file, "--node-id", 1]):
        assert f"{file}: canopen.enabled is false" in one_line(command(*words))


def test_a_file_that_cannot_be_written_is_one_line_and_leaves_nothing_behind(tmp_path: Path) -> None:
    for more in ([], ["--node-id", 1]):
        said = one_line(command(*more, "-o", tmp_path / "none" / "out.dcf"), 1)
        assert re.search(r"none/out\.dcf: cannot be written: No such file or directory", said)
    assert os.listdir(tmp_path) == []
