"""Tests of kontronik_can_gw.esc.kontronik. sheet.py and reference.py are the second opinion: they import nothing of the package."""
