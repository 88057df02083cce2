"""``kontronik-can-gw report`` from a file to the page."""

import base64
import re
from array import array
from itertools import pairwise
from pathlib import Path

import pytest
from command_line import refused, run
from report_flights import write_capture
from test_page import data_of, decode

from kontronik_can_gw.protocol.states import Device, OperatingError
from kontronik_can_gw.simulator import Dropout, ErrorWindow, EscOptions, Faults, SimulatedEsc, Swap
from kontronik_can_gw.telemetry import SECOND as S


def report(*words: object) -> tuple[object, str, str]:
    done = run("report", *words)
    return done.code, done.out, done.err


@pytest.fixture(scope="module")
def dump(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The UART bytes of 25 s."""
    file = tmp_path_factory.mktemp("dump") / "flight 1.bin"
    faults = Faults(errors=(ErrorWindow(OperatingError.UNDERVOLTAGE, 20 * S, S),))
    sent = SimulatedEsc(EscOptions(faults=faults)).frames_until(25 * S)
    file.write_bytes(b"".join(frame.wire for frame in sent))
    return file


def test_a_page_is_made_of_a_file(dump: Path, tmp_path: Path) -> None:
    page = tmp_path / "flight.html"
    assert report(dump, "-o", page) == (0, "", f"kontronik-can-gw: {page} written\n")
    html = page.read_text(encoding="utf-8")
    assert "<title>flight 1.bin</title>" in html
    assert "battery voltage too low" in html
    assert "assumed: 100 live frames a second" in html
    assert re.search(r"<b>25\.0 s</b>", html)
    again = tmp_path / "again.html"
    report(dump, "-o", again)
    assert again.read_bytes() == page.read_bytes()


def test_the_page_can_go_to_standard_output_and_be_of_a_part(dump: Path) -> None:
    code, out, talk = report(dump, "-o", "-", "--from", 5, "--to", 15, "--title", "Part <1>", "--points", 100)
    assert (code, talk) == (0, "")
    assert "<h1>Part &lt;1&gt;</h1>" in out
    assert "0:05.0 to 0:15.0 of the recording" in out
    assert "battery voltage too low" not in out


DROPOUTS = (Dropout(2 * S, 6 * S), Dropout(S, 5 * S))
"""Of two ESCs: at 4 and 24 s both are lost, else one alone."""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture of two ESCs that are lost again and again; each has two errors, and one is changed for another."""
    errors = (
        ErrorWindow(OperatingError.UNDERVOLTAGE, 8_200_000_000, S),
        ErrorWindow(OperatingError.BEC_OVERCURRENT, 12_500_000_000, S),
    )
    options = [
        EscOptions(faults=Faults(dropout=lost, errors=errors, swaps=swaps))
        for lost, swaps in zip(DROPOUTS, ((), (Swap(21 * S, Device.KOLIBRI),)), strict=True)
    ]
    return write_capture(tmp_path_factory.mktemp("capture") / "flight.kcap", 60, options)


def test_no_page_is_written_over_without_force(dump: Path, tmp_path: Path) -> None:
    page = tmp_path / "flight.html"
    page.write_text("mine")
    assert refused(2, "report", dump, "-o", page) == f"{page}: exists. Give another -o, or --force."
    assert page.read_text() == "mine"
    assert report(dump, "-o", page, "--force")[0] == 0
    assert page.read_text(encoding="utf-8").startswith("<!doctype html>")


@pytest.mark.parametrize("points", [100, 20000])
def test_no_line_is_drawn_over_a_dropout(recording: Path, points: int) -> None:
    """Against what the simulator was told to do: from the time-out on until telemetry is back there is no line."""
    code, html, _ = report(recording, "-o", "-", "--points", points)
    assert code == 0
    found = data_of(html)
    times = list(array("d", base64.b64decode(found["times"])))
    drawn = 0
    for plot in found["plots"]:
        for series in plot["series"]:
            values = decode(series)
            lost = DROPOUTS[series["esc"]]
            for (t0, t1), (a, b) in zip(pairwise(times), pairwise(values), strict=True):
                if a is None or b is None:
                    continue
                drawn += 1
                for end in range(lost.interval_ns, 61 * S, lost.interval_ns):
                    low, high = (end - lost.duration_ns) / S + 0.3, end / S - 0.05
                    assert t1 <= low or t0 >= high, (plot["key"], series["esc"], t0, t1)
    assert drawn > 100
    for esc, lost in enumerate(DROPOUTS):
        gaps = [e for e in found["events"] if e["esc"] == esc and e["text"] == "No telemetry"]
        assert len(gaps) == 60 * S // lost.interval_ns
