"""The status document of a running gateway."""
