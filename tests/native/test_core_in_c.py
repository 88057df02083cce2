"""The core in C gives what the core in Python gives; gcc and clang build it without a warning, for a small machine too."""

import ctypes as c
import random
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import equality
import pytest
from built import STRICT, built, run_sanitized
from dbc_bench import compiled
from packer_oracle import Msg, Sig, dbc_text

from kontronik_can_gw.core.python_core import PythonCore
from kontronik_can_gw.esc.kontronik.codec import Layout as WireLayout
from kontronik_can_gw.esc.kontronik.codec import encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.native.binding import WrongObject, load
from kontronik_can_gw.native.core import NativeCore
from kontronik_can_gw.native.objects import OPTIONS
from kontronik_can_gw.native.rows import NotInCore
from kontronik_can_gw.native.tables import Tables
from kontronik_can_gw.signals.plan import Layout, SendType
from kontronik_can_gw.times import MS

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


def _scaled(chance: random.Random) -> str:
    """A message whose signal has a factor that takes many digits and cannot hold all values of its source."""
    length = chance.randint(2, 24)
    is_signed = chance.random() < 0.5
    factor = f"{chance.choice((1, 1, 1, -1)) / chance.choice((3, 7, 255, 1023, 4095)):.8g}"
    offset = chance.choice(("0", "0", "-40"))
    sign = "-" if is_signed else "+"
    signal = f'SG_ S : 0|{length}@1{sign} ({factor},{offset}) [0|0] "" X'
    return f'VERSION ""\nBU_: G X\nBO_ 256 M: 8 G\n {signal}\n'


SOURCES = {
    "electrical_speed": (0, 2**32 - 1),
    "motor_speed": (0, 2**32 - 1),
    "battery_current": (-(2**15), 2**15 - 1),
}


@pytest.mark.parametrize("seed", range(40))
def test_a_factor_of_many_digits_is_in_c_and_gives_the_same_frames(
    native_library: Any, seed: int
) -> None:
    """Around the largest value that the core multiplies, around the largest that the signal holds, and at the source's limits."""
    chance = random.Random(seed)
    name, (low, high) = chance.choice([*SOURCES.items()])
    layout = compiled(_scaled(chance), bind={"S": name})
    escs = [EscSettings("esc1", pole_pairs=chance.choice((1, 7, 255)))]
    (row,) = Tables(layout, escs).signals
    ends = [(end * row.div - row.add) // row.mul for end in (row.low, row.high + 1)]
    steps = {low, high, 0, *(chance.randint(low, high) for _ in range(20))}
    for middle in (row.most, -row.most, *ends, *(end * escs[0].pole_pairs for end in ends)):
        steps |= {middle + n for n in range(-2, 3) if low <= middle + n <= high}
    field = "battery_current" if name == "battery_current" else "electrical_speed"
    cores = (PythonCore(escs, layout, 0, False), NativeCore(native_library, escs, layout, 0, False))
    for number, step in enumerate(sorted(steps)):
        now = number * 10 * MS + MS
        data = encode(LiveData(**{field: step}), WireLayout.V4)
        for core in cores:
            core.receive(0, data, now, now)
            core.advance(now)
        python, native = (core.take(now) for core in cores)
        assert python == native, step
        assert len(python) == 1


@pytest.mark.parametrize("kind", ["", "SIG_VALTYPE_ 256 S : 1;"])
@pytest.mark.parametrize("offset", ["0", "1e9"])
@pytest.mark.parametrize("factor", ["1e-300", "-5e-324", "1e30", "0.00000012345678"])
def test_a_factor_of_any_size_is_refused_with_one_that_fits(
    factor: str, offset: str, kind: str
) -> None:
    text = f'VERSION ""\nBU_: G X\nBO_ 256 M: 8 G\n SG_ S : 0|32@1- ({{}},{offset}) [0|0] "" X\n{kind}\n'
    escs = [EscSettings("esc1")]
    with pytest.raises(NotInCore) as found:
        Tables(compiled(text.format(factor), bind={"S": "output_speed"}), escs)
    said = re.search(r"leaves 6[34] bits\. Factor (\S+) fits", str(found.value))
    assert said is not None, str(found.value)
    Tables(compiled(text.format(said[1]), bind={"S": "output_speed"}), escs)


def test_a_factor_that_leaves_64_bits_is_named_with_one_that_fits() -> None:
    """``output_speed`` is divided by pole pairs and gear, which may be large."""
    text = 'VERSION ""\nBU_: G X\nBO_ 256 M: 8 G\n SG_ S : 0|32@1+ ({},0) [0|0] "" X\n'
    escs = [EscSettings("esc1")]
    refused = compiled(text.format("0.0039215686"), bind={"S": "output_speed"})
    with pytest.raises(NotInCore) as found:
        Tables(refused, escs)
    said = re.fullmatch(
        r"M\.S: factor 0.0039215686 leaves 64 bits\. Factor (\S+) fits", str(found.value)
    )
    assert said is not None, str(found.value)
    Tables(compiled(text.format(said[1]), bind={"S": "output_speed"}), escs)


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
    few = _sort_calls(library, 60)
    many = _sort_calls(library, 240)
    print(few, many)
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
