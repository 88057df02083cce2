"""SDO abort codes of CiA 301 (7.2.4.3.17, table 22), and the exception that carries one through the core."""

from enum import IntEnum


class Abort(IntEnum):
    """Why an SDO transfer is refused or ended."""

    TOGGLE = 0x05030000
    TIMEOUT = 0x05040000
    COMMAND = 0x05040001
    BLOCK_SIZE = 0x05040002
    SEQUENCE = 0x05040003
    CRC = 0x05040004
    UNSUPPORTED_ACCESS = 0x06010000
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_LENGTH = 0x06040042
    INCOMPATIBLE = 0x06040043
    HARDWARE = 0x06060000
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUB_INDEX = 0x06090011
    VALUE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    GENERAL = 0x08000000
    TRANSFER = 0x08000020
    LOCAL_CONTROL = 0x08000021
    DEVICE_STATE = 0x08000022
    NO_DATA = 0x08000024


class SdoAbort(Exception):
    """Raised by the dictionary, answered by the SDO server with an abort frame; never leaves the core."""

    def __init__(self, code: Abort) -> None:
        super().__init__(f"{code:08X}h {code.name}")
        self.code = code
