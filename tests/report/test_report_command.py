"""``kontronik-can-gw report`` from a file to the page."""

import re
from pathlib import Path

import pytest
from command_line import run
from report_flights import data_of

from kontronik_can_gw.esc.kontronik.simulator import ErrorWindow, EscOptions, Faults, SimulatedEsc
from kontronik_can_gw.esc.kontronik.states import OperatingError
from kontronik_can_gw.times import SECOND as S

pytestmark = pytest.mark.promise("report")


@pytest.fixture(scope="module")
def dump(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a file with the UART bytes of 25 s."""
    file = tmp_path_factory.mktemp("dump") / "flight 1.bin"
    faults = Faults(errors=(ErrorWindow(OperatingError.UNDERVOLTAGE, 20 * S, S),))
    sent = SimulatedEsc(EscOptions(faults=faults)).frames_until(25 * S)
    file.write_bytes(b"".join(frame.wire for frame in sent))
    return file


def test_page_is_written_for_a_file(dump: Path, tmp_path: Path) -> None:
    page = tmp_path / "flight.html"
    assert run("report", dump, "-o", page) == (0, b"", f"kontronik-can-gw: {page} written\n")
    html = page.read_text(encoding="utf-8")
    assert "<title>flight 1.bin</title>" in html
    assert "battery voltage too low" in [event["text"] for event in data_of(html)["events"]]
    assert "assumed: 100 live frames a second" in html
    assert re.search(r"<b>25\.0 s</b>", html)
    again = tmp_path / "again.html"
    run("report", dump, "-o", again)
    assert again.read_bytes() == page.read_bytes()


def test_page_of_a_part_can_be_written_to_standard_output(dump: Path) -> None:
    part = dump.with_name("part <1>")
    part.write_bytes(dump.read_bytes())
    done = run("report", part, "-o", "-", "--from", 5, "--until", 15)
    assert done.code == 0
    assert done.err == ""
    assert "<h1>part &lt;1&gt;</h1>" in done.out
    assert "0:05.0 to 0:15.0 of the recording" in done.out
    assert not [event for event in data_of(done.out)["events"] if event["kind"] == "error"]
