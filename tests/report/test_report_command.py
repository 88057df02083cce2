"""``kontronik-can-gw report`` from a file to the page and the pictures."""

import base64
import re
import sys
from array import array
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_flights import shipped_bus, simulated, write_capture
from test_page import data_of, decode

from kontronik_can_gw.cli import main
from kontronik_can_gw.offline.report.analysis import Analysis
from kontronik_can_gw.offline.report.plots_png import write_pngs
from kontronik_can_gw.protocol.states import Device, OperatingError
from kontronik_can_gw.simulator import Dropout, ErrorWindow, EscOptions, Faults, SimulatedEsc, Swap
from kontronik_can_gw.telemetry import SECOND as S


def report(*words: object) -> tuple[int, str, str]:
    out, talk = StringIO(), StringIO()
    code: object
    with redirect_stdout(out), redirect_stderr(talk):
        try:
            code = main(["report", *map(str, words)])
        except SystemExit as end:
            code = end.code
    assert isinstance(code, int)
    return code, out.getvalue(), talk.getvalue()


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


def test_pictures_are_made_of_each_plot(dump: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="pip install 'kontronik-can-gw[plot]'")
    folder = tmp_path / "new" / "pictures"
    code, out, talk = report(dump, "--png", folder)
    assert (code, out) == (0, "")
    names = {file.name for file in folder.iterdir()}
    assert names == {
        *("states.png", "speed.png", "battery_voltage.png", "cell_voltage.png", "current.png", "power.png"),
        *("temperature.png", "throttle.png", "pwm.png", "bec_voltage.png", "bec_current.png"),
    }
    assert all(name in talk for name in names)
    for file in folder.iterdir():
        assert len(colours(file)) > 10, file.name


def test_pictures_have_the_colours_of_the_page_for_each_esc(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="pip install 'kontronik-can-gw[plot]'")
    bus = shipped_bus(("left", "right"))
    analysis = Analysis(bus, 500)
    for time_ns, values in simulated(bus, 20, [EscOptions(), EscOptions(max_current=60)]):
        analysis.take(time_ns, values)
    flight = analysis.finish()
    first, second = (write_pngs(flight, tmp_path / name, "costs $5 and $6") for name in "ab")
    power = next(file for file in first if file.name == "power.png")
    assert {(0x00, 0x72, 0xB2), (0xD5, 0x5E, 0x00)} <= colours(power)
    assert [file.read_bytes() for file in first] == [file.read_bytes() for file in second]


def colours(png: Path) -> set[tuple[int, ...]]:
    """That are in a picture."""
    from matplotlib.image import imread

    pixels = (imread(png)[..., :3] * 255).round().astype(int)
    return {(n >> 16, n >> 8 & 255, n & 255) for n in np.unique(pixels @ [1 << 16, 1 << 8, 1]).tolist()}


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


@pytest.mark.parametrize("points", [100, 1000, 20000, 1000000])
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


def test_all_devices_that_there_were_are_named_with_their_time(recording: Path) -> None:
    _, html, _ = report(recording, "-o", "-")
    found = re.search(r"<dt>e1</dt><dd>(.*?)</dd>", html)
    assert found is not None
    assert re.match(
        r"Kosmik 120 firmware 4\.17; from 0:2[12]\.\d: Kolibri 120 firmware 4\.17, at /dev/ttyUSB1$", found[1]
    ), found[1]


def test_pictures_tell_the_text_of_every_error(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    matplotlib = pytest.importorskip("matplotlib.figure", reason="pip install 'kontronik-can-gw[plot]'")
    texts: dict[str, list[str]] = {}

    def keep(figure: Any, file: Path, **_: object) -> None:
        from matplotlib.text import Text

        found: list[Any] = figure.findobj(Text)
        texts[file.name] = [text.get_text() for text in found]
        figure.draw_without_rendering()
        width, height = figure.canvas.get_width_height()
        for text in found:
            if ":" in text.get_text() and text.get_text()[0] == "e":  # nothing of a label is cut
                box = text.get_window_extent()
                assert box.x0 >= 0, text
                assert box.x1 <= width, text
                assert box.y1 <= height, text

    monkeypatch.setattr(matplotlib.Figure, "savefig", keep)
    assert report(recording, "--png", tmp_path / "pictures")[0] == 0
    assert len(texts) == 11
    for name, found in texts.items():
        if name != "states.png":
            for text in ("battery voltage too low", "BEC current too high"):
                for esc in ("e0", "e1"):
                    assert any(f"{esc}: {text}" in line for line in found), (name, found)


def test_nothing_is_written_over_without_force(dump: Path, tmp_path: Path) -> None:
    page, folder = tmp_path / "flight.html", tmp_path / "pictures"
    page.write_text("mine")
    folder.mkdir()
    (folder / "power.png").write_text("mine")
    assert report(dump, "-o", page) == (
        2,
        "",
        f"kontronik-can-gw report: {page}: exists. Give another -o, or --force.\n",
    )
    assert report(dump, "--png", folder) == (
        2,
        "",
        f"kontronik-can-gw report: {folder}/power.png: exists. Give another --png, or --force.\n",
    )
    assert (page.read_text(), (folder / "power.png").read_text()) == ("mine", "mine")
    assert report(dump, "-o", page, "--png", folder, "--force")[0] == 0
    assert page.read_text(encoding="utf-8").startswith("<!doctype html>")
    assert (folder / "power.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("words", "code", "expected"),
    [
        (["{dump}"], 2, "give -o FILE for the page, --png FOLDER for pictures, or both"),
        (["{dump}", "-o", "{dump}"], 2, "is the input. Give another file."),
        (["{dump}", "-o", ""], 2, "-o: is empty. Give a file, or - for standard output."),
        (["{dump}", "--png", ""], 2, "--png: is empty. Give a folder."),
        (["{dump}", "-o", "{tmp}"], 2, "is a folder. Give a file."),
        (["{dump}", "-o", "{tmp}/" + 300 * "x"], 2, "cannot be written: File name too long."),
        (["{dump}", "--png", "{tmp}/" + 300 * "x"], 2, "cannot be written: File name too long."),
        (["{dump}", "-o", "{tmp}/no/x.html"], 1, "cannot be written: No such file or directory"),
        (["{dump}", "-o", "-", "--from", "9", "--to", "3"], 2, "--to 3: must be greater than --from 9"),
        (["{dump}", "-o", "-", "--from", "900"], 1, "no values in this part of it"),
        (["{tmp}/none.kcap", "-o", "-"], 1, "there is no such file"),
        (["{tmp}/text", "-o", "-"], 2, "is no capture, no CAN log"),
        (["{dump}", "--png", "{dump}"], 1, "cannot be written: File exists. Give another --png."),
    ],
)
def test_mistakes_are_one_line(dump: Path, tmp_path: Path, words: list[str], code: int, expected: str) -> None:
    (tmp_path / "text").write_text("hello " * 100)
    found, out, talk = report(*(word.format(dump=dump, tmp=tmp_path) for word in words))
    assert (found, out) == (code, "")
    assert talk.count("\n") == 1, talk
    assert talk.startswith("kontronik-can-gw report: ")
    assert expected in talk


@pytest.mark.parametrize("words", [["--points", "99"], ["--points", "x"], ["--from", "-1"], ["--to", "x"]])
def test_numbers_out_of_range_are_named(dump: Path, words: list[str]) -> None:
    code, out, talk = report(dump, "-o", "-", *words)
    assert (code, out) == (2, "")
    assert words[0] in talk.splitlines()[-1]


def test_matplotlib_is_named_when_missing(dump: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    code, out, talk = report(dump, "--png", tmp_path)
    assert (code, out) == (2, "")
    assert talk == "kontronik-can-gw report: --png: needs matplotlib: pip install 'kontronik-can-gw[plot]'\n"
