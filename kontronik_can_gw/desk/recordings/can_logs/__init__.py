"""Logs of CAN frames in the formats of other tools.

They are candump, Vector ASC and BLF, PEAK TRC, and MF4 bus logging.
"""
