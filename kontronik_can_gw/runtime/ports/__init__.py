"""Serial ports of ESCs."""
