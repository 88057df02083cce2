"""Durations and instants as integers: nanoseconds of one monotonic clock."""

MS = 1_000_000
"""A millisecond, ns."""
SECOND = 1000 * MS
"""A second, ns."""
END_OF_TIME = 1 << 61
"""No gateway has later times, in ns. Sums of earlier ones fit into 64 bits."""
NEVER = 1 << 62
"""An instant after every deadline, ns."""
