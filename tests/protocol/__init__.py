"""Tests of kontronik_can_gw.protocol. sheet.py and reference.py are the second opinion: they import nothing of the package."""
