"""The TOML configuration: its keys, and the objects that are made from it."""
