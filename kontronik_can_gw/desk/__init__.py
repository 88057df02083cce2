"""Tools for a user's desk: recordings, reports, the monitor, MQTT, metrics and diagnosis.

They do I/O and may read the clock.
"""
