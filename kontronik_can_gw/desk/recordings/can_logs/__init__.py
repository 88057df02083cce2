"""Logs of CAN frames as the tools of this field write and read them: candump, Vector ASC and BLF, PEAK TRC, MF4 bus logging."""
