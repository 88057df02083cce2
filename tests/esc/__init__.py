"""Tests of kontronik_can_gw.esc.

reference.py is independent of the tested package: it imports nothing of it.
"""
