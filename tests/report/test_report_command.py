"""``kontronik-can-gw report`` from a file to the page and the pictures."""

import re
import sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from report_flights import shipped_bus, simulated

from kontronik_can_gw.cli import main
from kontronik_can_gw.offline.report.analysis import Analysis
from kontronik_can_gw.offline.report.plots_png import write_pngs
from kontronik_can_gw.protocol.states import OperatingError
from kontronik_can_gw.simulator import ErrorWindow, EscOptions, Faults, SimulatedEsc
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


@pytest.mark.parametrize(
    ("words", "code", "expected"),
    [
        (["{dump}"], 2, "give -o FILE for the page, --png FOLDER for pictures, or both"),
        (["{dump}", "-o", "{dump}"], 2, "is the input. Give another file."),
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
