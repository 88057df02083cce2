"""Recordings in columns, by numpy: the same frames, rows and texts as the streaming way, of whole stretches at once.

Import this only where numpy may be needed; it comes with the extras for Parquet and MF4, and without it everything goes the streaming way.
"""
