"""The TOML configuration: its keys, and everything that it means put together."""
