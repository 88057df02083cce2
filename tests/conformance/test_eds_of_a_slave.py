"""EDS files of other makers are accepted, or refused with the section and key of the mistake."""

import inspect
from pathlib import Path

import pytest
from command_line import refused
from dialogue import Bench
from script import MS
from simulated_slave import EDS, simulated_slave

from kontronik_can_gw.canopen.eds import load
from kontronik_can_gw.canopen.eds_changes import with_vendor_id
from kontronik_can_gw.desk.conformance import run as run_module
from kontronik_can_gw.desk.conformance.eds_file import EdsFile, read_eds
from kontronik_can_gw.desk.conformance.run import chosen_items, run
from kontronik_can_gw.desk.conformance.slave import Slave

pytestmark = pytest.mark.promise("conformance")

_DUMMIES = "".join(f"Dummy{index:04d}={int(index > 1)}\n" for index in range(1, 8))


def eds_with(folder: Path, *changes: tuple[str, str]) -> Path:
    """Write the shipped EDS with changes of its text."""
    text = EDS.read_bytes().decode("ascii")
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    path = folder / "x.eds"
    path.write_bytes(text.encode())
    return path


def verdicts(eds: EdsFile, *words: str, bench: Bench | None = None) -> dict[str, str]:
    """Return the verdicts of the items whose names contain one of the words."""
    slave = simulated_slave(eds=eds, bench=bench)
    return {
        result.item.name: result.verdict.value for result in run(slave, chosen_items(words), {})
    }


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("VendorNumber=0x00000000", "VendorNumber="),
        ("ProductNumber=0x4B4F4E01", "ProductNumber="),
        ("[1017]", "[1017]\r\n; milliseconds"),
        ("[FileInfo]", "\ufeff[FileInfo]"),
    ],
)
def test_empty_entry_a_comment_and_a_mark_are_accepted(tmp_path: Path, old: str, new: str) -> None:
    eds = read_eds(eds_with(tmp_path, (old, new)), 1)
    assert set(verdicts(eds, "od-identity", "od-values", "eds-").values()) == {"passed"}


def test_dummy_objects_are_not_read(tmp_path: Path) -> None:
    """CiA 301 lets them exist for mapping only."""
    eds = read_eds(eds_with(tmp_path, ("[DummyUsage]", f"[DummyUsage]\n{_DUMMIES}[Other]")), 1)
    assert set(verdicts(eds, "od-each", "od-values", "sdo-write-to-a-constant").values()) == {
        "passed"
    }


def test_items_of_an_array_need_its_first_entry(tmp_path: Path) -> None:
    arrays = ("1003", "1010", "1011")
    changes = [(f"[{index}sub1]", f"[{index}sub70]") for index in arrays]
    eds = read_eds(eds_with(tmp_path, *changes), 1)
    items = ("emcy-history", "store-", "restore-")
    found = {name: verdict for name, verdict in verdicts(eds, *items).items() if "lss" not in name}
    assert len(found) >= 7
    assert set(found.values()) == {"not supported"}


def test_every_procedure_of_a_module_is_an_item() -> None:
    written = set()
    for module in run_module._GROUPS.values():
        for name, procedure in vars(module).items():
            if getattr(procedure, "__module__", "") != module.__name__ or name.startswith("_"):
                continue
            if inspect.get_annotations(procedure) == {"slave": Slave, "return": str}:
                written.add(procedure)
    assert {item.run for item in run_module.all_items()} == written


def test_eds_without_device_info_is_judged(tmp_path: Path) -> None:
    text = EDS.read_text()
    begin = text.index("[DeviceInfo]")
    end = text.index("[", begin + 1)
    path = tmp_path / "x.eds"
    path.write_text(text[:begin] + text[end:])
    found = verdicts(read_eds(path, 1), "eds-", "lss-store")
    assert found["eds-sections"] == found["eds-bit-rates"] == "failed"
    assert found["lss-store"] == "not supported"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "VendorNumber=0x00000000",
            "VendorNumber=mine",
            "[DeviceInfo] VendorNumber=mine: not a number.",
        ),
        ("LSS_Supported=1", "LSS_Supported=yes", "[DeviceInfo] LSS_Supported=yes: not a number."),
        ("1=0x1000", "1=1000h", "[MandatoryObjects] 1=1000h: not a number. Use the form 0x1F"),
        ("[1017]\r\n", "[1017]\r\nPDOMapping=0\r\n", "[1017] PDOMapping: this key occurs twice."),
        ("[1018]", "[1F99]\r\nDataType=7", "[1018sub0] there is no section [1018]. Add it."),
        ("[1017]\r\n", "[1017]\r\nx\r\n", "[1017] 'x' is neither a section, nor key=value"),
    ],
)
def test_mistake_names_section_and_key(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = eds_with(tmp_path, (old, new))
    assert f"{path}: {message}" in refused(2, "conformance", "--eds", path)


@pytest.mark.parametrize("number", ["-1", "0", "5", "99"])
@pytest.mark.parametrize(
    ("index", "name", "right"),
    [("1017", "Producer heartbeat time", "0x7"), ("1801", "TPDO 2 communication parameter", "0x9")],
)
def test_wrong_object_type_is_named(
    tmp_path: Path, index: str, name: str, right: str, number: str
) -> None:
    begin = f"[{index}]\r\nParameterName={name}\r\nObjectType="
    path = eds_with(tmp_path, (begin + right, begin + number))
    assert refused(2, "conformance", "--eds", path) == (
        f"{path}: [{index}] ObjectType={number}: not the type of an object. "
        "Use 0x2, 0x7, 0x8 or 0x9."
    )


def test_object_types_of_data_types_are_accepted(tmp_path: Path) -> None:
    path = eds_with(tmp_path, ("[1000]", "[0020]\nParameterName=Own\nObjectType=6\n\n[1000]"))
    assert 0x1000 in read_eds(path, 1).dictionary


def test_vendor_id_of_your_own_passes_with_its_eds(tmp_path: Path) -> None:
    path = tmp_path / "mine.eds"
    path.write_bytes(with_vendor_id(EDS.read_bytes(), 0x319))
    bench = Bench(
        boot=False,
        eds=load(path.read_bytes(), "mine.eds"),
        escs={"timeout_ns": 1000 * MS},
        vendor_id=0x319,
    )
    found = verdicts(read_eds(path, 1), "od-identity", "od-vendor", "od-values", bench=bench)
    assert set(found.values()) == {"passed"}
    assert len(found) == 3


def test_eds_without_defaults_is_judged(tmp_path: Path) -> None:
    lines = EDS.read_text().splitlines()
    path = tmp_path / "x.eds"
    path.write_text("\n".join(line for line in lines if not line.startswith("DefaultValue")))
    found = verdicts(read_eds(path, 1), "")
    failed = {name for name, verdict in found.items() if verdict == "failed"}
    assert failed == {"od-vendor-id-is-assigned"}
