"""The core in C runs where it can; where it cannot, the one in Python does, and the gateway says why."""

import builtins
import stat
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import ModuleType

import pytest

from kontronik_can_gw.core import PythonCore
from kontronik_can_gw.esc import protocols
from kontronik_can_gw.esc.telemetry import MAX_GEAR_PART, EscSettings
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.native import compile as compiling
from kontronik_can_gw.native import load
from kontronik_can_gw.native.compile import compile_core, compiler
from kontronik_can_gw.signals.plan import Layout

EMPTY = Layout("", "", ())


@pytest.fixture(autouse=True)
def asked_anew() -> Iterator[None]:
    load.library.cache_clear()
    yield
    load.library.cache_clear()


def why(**settings: object) -> str:
    """Of a gateway with one ESC: why it has the core in Python."""
    gateway = Gateway([replace(EscSettings(), **settings)], EMPTY, 0)  # type: ignore[arg-type]
    assert isinstance(gateway.core, PythonCore) is bool(gateway.why_python)
    return gateway.why_python


def test_it_is_the_one_in_c_where_there_is_a_compiler() -> None:
    if compiler() is None:
        pytest.skip("no C compiler: sudo apt-get install gcc libc6-dev")
    assert why() == ""


def test_an_environment_variable_asks_for_the_one_in_python(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv(load.PURE, "1")
    assert why() == "KONTRONIK_PURE is set"


@pytest.mark.parametrize(
    "content", [None, "no object at all, but long enough to look like one" * 9]
)
def test_without_an_object_for_this_machine_the_one_in_python_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str | None
) -> None:
    path = tmp_path / "core-other.so"
    if content is not None:
        path.write_text(content)
    monkeypatch.setattr(load, "shared_object", lambda: path)
    said = why()
    assert said.startswith("no core-other.so" if content is None else "core-other.so: ")
    assert "\n" not in said


def test_where_ctypes_may_not_load_the_one_in_python_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """As under a unit that forbids memory to be executed, on some machines."""
    real = builtins.__import__

    def refused(name: str, *more: object) -> ModuleType:
        if name == "kontronik_can_gw.native.binding":
            raise MemoryError("no closure")
        return real(name, *more)  # type: ignore[arg-type]

    monkeypatch.setattr(builtins, "__import__", refused)
    if load.shared_object().exists():
        assert why() == "ctypes cannot be used here: no closure"


def test_a_gear_beyond_what_a_master_can_set_runs_in_python() -> None:
    assert why(gear=Fraction(MAX_GEAR_PART)) == ""
    assert f"parts above {MAX_GEAR_PART}" in why(gear=Fraction(MAX_GEAR_PART + 1))


def test_another_esc_protocol_runs_in_python(monkeypatch: pytest.MonkeyPatch) -> None:
    other = replace(protocols.PROTOCOLS[0], name="other", wire=None)
    monkeypatch.setattr(protocols, "PROTOCOLS", (*protocols.PROTOCOLS, other))
    assert why(protocol="other") == "ESC protocol other"


def test_a_compiler_that_fails_is_said_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "cc"
    program.write_text("#!/bin/sh\necho 'cannot find crti.o' >&2\nexit 1\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr(compiling, "compiler", lambda: str(program))
    assert compile_core(tmp_path / "core.so") == f"{program}: cannot find crti.o"
    monkeypatch.setattr(compiling, "compiler", lambda: None)
    assert compile_core(tmp_path / "core.so") == "no C compiler"
