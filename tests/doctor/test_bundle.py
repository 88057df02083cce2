"""`doctor --bundle`: the zip file is complete, has no secret, and is written in every situation."""

import contextlib
import errno
import json
import os
import resource
import shutil
import stat
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from capture_bench import Bench, capture, capture_file, made
from command_line import Done, refused, run, written
from doctor_trees import Tree
from rights import modes_apply

from kontronik_can_gw.assembly.assemble import load_configuration
from kontronik_can_gw.capture.format import (
    SUFFIX,
    Block,
    EntryKind,
    Scanner,
    block,
    json_payload,
    read_json,
)
from kontronik_can_gw.cli.bundle import capture_folders
from kontronik_can_gw.cli.recording import setup_of
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.bundle import archive
from kontronik_can_gw.desk.bundle.archive import write_archive
from kontronik_can_gw.desk.bundle.captures import clean_capture
from kontronik_can_gw.desk.bundle.parts import Contents, add_journal
from kontronik_can_gw.desk.bundle.secrets import Cleaner
from kontronik_can_gw.desk.doctor.service import ServiceUnit
from kontronik_can_gw.desk.recordings.inputs import open_input

pytestmark = pytest.mark.promise("support-bundle")

SECRETS = ("hunter2", "c0rrect h0rse", "t0k3n", "c0mment", "s3ed", "p1ace", "acc3ss", "pl4nt")
CONFIGURATION = """# the broker's password: hunter2 (c0mment)
[can]
interface = "virtual"
channel = "bundle"
options.access_code = "acc3ss"
[dbc]
file = "car.dbc"
[canopen]
enabled = true
eds = "node.eds"
store = "store"
[record]
directory = "captures"
[mqtt]
broker = "broker.example"
username = "t0k3n"   # of the cloud, password c0mment
password_file = "pass.txt"
[[esc]]
port = "rfc2217://anna:hunter2@10.0.0.1:4000"
"""


@pytest.fixture
def setup(tmp_path: Path) -> Path:
    """Return a configuration with secrets in it and in its DBC, EDS and captures."""
    dbc = shipped("dbc/kontronik_esc.dbc").read_text(encoding="latin-1")
    dbc += 'CM_ "c0mment";\nBA_DEF_ "SeedKey" STRING ;\nBA_DEF_DEF_ "SeedKey" "s3ed";\n'
    dbc += 'BA_DEF_ "Plant" STRING ;\nBA_DEF_DEF_ "Plant" "pl4nt";\n'
    written(tmp_path / "car.dbc", dbc.encode("latin-1"))
    eds = shipped("eds/kontronik_esc.eds").read_bytes()
    written(tmp_path / "node.eds", eds + b"\n; c0mment\n")
    written(tmp_path / "pass.txt", "c0rrect h0rse\nc0mment\n")
    file = written(tmp_path / "gateway.toml", CONFIGURATION)
    folder = tmp_path / "captures"
    folder.mkdir()
    recorded = setup_of(load_configuration(file))
    for number, name in enumerate(("old", "newer", "newest")):
        path = capture(folder / f"{name}{SUFFIX}", recorded, [], note="password: p1ace")
        os.utime(path, (number, number))
    written(folder / "other.txt", "hunter2")
    return file


def bundle(file: Path, *words: object) -> tuple[Done, dict[str, bytes]]:
    """Make a bundle. Return the result of the command and the files in the bundle."""
    path = file.parent / "bundle.zip"
    done = run("doctor", "-c", file, "--bundle", path, "--force", *words)
    return done, opened(path)


def opened(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as found:
        assert found.testzip() is None
        return {name: found.read(name) for name in found.namelist()}


def everything(files: dict[str, bytes]) -> str:
    """Return all texts in the bundle, also the inflated blocks of captures."""
    texts = []
    for name, data in files.items():
        texts += [name, data.decode("utf-8", "replace"), data.decode("latin-1")]
        if name.endswith(SUFFIX):
            texts += [block.payload.decode("latin-1") for block in blocks(data)]
    return "\n".join(texts)


def blocks(data: bytes) -> list[Block]:
    scanner = Scanner()
    return [found for found in (*scanner.feed(data), *scanner.flush()) if isinstance(found, Block)]


# --- content


def test_bundle_has_all_parts_and_no_secret(setup: Path) -> None:
    done, files = bundle(setup)
    assert done.code == 0, done
    assert done.out == ""
    assert set(files) == {
        "README.txt",
        "doctor.txt",
        "check.txt",
        "status.txt",
        "configuration/gateway.toml",
        "dbc/car.dbc",
        "eds/node.eds",
        "versions.json",
        "captures/newer.kcap",
        "captures/newest.kcap",
    } | ({"journal.txt"} & set(files))
    for secret in SECRETS:
        assert secret not in everything(files), secret
        assert secret not in done.err
    assert b"broker.example" in files["configuration/gateway.toml"]
    assert b"Serial port of esc1" in files["doctor.txt"]
    assert b"can be used" in files["check.txt"]
    assert b"no gateway runs with this configuration" in files["status.txt"]
    versions = json.loads(files["versions.json"])
    assert versions["kontronik-can-gw"]
    assert "dbc/car.dbc" in versions["sha256"]
    assert str(setup) not in versions["sha256"], "the digest of a file with a secret"


def test_old_name_of_the_option_writes_the_same_bundle(setup: Path, tmp_path: Path) -> None:
    path = tmp_path / "old.zip"
    assert run("doctor", "-c", setup, "--parcel", path, "--without-captures").code == 0
    with zipfile.ZipFile(path) as found:
        assert "doctor.txt" in found.namelist()
    assert "--parcel" not in run("doctor", "--help").out


def test_readme_lists_what_was_removed_and_what_is_missing(setup: Path) -> None:
    done, files = bundle(setup)
    readme = files["README.txt"].decode()
    for line in (
        "configuration/gateway.toml: 2 x comment",
        "configuration/gateway.toml: 1 x username",
        "configuration/gateway.toml: 1 x password_file",
        "configuration/gateway.toml: 1 x user and password in a URL",
        "dbc/car.dbc: 2 x attribute SeedKey",
        "captures/newest.kcap: 2 x attribute SeedKey",
        "no gateway runs with this configuration",
    ):
        assert line in readme
    missing = readme.partition("Missing:\n")[2].partition("\n\n")[0].splitlines()
    assert [line.partition("missing: ")[2] for line in done.err.splitlines()[:-1]] == [
        line.strip() for line in missing
    ]


def test_only_the_owner_may_read_the_bundle(setup: Path) -> None:
    bundle(setup)
    assert stat.S_IMODE((setup.parent / "bundle.zip").stat().st_mode) == 0o600


def test_options_leave_out_captures_and_the_dbc(setup: Path) -> None:
    done, files = bundle(setup, "--without-captures")
    assert not any(name.startswith("captures/") for name in files)
    assert "missing: captures: left out by --without-captures" in done.err
    done, files = bundle(setup, "--without-dbc")
    assert "EscStatus" not in everything(files).replace("EscStatus:", "")
    assert "missing: dbc: left out by --without-dbc" in done.err
    header = read_json(blocks(files["captures/newest.kcap"])[0].payload)
    assert header["dbc"] is None
    assert header["canopen"]["eds"]["text"]


def test_holes_of_a_sparse_capture_are_not_read(setup: Path, tmp_path: Path) -> None:
    """Reading 8 TB of zeros would take hours. A block behind the hole is kept."""
    path = tmp_path / "captures" / f"newest{SUFFIX}"
    behind = block(b"I", 7, json_payload({"devices": []}))
    end = 1 << 43
    with path.open("r+b") as file:
        begin = file.read()
        try:
            file.seek(end // 2)
            file.write(behind)
            file.truncate(end)
        except OSError as error:
            pytest.skip(f"this file system has no sparse file of 8 TB: {error}")
    done, files = bundle(setup)
    assert done.code == 0, done.err
    kept = [found.number for found in blocks(files[f"captures/{path.name}"])]
    assert kept == [found.number for found in blocks(begin)] + [7]


def test_existing_file_is_kept_without_force(setup: Path) -> None:
    path = written(setup.parent / "mine.zip", "x")
    assert "exists" in refused(2, "doctor", "-c", setup, "--bundle", path)
    assert path.read_text() == "x"
    link = setup.parent / "link.zip"
    link.symlink_to(path)
    assert "exists" in refused(2, "doctor", "-c", setup, "--bundle", link)
    assert run("doctor", "-c", setup, "--bundle", link, "--force").code == 0
    assert not link.is_symlink()
    assert path.read_text() == "x"
    assert "would overwrite" in refused(2, "doctor", "-c", setup, "--bundle", setup, "--force")
    assert "cannot be shown" in refused(2, "doctor", "-c", setup, "--bundle", "-")


# --- faults


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda file: file.write_text(CONFIGURATION + "nonsense = 1\n"), "nonsense"),
        (lambda file: file.write_text("[mqtt\npassword = hunter2\n"), "is not valid TOML"),
        (lambda file: (file.parent / "car.dbc").write_text("BO_ hunter2"), "car.dbc"),
        (lambda file: file.unlink(), "No such file"),
        (lambda file: (file.unlink(), file.mkdir()), "is not a file"),
        (lambda file: file.write_bytes(b"\xff\xfe\0"), "is not a UTF-8 text file"),
        (lambda file: shutil.rmtree(file.parent / "captures"), "captures: "),
        (lambda file: (file.parent / "pass.txt").unlink(), "doctor.txt"),
        (lambda file: (file.parent / "node.eds").write_text("x"), "is not an EDS"),
    ],
)  # fmt: skip
def test_fault_of_a_file_leaves_the_rest_of_the_bundle(
    setup: Path, change: object, said: str
) -> None:
    assert callable(change)
    change(setup)
    done, files = bundle(setup)
    assert done.code == 0
    assert "Traceback" not in done.err
    assert {"README.txt", "doctor.txt", "check.txt", "status.txt", "versions.json"} <= set(files)
    assert said in everything(files) + done.err
    files.pop("dbc/car.dbc", None)  # it has the name of a message
    assert "hunter2" not in everything(files)


def test_password_in_place_of_its_file_is_removed(setup: Path) -> None:
    setup.write_text(CONFIGURATION.replace("pass.txt", "p1ace of a key").replace("hunter2", ""))
    _, files = bundle(setup)
    assert "p1ace" not in everything(files)


def test_machine_without_a_configuration_gets_a_bundle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = run("doctor", "--bundle", "bundle.zip")
    assert done.code == 0
    assert b"cannot be read" in opened(tmp_path / "bundle.zip")["doctor.txt"]


class Disk:
    """A disk on which a number of bytes has room, used in place of os.write."""

    def __init__(self, room: int) -> None:
        self.room = room

    def write(self, fd: int, data: bytes) -> None:
        if os.lseek(fd, 0, os.SEEK_CUR) + len(data) > self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        os.write(fd, data)


def contents_of(*sizes: int) -> Contents:
    contents = Contents(Cleaner())
    for number, size in enumerate(sizes):
        contents.add(f"part{number}", os.urandom(size))
    return contents


@pytest.mark.parametrize(("room", "left"), [(1 << 20, 3), (90_000, 2), (20_000, 1), (3_000, 0)])
def test_on_a_full_disk_the_largest_parts_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int, left: int
) -> None:
    monkeypatch.setattr(archive, "write_all", Disk(room).write)
    contents = contents_of(60_000, 10_000, 100_000)
    path = tmp_path / "bundle.zip"
    with path.open("wb") as file:
        write_archive(file, contents, 1_700_000_000 * 10**9)
    files = opened(path)
    assert len(files) == left + 1
    assert len(contents.missing) == 3 - left
    for line in contents.missing:
        assert line in files["README.txt"].decode()
        assert "do not fit on the disk: No space left on device" in line
    if left < 3:
        assert contents.missing[0].startswith("part2: 0.1 MB")


def test_disk_without_any_room_is_one_line(setup: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archive, "write_all", Disk(0).write)
    path = setup.parent / "bundle.zip"
    line = refused(1, "doctor", "-c", setup, "--bundle", path)
    assert line == f"{path}: cannot be written: No space left on device."
    assert not list(setup.parent.glob("bundle.zip*"))


def test_limit_of_the_system_for_files_leaves_out_captures(setup: Path) -> None:
    """This is a real failure of write(2), in a process that may write small files only."""
    big = setup.parent / "captures" / f"big{SUFFIX}"
    noise = b"".join(block(b"D", n, os.urandom(1 << 16)) for n in range(20))
    written(big, noise)
    path = setup.parent / "bundle.zip"
    command = [sys.executable, "-m", "kontronik_can_gw", "doctor"]
    command += ["-c", str(setup), "--bundle", str(path)]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20)),
    )
    assert done.returncode == 0, done
    assert f"missing: captures/{big.name}: " in done.stderr
    assert "File too large" in done.stderr
    assert "doctor.txt" in opened(path)


@pytest.mark.rights
def test_without_rights_each_unreadable_part_is_one_line(setup: Path) -> None:
    with tempfile.TemporaryDirectory() as place, as_another_user(Path(place), setup) as file:
        file.chmod(0o600 if os.geteuid() != file.stat().st_uid else 0)
        closed = file.parent / "captures"
        with modes_apply(Path(place)):
            done = run("doctor", "-c", file, "--bundle", f"{place}/out/bundle.zip")
            files = opened(Path(place, "out/bundle.zip"))
        closed.chmod(0o700)
    assert done.code == 0, done
    assert "missing: configuration/gateway.toml: " in done.err
    assert "Permission denied. Run doctor with sudo." in done.err
    assert {"README.txt", "doctor.txt", "versions.json"} <= set(files)


@contextlib.contextmanager
def as_another_user(place: Path, setup: Path) -> Iterator[Path]:
    """Copy a setup to a folder that others can enter, with a folder for output."""
    place.chmod(0o755)
    shutil.copytree(setup.parent, place / "setup")
    (place / "out").mkdir()
    (place / "out").chmod(0o777)
    yield place / "setup" / setup.name


# --- journal


class Journal(Tree):
    """A machine with a journal."""

    def __init__(self, root: Path, out: str, err: str | None) -> None:
        super().__init__(root)
        self.answer = (out, err)

    def outputs(self, *command: str, patience_s: float = 5.0) -> tuple[str, str | None]:
        assert command[0] == "journalctl"
        assert "kontronik-can-gw*" in command
        return self.answer


def test_journal_of_our_services_is_added_without_secrets(tmp_path: Path) -> None:
    line = "2026-11-28T10:00:00+0000 pi kontronik-can-gw[6]: mqtt.broker: 'mqtt://a:hunter2@b' no"
    contents = Contents(Cleaner())
    add_journal(contents, Journal(tmp_path, f"-- Boot 1 --\n{line}\n", ""))
    text = b"".join(contents.parts[0].chunks()).decode()
    assert text == line.replace("a:hunter2@", "<removed>@") + "\n"
    assert contents.missing == []


@pytest.mark.parametrize(
    ("err", "said"),
    [
        (None, "there is no journalctl on this machine"),
        ("", "have written nothing in the last day"),
        ("Hint: You are currently not seeing messages from other users", "Run doctor with sudo."),
        ("No journal files were opened due to insufficient permissions.", "anna may not read it"),
    ],
)
def test_missing_journal_has_its_reason(tmp_path: Path, err: str | None, said: str) -> None:
    contents = Contents(Cleaner())
    add_journal(contents, Journal(tmp_path, "-- No entries --\n" if err == "" else "", err))
    assert contents.parts == []
    assert said in contents.missing[0]


# --- captures


def test_captures_of_the_running_gateway_and_of_the_service_are_found(tmp_path: Path) -> None:
    file = written(
        tmp_path / "gateway.toml", '[record]\ndirectory = "state"\n[[esc]]\nport = "x"\n'
    )
    unit = ServiceUnit("kontronik-can-gw@left.service", {})
    document = {"gateways": [{"document": {"recording": {"file": "/data/run/a.kcap"}}}]}
    found = list(capture_folders(Tree(tmp_path), file, unit, document))
    state = tmp_path / "var/lib/kontronik-can-gw-left/captures"
    assert found == [Path("/data/run"), state]
    assert list(
        capture_folders(Tree(tmp_path), file, unit, {"gateways": [{"document": None}]})
    ) == [state]


@pytest.mark.parametrize("canopen", [False, True])
def test_copy_without_secrets_replays_to_the_same_frames(tmp_path: Path, canopen: bool) -> None:
    bench = Bench(*made(2, canopen=canopen, dronecan={"enabled": True})).live(3, 2)
    original = capture_file(bench.setup, bench.entries, ["KOSMIK", "JIVEPRO"])
    chunks = [original[at : at + 999] for at in range(0, len(original), 999)]
    cleaner = Cleaner({"e0": "mqtt.username"})
    copy = b"".join(clean_capture(chunks, "c", cleaner, with_dbc=True))
    assert set(cleaner.removed["c"]) == {"comment"}
    assert frames(tmp_path, copy) == frames(tmp_path, original)
    assert frames(tmp_path, original), "it has frames"


def frames(folder: Path, data: bytes) -> list[object]:
    with open_input(written(folder / f"x{SUFFIX}", data)) as found:
        assert found.damage == []
        return [frame for batch in found.batches() for frame in batch]


def test_copy_without_the_dbc_keeps_telemetry(tmp_path: Path) -> None:
    bench = Bench(*made(1)).live(3, 1)
    original = capture_file(bench.setup, bench.entries)
    copy = b"".join(clean_capture([original], "c", Cleaner(), with_dbc=False))
    with open_input(written(tmp_path / f"x{SUFFIX}", copy)) as found:
        data = b"".join(found.esc_bytes(0))
    expected = [entry.data for entry in bench.entries if entry.kind == EntryKind.BYTES]
    assert data == b"".join(expected)
    assert b"EscStatus" not in b"".join(found.payload for found in blocks(copy))


def test_damage_and_unknown_blocks_are_left_out_of_a_copy() -> None:
    good = capture_file(Bench(*made(1)).setup, [])
    damage = b"hunter2" * 9
    unknown = block(b"X", 7, b"hunter2")
    unreadable = block(b"I", 8, b"hunter2")
    cleaner = Cleaner()
    data = good + damage + unknown + unreadable
    copy = b"".join(clean_capture([data], "c", cleaner, with_dbc=True))
    assert b"hunter2" not in copy
    assert [found.kind for found in blocks(copy)] == [b"H", b"E"]
    assert cleaner.removed["c"]["damaged byte"] == len(damage)
    assert cleaner.removed["c"]["block of an unknown kind"] == 1


def test_header_of_a_capture_of_another_version_is_cleaned_too() -> None:
    header = {"configuration": 'password = "hunter2"', "new": ["mqtt://a:hunter2@b"], "dbc": None}
    data = block(b"H", 0, json.dumps(header).encode())
    copy = b"".join(clean_capture([data], "c", Cleaner(), with_dbc=True))
    found = read_json(blocks(copy)[0].payload)
    assert tomllib.loads(found["configuration"]) == {"password": "<removed>"}
    assert found["new"] == ["mqtt://<removed>@b"]
