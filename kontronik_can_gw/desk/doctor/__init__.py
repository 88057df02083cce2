"""What `doctor` looks at: the serial ports, the CAN interface, the folders and the machine. Nothing is changed, nothing is sent."""
