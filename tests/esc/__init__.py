"""Tests of kontronik_can_gw.esc.

sheet.py and reference.py are independent of the tested package: they import nothing of it.
"""
