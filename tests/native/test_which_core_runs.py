"""The core in C runs where it is asked for and can; where it cannot, the one in Python does, and the gateway says why."""

import builtins
import stat
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import ModuleType

import pytest

from kontronik_can_gw.core import PythonCore
from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.dbc.reader import parse_database
from kontronik_can_gw.dbc.settings import DbcSettings
from kontronik_can_gw.esc import protocols
from kontronik_can_gw.esc.kontronik import LiveData, codec, encode
from kontronik_can_gw.esc.telemetry import SECOND, EscSettings
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.native import compile as compiling
from kontronik_can_gw.native import load
from kontronik_can_gw.native.compile import compile_core
from kontronik_can_gw.native.tables import MAX_GEAR
from kontronik_can_gw.signals.plan import Layout

EMPTY = Layout("", "", ())
HEAD = 'VERSION ""\nNS_ :\nBS_:\nBU_: Gw Car\nBO_ 256 M: 8 Gw\n SG_ {} Car\n'
CYCLE = (
    'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 99999999999999;\n'
    'BA_DEF_DEF_ "GenMsgCycleTime" 0;\nBA_ "GenMsgCycleTime" BO_ 256 {};\n'
)
VOLTAGE = 'BatteryVoltage : 0|16@1+ ({},0) [0|0] "V"'


@pytest.fixture(autouse=True)
def asked_for(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv(load.CORE, "C")
    load.library.cache_clear()
    yield
    load.library.cache_clear()


@pytest.fixture
def built() -> None:
    if not compiling.shared_object().exists():
        pytest.skip("no core in C: sudo apt-get install gcc libc6-dev, and install again")


def why(**settings: object) -> str:
    """Of a gateway with one ESC: why it has the core in Python."""
    gateway = Gateway([replace(EscSettings(), **settings)], EMPTY, 0)  # type: ignore[arg-type]
    assert gateway.core.language == ("Python" if gateway.why_python else "C")
    return gateway.why_python


@pytest.mark.usefixtures("built")
def test_it_is_the_one_in_c_where_that_is_asked_for() -> None:
    assert why() == ""


def test_it_is_the_one_in_python_where_nothing_is_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv(load.CORE)
    gateway = Gateway([EscSettings()], EMPTY, 0)
    assert (type(gateway.core), gateway.why_python) == (PythonCore, "")


@pytest.mark.parametrize("content", [None, "no object, but long enough to look like one" * 9])
def test_without_an_object_for_this_machine_the_one_in_python_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str | None
) -> None:
    path = tmp_path / "core-other.so"
    if content is not None:
        path.write_text(content)
    monkeypatch.setattr(compiling, "shared_object", lambda: path)
    said = why()
    begin = "no core-other.so in this installation" if content is None else "core-other.so: "
    assert said.startswith(begin) and "\n" not in said


@pytest.mark.usefixtures("built")
def test_where_ctypes_may_not_load_the_one_in_python_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """As under a unit that forbids memory to be executed, on some machines."""
    real = builtins.__import__

    def refused(name: str, *more: object) -> ModuleType:
        if name == "kontronik_can_gw.native.binding":
            raise MemoryError("no closure")
        return real(name, *more)  # type: ignore[arg-type]

    monkeypatch.setattr(builtins, "__import__", refused)
    assert why() == "ctypes cannot be used here: no closure"


@pytest.mark.usefixtures("built")
def test_a_gear_beyond_its_limits_runs_in_python() -> None:
    assert why(gear=Fraction(MAX_GEAR)) == ""
    assert f"parts above {MAX_GEAR}" in why(gear=Fraction(MAX_GEAR + 1))


@pytest.mark.usefixtures("built")
def test_what_a_master_writes_beyond_its_limits_is_the_nearest_within() -> None:
    gateway = Gateway([EscSettings()], EMPTY, 0)
    gears = Fraction(100_000, 7), Fraction(42857143, 5_000_000), Fraction(1, 10**9), Fraction(10**9)
    for gear in gears:
        gateway.core.apply(0, EscSettings(gear=gear, pole_pairs=100_000, cell_count=300))
    assert gateway.escs[0].settings.gear == 10**9


@pytest.mark.usefixtures("built")
def test_another_esc_protocol_runs_in_python(monkeypatch: pytest.MonkeyPatch) -> None:
    other = replace(protocols.PROTOCOLS[0], name="other", wire=None)
    monkeypatch.setattr(protocols, "PROTOCOLS", (*protocols.PROTOCOLS, other))
    assert why(protocol="other") == "ESC protocol other"


@pytest.mark.usefixtures("built")
@pytest.mark.parametrize(
    ("signal", "more"),
    [
        (VOLTAGE.format("1e70"), ""),
        (VOLTAGE.format("18446744073709551616"), ""),
        (VOLTAGE.format("1e-70"), ""),
        ('LinkState : 0|32@1+ (0.00592884289493769,89.21540281025877) [0|0] ""', ""),
        (VOLTAGE.format("0.01"), CYCLE.format(10_000_000_000_000)),
    ],
)
def test_numbers_that_leave_64_bits_run_in_python(signal: str, more: str) -> None:
    database = parse_database((HEAD.format(signal) + more).encode(), "t.dbc")
    layout = prepare(database, "t.dbc", (EscSettings(),), DbcSettings())[1]
    gateway = Gateway([EscSettings()], layout, 0)
    assert isinstance(gateway.core, PythonCore) and gateway.why_python


@pytest.mark.usefixtures("built")
@pytest.mark.parametrize("bits", [64, 65, 300])
def test_a_signal_of_more_than_64_bits_runs_in_python(bits: int) -> None:
    signal = f'BatteryVoltage : 0|{bits}@1+ (0.01,0) [0|0] "V"'
    text = HEAD.format(signal).replace("M: 8", "M: 64")
    database = parse_database(text.encode(), "t.dbc")
    layout = prepare(database, "t.dbc", (EscSettings(),), DbcSettings(), fd_allowed=True)[1]
    found = Gateway([EscSettings()], layout, 0).why_python
    assert found == ("" if bits == 64 else f"M.BatteryVoltage: {bits} bits")


@pytest.mark.usefixtures("built")
def test_the_losses_of_a_later_part_go_on() -> None:
    gateway = Gateway([EscSettings()], EMPTY, 0)
    gateway.escs[0].losses = 42
    gateway.receive_bytes(0, encode(LiveData(), codec.Layout.V4), SECOND, SECOND)
    gateway.advance(3 * SECOND)
    assert gateway.escs[0].losses == 43


def test_a_compiler_that_fails_is_said_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "cc"
    program.write_text("#!/bin/sh\necho 'cannot find crti.o' >&2\nexit 1\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr(compiling, "compiler", lambda: str(program))
    assert compile_core(tmp_path / "core.so") == f"{program}: cannot find crti.o"
    program.unlink()
    assert "No such file" in str(compile_core(tmp_path / "core.so"))
    monkeypatch.setattr(compiling, "compiler", lambda: None)
    assert compile_core(tmp_path / "core.so") == "no C compiler"
