"""The core in C gives what the core in Python gives; gcc and clang build it without a warning, for a small machine too."""

import ctypes as c
from dataclasses import replace
from pathlib import Path
from typing import Any

import equality
import pytest
from built import STRICT, built, run_sanitized
from dbc_bench import compiled
from packer_oracle import Msg, Sig, dbc_text

from kontronik_can_gw.esc.kontronik.codec import Layout as WireLayout
from kontronik_can_gw.esc.kontronik.codec import encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import MS, EscSettings
from kontronik_can_gw.native.binding import WrongObject, load
from kontronik_can_gw.native.core import NativeCore
from kontronik_can_gw.native.objects import OPTIONS
from kontronik_can_gw.signals.plan import Layout, SendType

SEEDS = 16


@pytest.mark.parametrize("group", range(4))
def test_both_cores_give_the_same_frames_events_counters_and_deadlines(
    native_library: Any, group: int
) -> None:
    counts = [equality.run(native_library, seed) for seed in range(group, SEEDS, 4)]
    assert sum(counts) > 500, "the layouts are hardly sent"


@pytest.mark.extended
@pytest.mark.parametrize("group", range(20))
def test_both_cores_are_equal_over_a_million_frames(native_library: Any, group: int) -> None:
    """Of all groups together; about as many layouts, of up to 30 messages, as there are seeds."""
    seeds = range(10_000 + group, 10_100, 20)
    counts = [equality.run(native_library, seed, steps=2000, most=30) for seed in seeds]
    assert sum(counts) > 15_000


_COUNTED = """
unsigned long kcg_calls;
__attribute__((no_instrument_function)) void __cyg_profile_func_enter(void *f, void *from) { (void)f, (void)from, kcg_calls++; }
__attribute__((no_instrument_function)) void __cyg_profile_func_exit(void *f, void *from) { (void)f, (void)from; }
"""


def _sort_calls(library: Any, messages: int) -> int:
    """Calls of C functions that hand over ``messages`` cyclic messages, which became due before as many sent by event."""
    signal = Sig("ElectricalSpeed", 0, 32, unit="1/min")
    (plan,) = compiled(dbc_text([Msg("M", 256, 8, [signal])])).messages
    by_event = replace(plan, send_type=SendType.EVENT, cycle_ns=0, delay_ns=0)
    by_time = replace(plan, send_type=SendType.CYCLIC, cycle_ns=10 * MS, delay_ns=0)
    plans = [replace(by_event, can_id=n) for n in range(messages)]
    plans += [replace(by_time, can_id=messages + n) for n in range(messages)]
    core = NativeCore(library, [EscSettings("esc1")], Layout("", "", tuple(plans)), 0, False)
    core.receive(0, encode(LiveData(electrical_speed=1), WireLayout.V4), 10 * MS, 10 * MS)
    core.advance(10 * MS)
    calls = c.c_ulong.in_dll(library, "kcg_calls")
    before = calls.value
    frames = core.take(10 * MS)
    found = calls.value - before
    cyclic = [frame.can_id for frame in frames[:messages]]
    assert sorted(cyclic) == [*range(messages, 2 * messages)]
    assert [frame.can_id for frame in frames[messages:]] == [*range(messages)]
    return found


def test_sorting_of_pending_messages_is_not_quadratic(tmp_path: Path) -> None:
    """Messages that became due earlier are marked last. Four times as many may cost little more than four times as much."""
    counter = tmp_path / "counter.c"
    counter.write_text(_COUNTED, encoding="utf-8")
    options = ("-O0", "-finstrument-functions", "-Wl,-Bsymbolic", *OPTIONS, str(counter))
    library = load(built(tmp_path / "counted.so", *options))
    few, many = _sort_calls(library, 60), _sort_calls(library, 240)
    assert few < many < 6 * few, (few, many)


@pytest.mark.extended
def test_every_source_builds_without_a_warning_of_clang(tmp_path: Path) -> None:
    """And of gcc, as ``native_library`` is built."""
    built(tmp_path / "core.so", *STRICT, "-O2", *OPTIONS, program="clang")


@pytest.mark.extended
def test_no_byte_outside_its_memory_and_nothing_undefined(tmp_path: Path) -> None:
    script = (
        "import pathlib, sys\nimport equality, offline_equality\nfrom kontronik_can_gw.native.binding import load\n"
        "path = pathlib.Path(sys.argv[1])\nlibrary = load(path)\n"
        "print(sum(equality.run(library, seed) for seed in range(10)))\n"
        "print(sum(offline_equality.run(library, seed, path.parent) for seed in range(3)))\n"
    )
    assert all(int(count) > 200 for count in run_sanitized(tmp_path, "-c", script).split())


def test_an_object_with_other_tables_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(WrongObject, match="made of other sources"):
        load(built(tmp_path / "small.so", "-DKCG_DATA=8", "-DKCG_SLOTS=1"))
