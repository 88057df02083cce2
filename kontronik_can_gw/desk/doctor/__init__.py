"""The checks of `doctor`: configuration, serial ports, CAN interface and service. They change nothing and send nothing.

A check has a name, a probe (the modules here) and a remedy for each of its results (checks.toml).
"""
