"""Captures, plain bytes and CAN logs as one thing: read, converted, made into tables."""
