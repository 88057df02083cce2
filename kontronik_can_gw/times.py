"""Durations and instants as integers: nanoseconds of one monotonic clock."""

MS = 1_000_000
"""A millisecond, ns."""
SECOND = 1000 * MS
"""A second, ns."""
NEVER = 1 << 62
"""An instant after every deadline, ns."""
