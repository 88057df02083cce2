"""Random faults, one after the other, for minutes or hours: the same ones in the same order for the same seed.

    python tests/faults/soak.py [--minutes 10] [--seed N] [--out FILE]

In User Mode Linux, as programme.py. Says what each fault came to, and at the end, as figures: memory, descriptors and threads of the
one gateway process that lived through it all, wrong and lost values, the longest silences. Exits with 1 if one of them is not right.
"""

import json
import random
import sys
import time

import benches
import outside
import programme
from bus_watch import SECOND
from fault_report import Fault, Report, in_order
from harness import Bench, growth

NEW_PROCESS = ("missing at start", "kill -9", "SIGTERM", "frozen")
"""Faults that end the gateway: its memory could not be followed over them."""
MAX_GROWTH_KIB = 2048
GROWTH = Fault(
    "UML", "Process", "memory, descriptors and threads after it all", None, lambda: None, "two"
)


def run(bench: Bench, report: Report, generator: random.Random, end: float) -> None:
    """Faults until then, of those that the same gateway process lives through; then the figures."""
    assert bench.gateway is not None
    faults = [
        f
        for f in in_order("UML")
        if f.bench == "two" and not any(text in f.name for text in NEW_PROCESS)
    ]
    escs = range(len(bench.fed))
    quiet_s, longest_s, injected = 0.0, 0.0, 0
    before = bench.gateway.figures()
    while time.monotonic() < end:
        fault = generator.choice(faults)
        bench.watch.reset_silence()
        time.sleep(generator.uniform(0.5, 3))
        quiet_s = max(quiet_s, bench.longest_silence_s(escs))
        if injected == 5:
            before = bench.gateway.figures()
        injected += 1
        bench.watch.reset_silence()
        programme.run_one(bench, fault, report, 1)
        longest_s = max(longest_s, bench.longest_silence_s(escs))
    row = report.row(GROWTH)
    row.figures = {
        "faults": injected,
        "right values": bench.watch.values,
        "wrong values": bench.watch.wrong_count,
        "values late because the machine stood still": bench.watch.late_count,
        "values lost": sum(each.lost for each in report.rows),
        "longest silence of an ESC in s": round(longest_s, 3),
        "longest silence of an ESC between faults in s": round(quiet_s, 3),
        "s that the machine stood still": round(
            sum(e - b for b, e in bench.metronome.stalls) / SECOND, 2
        ),
    }
    row.injected = 1
    row.recovered = int(not growth(row, before, bench.gateway.figures(), MAX_GROWTH_KIB))


def main() -> int:
    parser = outside.parser(__doc__)
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--seed", type=int)
    args = parser.parse_args()
    if args.inside is None:
        seed = random.SystemRandom().randrange(1 << 32) if args.seed is None else args.seed
        words = [f"--minutes={args.minutes:g}", f"--seed={seed}"]
        return outside.main(
            args, "soak.py", [GROWTH], timeout_s=60 * args.minutes + 300, words=words
        )
    print(f"seed {args.seed}", flush=True)
    generator = random.Random(args.seed)
    # two ESCs: of more the judge, which shares the one processor with the gateway, falls behind within minutes
    escs = benches.IDENTITIES
    report = Report(seed=args.seed, minutes=args.minutes, escs=len(escs))
    with benches.bench_of(report, escs, prefix=benches.WITHOUT_OVERRIDE) as bench:
        run(bench, report, generator, time.monotonic() + 60 * args.minutes)
    print(json.dumps({**report.about, **report.row(GROWTH).figures}, indent=1))
    report.write(args.inside / "report.json")
    return 0


if __name__ == "__main__":
    sys.exit(main())
