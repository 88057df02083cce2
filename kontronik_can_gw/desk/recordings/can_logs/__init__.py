"""Logs of CAN frames as the tools of this field write and read them: candump, Vector ASC and BLF, PEAK TRC, MF4 bus logging."""

from kontronik_can_gw.desk.recordings.can_logs.log import NAMES, SUFFIXES, UART_MAGIC, CanLog
from kontronik_can_gw.desk.recordings.can_logs.writer import CanLogWriter

__all__ = ["NAMES", "SUFFIXES", "UART_MAGIC", "CanLog", "CanLogWriter"]
