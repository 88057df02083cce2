"""The core in C, its tables, and what loads it."""
