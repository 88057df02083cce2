"""AUTOSAR E2E profile 1: CRC-8 SAE J1850 (polynomial 1Dh) over data id and data, start and final XOR 0 (PRS_E2EProtocol)."""


def _table() -> bytes:
    table = []
    for byte in range(256):
        for _ in range(8):
            byte = byte << 1 ^ (0x11D if byte & 0x80 else 0)
        table.append(byte)
    return bytes(table)


_CRC = _table()


def crc(data: bytes, at: int, data_id: int) -> int:
    """The CRC of a frame whose CRC byte stands at ``at``: data id low byte, high byte, all other bytes in order."""
    value = 0
    for byte in bytes((data_id & 0xFF, data_id >> 8 & 0xFF)) + data[:at] + data[at + 1 :]:
        value = _CRC[value ^ byte]
    return value


def protected(data: bytes, at: int, data_id: int) -> bytes:
    """The frame with its CRC at ``at``."""
    return data[:at] + bytes((crc(data, at, data_id),)) + data[at + 1 :]
