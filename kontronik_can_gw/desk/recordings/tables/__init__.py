"""Tables of ESC values, a row at each time: CSV, JSON lines, Parquet."""
