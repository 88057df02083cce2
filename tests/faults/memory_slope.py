"""Judges resident memory by its slope over time, because a limit misses slow growth."""

from collections.abc import Sequence
from typing import NamedTuple

HOUR_S = 3600
MAX_KIB_PER_HOUR = 128
"""Four hours may add 0.5 MB.

The free lists that grew with recording, CANopen and DroneCAN added 3.3 MB in a quarter of an hour.
"""
MIN_HOURS = 1
"""Shortest run that is judged: memory is freed in pages, and faults use some for a while."""
_WARM_UP = 0.25
"""Part of the run that is ignored: caches and buffers reach their sizes."""


class Sample(NamedTuple):
    """Resident memory at a time."""

    seconds: float
    rss_kib: int


def slope_kib_per_hour(samples: Sequence[Sample]) -> float:
    """Return the slope of the regression line (least squares), or 0 for less than two samples."""
    count = len(samples)
    if count < 2:
        return 0.0
    mean_time = sum(each.seconds for each in samples) / count
    mean_rss = sum(each.rss_kib for each in samples) / count
    spread = sum((each.seconds - mean_time) ** 2 for each in samples)
    common = sum((each.seconds - mean_time) * (each.rss_kib - mean_rss) for each in samples)
    return common / spread * HOUR_S


def faults_in(samples: Sequence[Sample]) -> list[str]:
    """Return the faults of a run's memory as text.

    The list is empty for a run that is shorter than ``MIN_HOURS``.
    """
    if not samples:
        return []
    begin = samples[0].seconds
    end = samples[-1].seconds
    if end - begin < MIN_HOURS * HOUR_S:
        return []
    settled = [each for each in samples if each.seconds >= begin + _WARM_UP * (end - begin)]
    slope = slope_kib_per_hour(settled)
    if slope <= MAX_KIB_PER_HOUR:
        return []
    return [f"memory grows by {slope:.0f} KiB an hour"]
