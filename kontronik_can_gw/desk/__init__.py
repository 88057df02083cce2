"""Work beside the live gateway: decoding recordings, simulated ESCs on pseudo terminals. Does I/O and may read the clock."""
