"""Writes DBC files: from a template, and of CANopen nodes."""
