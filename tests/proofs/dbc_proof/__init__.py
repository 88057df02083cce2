"""Proves with z3 that frames of a compiled DBC have the bits of its file.

``expected`` derives the frames from the DBC, ``planned`` describes the compiled plan, and
``formulas`` compares the two. docs/proof.md explains the scope of the proof.
"""
