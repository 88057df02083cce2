"""The CAN interface."""
