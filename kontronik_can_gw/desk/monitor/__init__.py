"""The screens of monitor, demo and status: one model, one table, one terminal."""
