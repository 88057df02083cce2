"""Random faults, one after the other, for minutes or hours: the same ones in the same order for the same seed.

    python tests/faults/soak.py [--minutes 10] [--seed N] [--out FILE]

In User Mode Linux, as programme.py. Says what each fault came to, and at the end, as figures: memory, descriptors and threads of the
one gateway process that lived through it all, wrong and lost values, the longest silences. Exits with 1 if one of them is not right.
"""

import json
import random
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

import benches
import can_faults  # noqa: F401  registers its faults, as the others do
import outside
import process_faults  # noqa: F401
import serial_faults  # noqa: F401
import time_faults  # noqa: F401
import traffic_faults  # noqa: F401
from encoding import Identity
from fault_report import Fault, Report, in_order, line
from harness import SECOND, Bench

from kontronik_can_gw.protocol.codec import Layout
from kontronik_can_gw.protocol.states import Device

NEW_PROCESS = ("missing at start", "kill -9", "SIGTERM", "frozen", "conf")
"""Faults that end the gateway: its memory could not be followed over them."""
IDENTITIES = (
    Identity(1),
    Identity(2, Layout.LEGACY, Device.JIVEPRO, 12, alarms=True),
    Identity(3, Layout.V4, Device.KOLIBRI, 10),
    Identity(4, Layout.LEGACY, Device.KOSMIK, 8, alarms=True),
)
MOST_GROWTH_KIB = 2048


def candidates() -> list[Fault]:
    """What may be drawn: every fault of the common bench that the same gateway process lives through."""
    return [f for f in in_order("UML") if f.bench == "two" and not any(text in f.name for text in NEW_PROCESS)]


def run(bench: Bench, report: Report, generator: random.Random, end: float) -> dict[str, float]:
    """Faults until then; the figures."""
    assert bench.gateway is not None
    faults = candidates()
    quiet_ns, longest_ns, injected = 0, 0, 0
    before = None
    while time.monotonic() < end:
        fault, pause = generator.choice(faults), generator.uniform(0.5, 3)
        begin = time.monotonic()
        bench.watch.reset_silence()
        time.sleep(pause)
        quiet_ns = max(quiet_ns, *bench.watch.longest_silence_ns)
        if before is None and injected >= 5:
            before = bench.gateway.figures()
        injected += 1
        row = report.row(fault)
        name = f"{fault.area}: {fault.name}"
        print(outside.BEGIN, name, flush=True)
        bench.watch.reset_silence()
        try:
            fault.run(bench, fault, 1)
        except AssertionError as error:
            row.notes.append(str(error))
            row.injected = max(row.injected, row.recovered + 1)
        longest_ns = max(longest_ns, *bench.watch.longest_silence_ns)
        figures = bench.gateway.figures()
        print(outside.END, name, flush=True)
        print(f"{time.monotonic() - begin:6.1f} s  rss {figures['rss']} KiB  {line(row)}", flush=True)
    after = bench.gateway.figures()
    before = before or after
    return {
        "faults": injected,
        **{f"{name} before": before[name] for name in before},
        **{f"{name} after": after[name] for name in after},
        "right values": bench.watch.values,
        "wrong values": bench.watch.wrong_count,
        "values late because the machine stood still": bench.watch.late_count,
        "values lost": sum(row.lost for row in report.rows),
        "longest silence of an ESC in s": round(longest_ns / SECOND, 3),
        "longest silence of an ESC between faults in s": round(quiet_ns / SECOND, 3),
        "s that the machine stood still": round(sum(e - b for b, e in bench.metronome.stalls) / SECOND, 2),
    }


GROWTH = Fault("UML", "Process", "memory, descriptors and threads after it all", None, lambda: None, "two")


def main() -> int:
    parser = outside.parser(__doc__)
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--seed", type=int)
    args = parser.parse_args()
    if args.inside is None:
        seed = random.SystemRandom().randrange(1 << 32) if args.seed is None else args.seed
        words = [f"--minutes={args.minutes:g}", f"--seed={seed}"]
        return outside.main(args, "soak.py", [GROWTH], timeout_s=60 * args.minutes + 300, words=words)
    print(f"seed {args.seed}", flush=True)
    generator = random.Random(args.seed)
    count = generator.randrange(2, 5)
    report = Report(seed=args.seed, minutes=args.minutes, escs=count)
    with benches.bench_of(report, IDENTITIES[:count], prefix=benches.WITHOUT_OVERRIDE) as bench:
        figures = run(bench, report, generator, time.monotonic() + 60 * args.minutes)
    growth = report.row(GROWTH)
    growth.injected, growth.figures = 1, figures
    limits = {"rss": MOST_GROWTH_KIB, "descriptors": 0, "threads": 0}
    grown = [name for name, most in limits.items() if figures[f"{name} after"] > figures[f"{name} before"] + most]
    growth.notes += [f"the gateway has more {name} than before" for name in grown]
    growth.recovered = int(not grown)
    print(json.dumps({"seed": args.seed, "escs": count, "minutes": args.minutes, **figures}, indent=1))
    report.write(args.inside / "report.json")
    return 0


if __name__ == "__main__":
    sys.exit(main())
