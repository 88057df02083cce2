"""The terminal screens of monitor, demo and status."""
