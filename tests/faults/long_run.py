"""Lets a gateway run for hours of virtual time, with samples by the judge.

One ESC, recording, CANopen and DroneCAN. Between two samples the judge pauses and the ESC sends
fewer frames, because the feeder and the judge need more processor time than the gateway. The wall
clock passes the end of 32-bit times in the middle of the run.
"""

import time

from fault_report import Fault, Report
from harness import Bench
from memory_slope import HOUR_S, Sample, faults_in, slope_kib_per_hour

FULL_HZ = 100.0
REST_HZ = 8.0
"""Frames a second between two samples. Live data stay fresh at this rate."""
SAMPLE_S = 10
SAMPLE_EACH_S = 600
SETTLE_S = 2
"""The time after a change of the rate, in which frames may be lost."""
WARM_UP = 0.1
"""The part of the run after which descriptors, threads and memory are not expected to grow."""
END_OF_32_BITS = 1 << 31
"""The second of the year 2038 at which a signed number of 32 bits ends."""


def set_wall_clock(hours: float) -> None:
    """Set the wall clock so that the middle of the run is at the end of 32-bit times."""
    time.clock_settime(time.CLOCK_REALTIME, END_OF_32_BITS - hours * HOUR_S / 2)


def sample(bench: Bench, length_s: float) -> int:
    """Judge for this long, at the full rate. Return the number of frames with right values."""
    (esc,) = bench.escs
    esc.rate_hz = FULL_HZ
    bench.watch.resume()
    time.sleep(SETTLE_S)
    bench.leave_out([0], 0, time.monotonic_ns())
    before = bench.watch.values
    time.sleep(length_s)
    return bench.watch.values - before


def live(
    bench: Bench,
    fault: Fault,
    report: Report,
    hours: float,
    max_growth_kib: int,
) -> None:
    """Run the gateway for hours, and judge its values, memory, descriptors and threads."""
    row = report.of(fault)
    (esc,) = bench.escs
    begin = time.monotonic()
    end = begin + hours * HOUR_S
    samples: list[Sample] = []
    before: dict[str, int] = {}
    while True:
        right = sample(bench, SAMPLE_S)
        row.injected += 1
        if right < SAMPLE_S * FULL_HZ:
            row.notes.append(f"only {right} frames with right values in {SAMPLE_S} s")
        losses = bench.account(row)
        row.notes += [f"lost value: {what}" for _, what in losses[:3]]
        bench.watch.pause()
        esc.rate_hz = REST_HZ
        bench.check_alive()
        figures = bench.gateway.figures()
        now = time.monotonic()
        samples.append(Sample(now, figures["rss"]))
        if not before and now - begin >= WARM_UP * hours * HOUR_S:
            before = figures
        wall = time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime())
        text = f"{(now - begin) / HOUR_S:.2f} h, wall clock {wall}"
        print(f"{text}: {right} frames right, {figures}", flush=True)
        if now >= end:
            break
        time.sleep(min(SAMPLE_EACH_S, end - now))
    row.wrong = bench.watch.wrong_count
    row.notes += [f"wrong value: {each.what}" for each in list(bench.watch.wrong)[:3]]
    row.notes += faults_in(samples)
    row.notes += bench.gateway.growth(before, max_growth_kib)
    row.transmitted = sum(each.received() for each in bench.escs)
    row.recovered = 0 if row.notes else row.injected
    slope = slope_kib_per_hour(samples)
    print(f"memory: {slope:.1f} KiB an hour, {len(samples)} samples")
    print(row.text, bench.gateway.figures())
