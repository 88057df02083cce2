"""The three programs send the same frames for the same bytes."""

from registry import Benchmark

BENCHMARKS: list[Benchmark] = []
