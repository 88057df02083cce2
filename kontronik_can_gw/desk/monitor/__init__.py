"""The model of the live screen, fed with CAN frames."""
