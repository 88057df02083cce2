"""Gateway from KONTRONIK ESC telemetry to CAN."""

__version__ = "0.6.0"
