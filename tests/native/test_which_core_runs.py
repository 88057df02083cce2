"""The C core runs if possible. Otherwise the Python core runs, and the gateway logs why."""

import os
import struct
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import pytest

from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.core.interface import Follower
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.dbc.reader import parse_database
from kontronik_can_gw.esc import protocols
from kontronik_can_gw.esc.kontronik import codec
from kontronik_can_gw.esc.kontronik.codec import encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import EscSettings, Event
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.native import compile as compiling
from kontronik_can_gw.native import load, objects
from kontronik_can_gw.native.compile import compile_core
from kontronik_can_gw.native.objects import sealed
from kontronik_can_gw.native.rows import MAX_GEAR
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.times import SECOND

pytestmark = pytest.mark.promise("which-core")

EMPTY = MessageLayout("", "", ())
HEAD = 'VERSION ""\nNS_ :\nBS_:\nBU_: Gw Car\nBO_ 256 M: 8 Gw\n SG_ {} Car\n'
CYCLE = (
    'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 99999999999999;\n'
    'BA_DEF_DEF_ "GenMsgCycleTime" 0;\nBA_ "GenMsgCycleTime" BO_ 256 {};\n'
)
VOLTAGE = 'BatteryVoltage : 0|{}@1+ ({},0) [0|0] "V"'
LINK_STATE = 'LinkState : 0|32@1+ (0.00592884289493769,89.21540281025877) [0|0] ""'
RUN_TIME = 'MotorRunTime : 0|32@1+ (3.1415926535897931,0) [0|0] "s"'


@pytest.fixture(autouse=True)
def anew(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.delenv(load.PURE, raising=False)
    load.library.cache_clear()
    yield
    load.library.cache_clear()


needs_c = pytest.mark.skipif(
    not objects.shared_object().exists(),
    reason="no core in C: sudo apt-get install gcc libc6-dev, and install again",
)


def layout_of(signal: str, more: str = "", length: int = 8) -> MessageLayout:
    text = HEAD.format(signal).replace("M: 8", f"M: {length}") + more
    database = parse_database(text.encode(), "t.dbc")
    return prepare(
        database,
        "t.dbc",
        (EscSettings(),),
        DbcConfig(),
        is_fd_allowed=True,
    )


def why(layout: MessageLayout = EMPTY, **settings: object) -> str:
    """Return why a gateway with one ESC has the Python core, or ""."""
    esc = replace(EscSettings(), **settings)  # type: ignore[arg-type]
    gateway = Gateway(CoreSettings([esc], layout), 0)
    assert gateway.core.language == ("Python" if gateway.core.note else "C")
    return gateway.core.note


@needs_c
@pytest.mark.parametrize(
    ("pure", "said"),
    [
        ("", ""),
        ("0", ""),
        ("1", "KONTRONIK_PURE is set"),
    ],
)
def test_c_core_runs_unless_the_python_core_is_requested(
    monkeypatch: pytest.MonkeyPatch,
    pure: str,
    said: str,
) -> None:
    monkeypatch.setenv(load.PURE, pure)
    assert why() == said


DAMAGED = "core-other.so: truncated or damaged"
OTHER_MACHINE = "core-other.so: built for another machine"


@needs_c
@pytest.mark.parametrize(
    ("made_of", "said"),
    [
        (lambda _: None, "no core-other.so in this installation"),
        (lambda _: None, "no C compiler was found during installation"),
        (lambda whole: whole[:-1], DAMAGED),
        (lambda whole: whole[:4096] + bytes(4096) + whole[8192:], DAMAGED),
        (lambda whole: sealed(whole[:18] + b"\xfe\xca" + whole[20:-4]), OTHER_MACHINE),
        (lambda whole: sealed(whole[:4] + bytes((whole[4] ^ 3,)) + whole[5:-4]), OTHER_MACHINE),
        (lambda whole: sealed(whole[:64] + bytes(9)), "core-other.so: "),
    ],
)
def test_python_core_runs_if_the_c_core_cannot_be_loaded(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    made_of: Callable[[bytes], bytes | None],
    said: str,
) -> None:
    path = tmp_path / "core-other.so"
    not_built = tmp_path / "not_built.txt"
    content = made_of(objects.shared_object().read_bytes())
    if content is not None:
        path.write_bytes(content)
    monkeypatch.setattr(load, "shared_object", lambda: path)
    monkeypatch.setattr(objects, "NOT_BUILT", not_built)
    if said.startswith("no C compiler"):
        not_built.write_text(f"{said}\n")
    found = why()
    assert load.in_words("Python", found) == f"core: Python ({found})"
    assert found.startswith(said)
    assert "\n" not in found
    assert len(found) < 200


@pytest.mark.parametrize(
    ("machine", "bits", "its"),
    [
        ("aarch64", 64, "aarch64"),
        ("aarch64", 32, "armv7l"),
        ("armv6l", 32, "armv6l"),
        ("x86_64", 32, "i686"),
    ],
)
def test_process_of_32_bits_loads_its_own_object(
    monkeypatch: pytest.MonkeyPatch,
    machine: str,
    bits: int,
    its: str,
) -> None:
    monkeypatch.setattr(os, "uname", lambda: SimpleNamespace(machine=machine))
    monkeypatch.setattr(sys, "maxsize", (1 << bits - 1) - 1)
    assert objects.shared_object().name == f"core-{its}.so"


@needs_c
def test_python_core_runs_if_ctypes_may_not_load(monkeypatch: pytest.MonkeyPatch) -> None:
    """On some machines a systemd unit that forbids executable memory causes this."""
    monkeypatch.setitem(sys.modules, "kontronik_can_gw.native.binding", None)
    assert why().startswith("ctypes cannot be used here: ")


SPEEDS = 'MotorSpeed : 0|32@1+ (1,0) [0|0] "rpm" Car\n SG_ OutputSpeed : 32|32@1+ (1,0) [0|0] "rpm"'
NOT_AVAILABLE = 0xFFFF_FFFF


@needs_c
def test_settings_beyond_the_limits_make_speeds_not_available() -> None:
    gateway = Gateway(CoreSettings([EscSettings(pole_pairs=7)], layout_of(SPEEDS)), 0)
    assert gateway.core.language == "C"
    cases = (
        (7, Fraction(490_909, 50_000), 10_000, 1_019),
        (7, Fraction(1, MAX_GEAR + 1), 10_000, NOT_AVAILABLE),
        (7, Fraction(MAX_GEAR + 2, 2), 10_000, NOT_AVAILABLE),
        (100_000, Fraction(1), NOT_AVAILABLE, NOT_AVAILABLE),
        (7, Fraction(5), 10_000, 2_000),
    )
    for now, (poles, gear, motor, output) in enumerate(cases):
        given = EscSettings(pole_pairs=poles, gear=gear)
        gateway.core.apply(0, given)
        assert gateway.escs[0].settings == given
        time = now * SECOND // 10
        live = encode(LiveData(electrical_speed=70_000), codec.WireLayout.V4)
        gateway.receive_bytes(0, live, time, time)
        (frame,) = gateway.take_frames(time)
        assert struct.unpack("<2I", frame.data) == (motor, output), given


@needs_c
def test_settings_that_the_c_core_cannot_express_run_in_python(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    other = replace(protocols.PROTOCOLS[0], name="other", wire=None)
    monkeypatch.setattr(protocols, "PROTOCOLS", (*protocols.PROTOCOLS, other))
    assert why(protocol="other") == "ESC protocol other is decoded in Python only"
    assert why(gear=Fraction(MAX_GEAR)) == ""
    assert f"has a number above {MAX_GEAR}" in why(gear=Fraction(MAX_GEAR + 1))


@needs_c
def test_note_of_the_c_core_tells_that_an_output_follows_live_frames() -> None:
    core = Gateway(CoreSettings([EscSettings()], EMPTY), 0).core
    assert (core.language, core.note) == ("C", "")
    core.followers = [Follower(Event.LINK | Event.LIVE, lambda *_: None)]
    reason = "a PDO, record.when or another output needs it"
    assert core.note == f"Python handles each live frame, too: {reason}"
    core.followers = [Follower(Event.LINK, lambda *_: None)]
    assert core.note == ""


@needs_c
def test_object_of_other_fields_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The number that an object carries covers the generated header, not only the C files."""
    header = objects.wire_header()
    monkeypatch.setattr(objects, "wire_header", lambda: header.replace("live, 4", "live, 5"))
    assert why() == f"{objects.shared_object().name}: built from other sources than this version"


@pytest.mark.promise("round-once")
@needs_c
@pytest.mark.parametrize(
    ("signal", "more", "said"),
    [
        (VOLTAGE.format(16, "0.01"), "", ""),
        (VOLTAGE.format(16, "1e70"), "", ""),
        (VOLTAGE.format(16, "18446744073709551616"), "", ""),
        (VOLTAGE.format(16, "1e-70"), "", ""),
        (LINK_STATE, "", ""),
        (RUN_TIME, "", "M.MotorRunTime: factor 3.14159265358979 exceeds 64 bits. Factor 3.14159"),
        (VOLTAGE.format(16, "0.01"), CYCLE.format(10_000_000_000_000), "a cycle time or delay"),
        (VOLTAGE.format(64, "0.01"), "", ""),
        (VOLTAGE.format(65, "0.01"), "", "M.BatteryVoltage: too long (65 bits)"),
    ],
)
def test_numbers_that_leave_64_bits_run_in_python(signal: str, more: str, said: str) -> None:
    found = why(layout_of(signal, more, 64))
    assert said in found
    assert bool(said) == bool(found)


def test_failing_compiler_is_reported_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    program = tmp_path / "cc"
    target = tmp_path / "core.so"
    program.write_text("#!/bin/sh\nprintf 'In file:\\nfatal error: \\377' >&2\nexit 1\n")
    program.chmod(0o755)
    said = f"{program} failed during installation: fatal error: \ufffd"
    assert compile_core(target, program=str(program)) == said
    assert "No such file" in str(compile_core(target, program=f"{program}2"))
    monkeypatch.setattr(compiling, "compiler", lambda: None)
    assert compile_core(target) == "no C compiler was found during installation"
    assert not target.exists()
