"""The CANopen node by CiA 301: one module per service, I/O-free, time passed in as integer nanoseconds."""
