"""The TOML configuration: its keys, and the objects assembled from it."""
