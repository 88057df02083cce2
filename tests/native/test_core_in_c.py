"""The C core and the Python core give equal results. gcc and clang compile it without a warning."""

import ctypes as c
import random
import re
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import equality
import pytest
import random_scales
from built import STRICT, built, run_sanitized
from dbc_bench import compiled
from packer_oracle import Msg, Sig, dbc_text, random_live

from kontronik_can_gw.canopen.bound_values import compile_pdo
from kontronik_can_gw.canopen.dictionary import Variable
from kontronik_can_gw.canopen.eds import load as load_eds
from kontronik_can_gw.canopen.objects import BINDINGS
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.core.python_core import PythonCore
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.core.slots import SlotPlan, SlotSettings
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.values import VALUES, Kind
from kontronik_can_gw.native import tables
from kontronik_can_gw.native.binding import WrongObject, load
from kontronik_can_gw.native.core import NativeCore
from kontronik_can_gw.native.header import KCG
from kontronik_can_gw.native.objects import OPTIONS
from kontronik_can_gw.native.rows import NotInCore
from kontronik_can_gw.native.tables import Tables
from kontronik_can_gw.signals.plan import MessageLayout, SendType
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("both-cores")

SEEDS = 16


@pytest.mark.parametrize("group", range(4))
def test_both_cores_give_equal_frames_events_counters_and_deadlines(
    native_library: Any,
    group: int,
) -> None:
    counts = [equality.run(native_library, seed) for seed in range(group, SEEDS, 4)]
    assert sum(counts) > 500, "the layouts are hardly sent"


@pytest.mark.extended
@pytest.mark.parametrize("group", range(20))
def test_both_cores_are_equal_over_a_million_frames(native_library: Any, group: int) -> None:
    """All groups together compare a million frames of about 100 layouts of up to 30 messages."""
    seeds = range(10_000 + group, 10_100, 20)
    counts = [equality.run(native_library, seed, steps=2000, most=30) for seed in seeds]
    assert sum(counts) > 15_000


def test_both_cores_are_equal_in_quiet_mode(native_library: Any) -> None:
    begins = 0
    for seed in range(60):
        try:
            both = equality.made(native_library, seed)
        except NotInCore:
            continue
        both.run(300)
        begins += both.quiet_begins
    assert begins > 60, "quiet mode hardly begins"


def _scaled(chance: random.Random) -> str:
    """Return a message whose signal has a factor of many digits.

    The signal cannot represent all values of its source.
    """
    length = chance.randint(2, 24)
    is_signed = chance.random() < 0.5
    numerator = chance.choice((1, 1, 1, -1))
    denominator = chance.choice((3, 7, 255, 1023, 4095))
    factor = f"{numerator / denominator:.8g}"
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
def test_factor_of_many_digits_gives_the_same_frames_in_c(native_library: Any, seed: int) -> None:
    """Values are near the largest one that the core multiplies or the signal represents.

    The limits of the source are included.
    """
    chance = random.Random(seed)
    name, (low, high) = chance.choice([*SOURCES.items()])
    layout = compiled(_scaled(chance), bind={"S": name})
    escs = [EscSettings("esc1", pole_pairs=chance.choice((1, 7, 255)))]
    (row,) = Tables(CoreSettings(escs, layout)).signals
    ends = [(end * row.div - row.add) // row.mul for end in (row.low, row.high + 1)]
    steps = {low, high, 0, *(chance.randint(low, high) for _ in range(20))}
    middles = [row.most, -row.most, *ends]
    middles += [end * escs[0].pole_pairs for end in ends]
    for middle in middles:
        near = range(middle - 2, middle + 3)
        steps |= {step for step in near if low <= step <= high}
    field = "battery_current" if name == "battery_current" else "electrical_speed"
    cores = (
        PythonCore(CoreSettings(escs, layout), 0),
        NativeCore(native_library, CoreSettings(escs, layout), 0),
    )
    for number, step in enumerate(sorted(steps)):
        now = number * 10 * MS + MS
        data = encode(LiveData(**{field: step}), WireLayout.V4)
        for core in cores:
            core.receive(0, data, now, now)
            core.advance(now)
        python, native = (core.take(now) for core in cores)
        assert python == native, step
        assert len(python) == 1


@pytest.mark.parametrize("digits", [10, 17])
def test_factors_of_many_digits_run_in_c_and_can_be_exported(
    native_library: Any, digits: int
) -> None:
    """The normal tier has 40 of the 160 DBCs of the extended one."""
    reasons = [random_scales.run(native_library, seed, digits) for seed in range(40)]
    assert reasons.count("") >= (39 if digits == 10 else 36), reasons


@pytest.mark.extended
@pytest.mark.parametrize(("digits", "least"), [(10, 155), (17, 140)])
def test_160_dbcs_with_factors_of_many_digits_run_in_c(
    native_library: Any, digits: int, least: int
) -> None:
    reasons = [random_scales.run(native_library, seed, digits) for seed in range(160)]
    print(reasons.count(""), [reason for reason in reasons if reason])
    assert reasons.count("") >= least, reasons


RAD_PER_S = """VERSION ""
BU_: G X
BO_ 256 M: 8 G
 SG_ Speed : 0|16@1+ (1,0) [0|0] "rad/s" X
 SG_ Output : 16|16@1+ (0.0001,0) [0|0] "1/min" X
 SG_ Power : 32|16@1- (0.01,0) [0|0] "hp" X
"""
BINDINGS_OF_RAD_PER_S = {
    "Speed": "motor_speed",
    "Output": "output_speed",
    "Power": "battery_power",
}


def test_settings_changed_at_run_time_apply_to_speeds_in_rad_per_s(native_library: Any) -> None:
    """Rows whose exact numbers leave 64 bits contain the settings, so they are made again."""
    layout = compiled(RAD_PER_S, bind=BINDINGS_OF_RAD_PER_S)
    escs = [EscSettings("esc1", 7, Fraction(5, 2))]
    assert Tables(CoreSettings(escs, layout)).of_settings
    cores = (
        PythonCore(CoreSettings(escs, layout), 0),
        NativeCore(native_library, CoreSettings(escs, layout), 0),
    )
    now = 0
    for poles, gear in ((7, Fraction(5, 2)), (14, Fraction("9.81818")), (255, Fraction(1, 9))):
        for speed in (1, 4_177, 70_000, 654_321, 2**32 - 1):
            now += 10 * MS
            data = encode(LiveData(electrical_speed=speed), WireLayout.V4)
            frames = []
            for core in cores:
                core.apply(0, EscSettings("esc1", poles, gear))
                core.receive(0, data, now, now)
                core.advance(now)
                frames.append(core.take(now))
            assert frames[0] == frames[1], (poles, gear, speed)


TOO_FINE = ' SG_ S : 0|32@1+ ({},0) [0|0] "{}" X\n'
HEAD = 'VERSION ""\nBU_: G X\nBO_ 256 M: 8 G\n'


@pytest.mark.parametrize(
    ("source", "factor", "remedy"),
    [
        ("motor_run_time", "3.14159265358979312", r"Factor (3\.1415926\d+) fits"),
        ("motor_run_time", "0.00012345678912345678", r"Factor (0\.00012345678\d+) fits"),
    ],
)
def test_suggested_factor_fits_and_is_almost_equal(
    source: str,
    factor: str,
    remedy: str,
) -> None:
    escs = [EscSettings("esc1")]
    text = HEAD + TOO_FINE
    with pytest.raises(NotInCore) as found:
        Tables(CoreSettings(escs, compiled(text.format(factor, "s"), bind={"S": source})))
    advice = re.search(r"M\.S: factor \S+ exceeds 64 bits\. " + remedy, str(found.value))
    assert advice is not None, str(found.value)
    assert abs(float(advice[1]) / float(factor) - 1) <= 1e-6
    Tables(CoreSettings(escs, compiled(text.format(advice[1], "s"), bind={"S": source})))


def test_no_factor_is_suggested_if_none_is_almost_equal() -> None:
    """The exact value in days needs more than 64 bits, and a rounded factor does not help."""
    text = HEAD + ' SG_ S : 0|64@1+ (1,0) [0|0] "rad/s" X\n'
    with pytest.raises(NotInCore) as found:
        Tables(
            CoreSettings(
                [EscSettings("esc1")],
                compiled(text.replace("(1,", "(1e-9,"), bind={"S": "output_speed"}),
            )
        )
    reason = "M.S: factor 1e-09 exceeds 64 bits. A smaller maximum or fewer bits may fit"
    assert str(found.value) == reason


def test_offset_far_beyond_all_values_is_refused_at_once() -> None:
    """The numbers are not searched by counting, which would not end."""
    layout = compiled(
        HEAD + ' SG_ S : 0|16@1+ (0.01,1e300) [0|0] "V" X\n', bind={"S": "battery_voltage"}
    )
    with pytest.raises(NotInCore, match=r"M\.S: .* exceeds 64 bits"):
        Tables(CoreSettings([EscSettings("esc1")], layout))


FLOAT = ' SG_ S : 0|{}@1- ({},0) [0|0] "{}" X\nSIG_VALTYPE_ 256 S : {};\n'
SINGLE = 32, 1
DOUBLE = 64, 2


@pytest.mark.parametrize(
    ("source", "unit", "factor", "form"),
    [
        ("motor_speed", "rad/s", "1", SINGLE),
        ("battery_power", "hp", "1", SINGLE),
        ("battery_current", "A", "0.12345678901234567", SINGLE),
        ("battery_current", "A", "0.12345678901234567", DOUBLE),
    ],
)
def test_float_with_a_factor_of_many_digits_gives_the_same_frames_in_c(
    native_library: Any,
    source: str,
    unit: str,
    factor: str,
    form: tuple[int, int],
) -> None:
    length, code = form
    layout = compiled(HEAD + FLOAT.format(length, factor, unit, code), bind={"S": source})
    escs = [EscSettings("esc1", 7)]
    python = PythonCore(CoreSettings(escs, layout), 0)
    native = NativeCore(native_library, CoreSettings(escs, layout), 0)
    chance = random.Random(1)
    for number in range(500):
        now = number * 10 * MS
        data = encode(random_live(chance), WireLayout.V4)
        frames = []
        for core in (python, native):
            core.receive(0, data, now, now)
            core.advance(now)
            frames.append(core.take(now))
        assert frames[0] == frames[1], number


@pytest.mark.parametrize(
    ("factor", "form"),
    [
        ("1", DOUBLE),
        ("1e-300", SINGLE),
    ],
)
def test_float_that_needs_more_than_64_bits_is_refused(factor: str, form: tuple[int, int]) -> None:
    length, code = form
    layout = compiled(HEAD + FLOAT.format(length, factor, "rad/s", code), bind={"S": "motor_speed"})
    with pytest.raises(NotInCore, match=r"exceeds 64 bits\. An integer may fit$"):
        Tables(CoreSettings([EscSettings("esc1", 7)], layout))


def test_value_that_the_c_core_does_not_compute_is_refused_by_name() -> None:
    """A product is not the battery's power just because it is a product."""
    power = VALUES["battery_power"]
    bec = replace(power, name="BEC power", words=VALUES["bec_voltage"].words + power.words[1:])
    (plan,) = compiled(HEAD + TOO_FINE.format(1, "W"), bind={"S": "battery_power"}).messages
    (signal,) = plan.signals
    other = replace(plan, compiled=(replace(signal, source=bec),))
    with pytest.raises(NotInCore, match=r"^M\.S: BEC power is computed in Python only$"):
        Tables(CoreSettings([EscSettings("esc1")], MessageLayout("", "", (other,))))


def test_every_value_of_the_product_has_a_source_in_c() -> None:
    """The table of sources has no other names."""
    own = {Kind.WIRE, Kind.BITS}
    names = {(value.kind, value.name) for value in VALUES.values() if value.kind not in own}
    of_objects = {key for key in tables.SOURCES if key[0] is Kind.OBJECT}
    missing = names ^ ({*tables.SOURCES} - of_objects)
    assert not missing, "compute it in core.c: steps, and add it to native/tables.py: SOURCES"


_COUNTED = """
unsigned long kcg_calls;
__attribute__((no_instrument_function))
void __cyg_profile_func_enter(void *f, void *from) { (void)f, (void)from, kcg_calls++; }
__attribute__((no_instrument_function))
void __cyg_profile_func_exit(void *f, void *from) { (void)f, (void)from; }
"""


def _sort_calls(library: Any, messages: int) -> int:
    """Return the number of C calls for handing over ``messages`` cyclic messages.

    As many messages that are sent by event became due after them.
    """
    signal = Sig("ElectricalSpeed", 0, 32, unit="1/min")
    (plan,) = compiled(dbc_text([Msg("M", 256, 8, [signal])])).messages
    by_event = replace(plan, send_type=SendType.EVENT, cycle_ns=0, delay_ns=0)
    by_time = replace(plan, send_type=SendType.CYCLIC, cycle_ns=10 * MS, delay_ns=0)
    plans = [replace(by_event, can_id=n) for n in range(messages)]
    plans += [replace(by_time, can_id=messages + n) for n in range(messages)]
    core = NativeCore(
        library, CoreSettings([EscSettings("esc1")], MessageLayout("", "", tuple(plans))), 0
    )
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


def _energy_object() -> SlotPlan:
    """Return the plan of a PDO with the energy of CANopen, in 0.1 Wh."""
    eds = load_eds(shipped("eds/kontronik_esc.eds").read_bytes(), "kontronik_esc.eds")
    (entry,) = (each for each in eds.entries if (each.index, each.sub) == (0x2001, 4))
    energy = Variable(entry)
    energy.bound = BINDINGS[0x2001, 4]
    return compile_pdo([energy])


@pytest.mark.parametrize(
    "mw_s",
    [(1 << 48) + 1, 10 * 31_557_600 * 100_000_000],
    ids=["2^48 mW s", "ten years at 100 kW"],
)
def test_large_energy_is_equal_in_both_cores_and_restarts_at_0(
    native_library: Any,
    mw_s: int,
) -> None:
    settings = CoreSettings((EscSettings(),), MessageLayout("", "", ()), slots=1)
    for core in (PythonCore(settings, 0), NativeCore(native_library, settings, 0)):
        slot = core.slot(0)
        slot.configure(SlotSettings(_energy_object(), 0x181, True, 0, 0), 0)
        slot.start(0)
        core.escs[0].energy_mw_ns = mw_s * SECOND
        (frame,) = core.take(0)
        tenths_of_wh = (mw_s + 180_000) // 360_000
        assert int.from_bytes(frame.data, "little") == tenths_of_wh % (1 << 32), core.language


def test_frame_at_the_end_of_a_stream_is_found_but_not_processed(native_library: Any) -> None:
    """Later calls do not process it either. In this stream a shorter frame follows a header."""
    core = NativeCore(native_library, CoreSettings([EscSettings()], MessageLayout("", "", ())), 0)
    frame = encode(LiveData(battery_voltage=2400), WireLayout.LEGACY)
    core.receive(0, b"KODI" + frame, SECOND, SECOND)
    native_library.kcg_end(core.core, 0)
    assert core.state.found_count == 1
    core.advance(SECOND)
    assert core.state.found_at == 0
    assert core.escs[0].live is None


@pytest.mark.parametrize("frames", [0, 99_999_998, 150_000_000, 2**32 - 3])
def test_rate_counts_at_most_100_million_frames_in_a_second(
    native_library: Any,
    frames: int,
) -> None:
    """No UART carries so many. The limit keeps the rate of the core in C in 32 bits."""
    esc = EscSettings(timeout_ns=2 * SECOND)
    both = equality.Both(native_library, random.Random(1), [esc], MessageLayout("", "", ()))
    reading = encode(LiveData(battery_voltage=2400), WireLayout.V4)
    both.call("receive", 0, reading, both.now, both.now)
    python, native = both.python.escs[0], both.native.escs[0]
    counters: Any = python.counters
    counters.live_v4 += frames
    native._state.count[KCG.N_LIVE_V4] += frames
    both.now += SECOND
    both.call("receive", 0, reading, both.now, both.now)
    both.call("advance", both.now + 1)
    assert python.frame_rate == native.frame_rate
    assert python.frame_rate == pytest.approx(10 * min(frames + 1, 100_000_000), rel=1e-6)


@pytest.mark.usefixtures("c_compiler")
def test_sorting_of_pending_messages_is_not_quadratic(tmp_path: Path) -> None:
    """Messages that became due earlier are marked last.

    Four times as many messages may need little more than four times as many calls.
    """
    counter = tmp_path / "counter.c"
    counter.write_text(_COUNTED, encoding="utf-8")
    options = ("-O0", "-finstrument-functions", "-Wl,-Bsymbolic", *OPTIONS, str(counter))
    library = load(built(tmp_path / "counted.so", *options))
    few = _sort_calls(library, 60)
    many = _sort_calls(library, 240)
    print(few, many)
    assert few < many < 6 * few, (few, many)


@pytest.mark.extended
@pytest.mark.usefixtures("c_compiler")
def test_clang_compiles_every_source_without_a_warning(tmp_path: Path) -> None:
    """The fixture ``native_library`` does the same with gcc."""
    built(tmp_path / "core.so", *STRICT, "-O2", *OPTIONS, program="clang")


@pytest.mark.promise("no-undefined-behaviour")
@pytest.mark.extended
@pytest.mark.usefixtures("c_compiler")
def test_core_stays_in_its_memory_and_has_no_undefined_behaviour(tmp_path: Path) -> None:
    script = (
        "import pathlib, sys\nimport equality, offline_equality\n"
        "from kontronik_can_gw.native.binding import load\n"
        "path = pathlib.Path(sys.argv[1])\nlibrary = load(path)\n"
        "print(sum(equality.run(library, seed) for seed in range(10)))\n"
        "print(sum(offline_equality.run(library, seed, path.parent) for seed in range(3)))\n"
    )
    counts = run_sanitized(tmp_path, "-c", script).split()
    assert all(int(count) > 200 for count in counts)


@pytest.mark.usefixtures("c_compiler")
def test_object_of_other_sources_is_refused_in_one_line(tmp_path: Path) -> None:
    options = [option.replace("KCG_DATA=64", "KCG_DATA=8") for option in OPTIONS]
    with pytest.raises(WrongObject, match="built from other sources"):
        load(built(tmp_path / "small.so", *options))
