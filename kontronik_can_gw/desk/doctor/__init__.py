"""The checks of `doctor`: serial ports, CAN interface, folders and machine. They change nothing and send nothing."""
