"""Captures: every call that the core was given, to be played again."""
