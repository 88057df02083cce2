"""The gateway: the core together with its outputs."""
