"""Captures: every call to the core, recorded for replay."""
