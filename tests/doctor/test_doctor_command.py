"""The command ``doctor``: exit codes and the JSON document.

It sends nothing to an ESC and changes nothing on the disk.
"""

import ast
import json
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import run, written
from statistics_bench import Bench

from kontronik_can_gw.desk.doctor import ports
from kontronik_can_gw.desk.pty import PtyEsc
from kontronik_can_gw.runtime.status.facts import PortFacts, program_facts

pytestmark = pytest.mark.promise("doctor")


@pytest.fixture
def esc() -> Iterator[PtyEsc]:
    with PtyEsc() as terminal:
        yield terminal
        terminal.check()
        assert terminal.received == 0, "something was transmitted to an ESC"


def configuration(folder: Path, port: str, more: str = "") -> Path:
    text = f'[can]\ninterface = "virtual"\nchannel = "doctor"\n{more}\n[[esc]]\nport = "{port}"\n'
    return written(folder / "gateway.toml", text)


def document(file: Path, code: int) -> tuple[list[dict[str, str]], list[dict[str, str]]]:
    """Return all findings and the errors of the JSON document, after checking its form."""
    done = run("doctor", "-c", file, "--json")
    assert done.code == code
    assert done.err == ""
    found = json.loads(done.out)
    keys = "format version config exit_code errors warnings findings"
    assert " ".join(found) == keys
    assert found["format"] == 1
    assert found["exit_code"] == code
    findings = found["findings"]
    for finding in findings:
        assert set(finding) == {"group", "check", "severity", "text", "remedy", "command"}
    errors = [finding for finding in findings if finding["severity"] == "error"]
    warnings = [finding for finding in findings if finding["severity"] == "warning"]
    assert found["errors"] == len(errors)
    assert found["warnings"] == len(warnings)
    return findings, errors


def test_usable_setup_has_exit_code_0_and_plain_text_in_a_pipe(tmp_path: Path, esc: PtyEsc) -> None:
    done = run("doctor", "-c", configuration(tmp_path, esc.path))
    assert done.code == 0
    assert done.err == ""
    for group in ("Configuration", "Serial port of esc1", "CAN doctor", "Machine"):
        assert f"{group}\n" in done.out
    assert "\x1b" not in done.out
    assert done.out.splitlines()[-1].startswith("no errors, ")


@pytest.mark.parametrize(
    ("more", "port", "code", "checks", "said"),
    [
        ("", "/dev/ttyUSB99", 1, ["port.exists"], ""),
        ("[cann]\nbitrat = 1", "", 2, ["config"], "Did you mean can?"),
        ('[dbc]\nfile = "none.dbc"', "", 2, ["config"], "none.dbc"),
        ('[statistics]\nfile = "/proc/none/status.json"', "", 1, ["config.folder"], ""),
        ('[record]\ndirectory = "afile/x"', "", 1, ["config.folder"], "is a file, not a folder"),
        (
            '[record]\ndirectory = "captures"\nmin_free_mb = 10000000', "", 1, ["config.folder"],
            "but at least 10000000 MB are needed",
        ),
    ],
)  # fmt: skip
def test_error_has_its_exit_code_and_the_rest_is_still_checked(
    more: str,
    port: str,
    code: int,
    checks: list[str],
    said: str,
    tmp_path: Path,
    esc: PtyEsc,
) -> None:
    written(tmp_path / "afile", "")
    findings, errors = document(configuration(tmp_path, port or esc.path, more), code)
    assert [error["check"] for error in errors] == checks
    assert said in errors[0]["text"]
    groups = {finding["group"] for finding in findings}
    assert "Machine" in groups
    assert ("Serial port of esc1" in groups) == ("cann" not in more)


def test_doctor_creates_and_changes_nothing(tmp_path: Path, esc: PtyEsc) -> None:
    canopen = '[canopen]\nenabled = true\nstore = "not/yet"\n'
    record = '[record]\ndirectory = "captures"\nmin_free_mb = 0'
    more = canopen + record
    findings, _ = document(configuration(tmp_path, esc.path, more), 0)
    assert sum(f["text"].endswith(", will be created") for f in findings) == 2
    assert [p.name for p in tmp_path.iterdir()] == ["gateway.toml"]


def test_modules_of_doctor_do_not_open_a_device() -> None:
    for path in Path(ports.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            name = getattr(node, "attr", getattr(node, "id", ""))
            assert not name.startswith(("open", "write", "O_", "tcset")) or name == "openers"


def test_reason_for_missing_telemetry_is_a_warning(tmp_path: Path, esc: PtyEsc) -> None:
    file = configuration(tmp_path, esc.path, '[statistics]\nfile = "status.json"')
    why = "live frames of 38 bytes whose CRC covers 34 bytes instead of 32"

    def told() -> list[str]:
        findings, _ = document(file, 0)
        return [f["text"] for f in findings if f["check"] == "port.telemetry"]

    assert told() == []
    bench = Bench(1)
    bench.silent.add(0)
    bench.run(2)
    ports = [PortFacts("esc1", esc.path, True, diagnosis=why)]
    status = bench.document(ports=ports, program=program_facts(str(file)))
    status |= {"monotonic_ns": time.monotonic_ns()}
    written(tmp_path / "status.json", json.dumps(status))
    assert told() == [f"the gateway receives no telemetry: {why}"]
