"""The SDO server frame by frame: who says what and when, every path of CiA 301 clause 7.2.4."""

from binascii import crc_hqx

import pytest
from sdo_bench import MS, Bench, Dictionary, Entry, Line

from kontronik_can_gw.cia301.abort import Abort
from kontronik_can_gw.cia301.sdo import SdoServer

SECOND = 1000.0
DATA30 = bytes(range(30))


def crc(data: bytes) -> str:
    return crc_hqx(data, 0).to_bytes(2, "little").hex()


def segments(data: bytes, numbers: range | list[int], end: bool = True) -> list[str]:
    """Block segments 1, 2, … that carry the named sevens of ``data``; the very last is marked as such."""
    lines = []
    for number, place in enumerate(numbers, 1):
        last = 0x80 if end and 7 * place + 7 >= len(data) else 0
        lines.append((bytes((number | last,)) + data[7 * place : 7 * place + 7].ljust(7, b"\0")).hex())
    return lines


def said(direction: str, lines: list[str], time: float = 0) -> list[Line]:
    return [(time, direction, line) for line in lines]


def test_the_crc_is_the_one_the_standard_wants() -> None:
    assert crc_hqx(b"123456789", 0) == 0x31C3  # CRC-16/XMODEM: polynomial 1021h, initial value 0


DIALOGUES: dict[str, list[Line]] = {
    # ---- upload
    "expedited upload of four bytes": [(0, ">", "4000100000000000"), (0, "<", "4300100092010200")],
    "expedited upload of three bytes": [(0, ">", "4000200100000000"), (0, "<", "4700200161626300")],
    "expedited upload of two bytes": [(0, ">", "4017100000000000"), (0, "<", "4b171000e8030000")],
    "expedited upload of one byte": [(0, ">", "4001100000000000"), (0, "<", "4f01100005000000")],
    "unused bits and bytes of a request are ignored": [(0, ">", "5f011000ffffffff"), (0, "<", "4f01100005000000")],
    "upload of an object that does not exist": [(0, ">", "4034120500000000"), (0, "<", "8034120500000206")],
    "upload of a sub-index that does not exist": [(0, ">", "4000100100000000"), (0, "<", "8000100111000906")],
    "upload of a write-only object": [(0, ">", "4002200000000000"), (0, "<", "8002200001000106")],
    "segmented upload": [
        (0, ">", "4008100000000000"),
        (0, "<", "410810000a000000"),
        (1, ">", "6000000000000000"),
        (1, "<", "004b4f4e54524f4e"),
        (2, ">", "7000000000000000"),
        (2, "<", "19494b2100000000"),
    ],
    "segmented upload of no bytes": [
        (0, ">", "4001200000000000"),
        (0, "<", "4101200000000000"),
        (1, ">", "6000000000000000"),
        (1, "<", "0f00000000000000"),
    ],
    "segmented upload with a toggle bit that does not alternate": [
        (0, ">", "4008100000000000"),
        (0, "<", "410810000a000000"),
        (1, ">", "6000000000000000"),
        (1, "<", "004b4f4e54524f4e"),
        (2, ">", "6000000000000000"),
        (2, "<", "8008100000000305"),
        (3, ">", "7000000000000000"),
        (3, "<", "8000000001000405"),
    ],
    "segmented upload that starts with the wrong toggle bit": [
        (0, ">", "4008100000000000"),
        (0, "<", "410810000a000000"),
        (1, ">", "7000000000000000"),
        (1, "<", "8008100000000305"),
    ],
    "the segment after the last one belongs to no transfer": [
        (0, ">", "4001200000000000"),
        (0, "<", "4101200000000000"),
        (0, ">", "6000000000000000"),
        (0, "<", "0f00000000000000"),
        (0, ">", "7000000000000000"),
        (0, "<", "8000000001000405"),
    ],
    "the client aborts a segmented upload": [
        (0, ">", "4008100000000000"),
        (0, "<", "410810000a000000"),
        (1, ">", "8008100000000008"),
        (2, ">", "6000000000000000"),
        (2, "<", "8000000001000405"),
        (5 * SECOND, ">", "8000000000000008"),
    ],
    "segmented upload that times out": [
        (0, ">", "4008100000000000"),
        (0, "<", "410810000a000000"),
        (1500, ">", "6000000000000000"),
        (1500, "<", "004b4f4e54524f4e"),
        (3500, "<", "8008100000000405"),
        (3501, ">", "7000000000000000"),
        (3501, "<", "8000000001000405"),
    ],
    # ---- download, expedited
    "expedited download with the size": [(0, ">", "2b171000f4010000"), (0, "<", "6017100000000000")],
    "expedited download without the size has the object's length": [
        (0, ">", "22171000f4010000"),
        (0, "<", "6017100000000000"),
    ],
    "expedited download without the size fills what it can of a string": [
        (0, ">", "2204200041424344"),
        (0, "<", "6004200000000000"),
    ],
    "expedited download without the size to an object of eight bytes": [
        (0, ">", "2208200041424344"),
        (0, "<", "8008200010000706"),
    ],
    "expedited download that is too long": [(0, ">", "23171000f4010000"), (0, "<", "8017100012000706")],
    "expedited download that is too short": [(0, ">", "2f171000f4010000"), (0, "<", "8017100013000706")],
    "expedited download to a read-only object": [(0, ">", "2f01100000000000"), (0, "<", "8001100002000106")],
    "expedited download to no object": [(0, ">", "2f34120000000000"), (0, "<", "8034120000000206")],
    "expedited download of too high a value": [(0, ">", "2f06200065000000"), (0, "<", "8006200031000906")],
    # ---- download, segmented
    "segmented download with the size": [
        (0, ">", "210420000a000000"),
        (0, "<", "6004200000000000"),
        (1, ">", "0041424344454647"),
        (1, "<", "2000000000000000"),
        (2, ">", "1948494a00000000"),
        (2, "<", "3000000000000000"),
    ],
    "segmented download without the size": [
        (0, ">", "20042000ffffffff"),
        (0, "<", "6004200000000000"),
        (1, ">", "0d41000000000000"),
        (1, "<", "2000000000000000"),
    ],
    "segmented download of no bytes": [
        (0, ">", "2104200000000000"),
        (0, "<", "6004200000000000"),
        (1, ">", "0f00000000000000"),
        (1, "<", "2000000000000000"),
    ],
    "segmented download of four bytes in segments that are not full": [
        (0, ">", "2102200004000000"),
        (0, "<", "6002200000000000"),
        (1, ">", "0c41000000000000"),
        (1, "<", "2000000000000000"),
        (2, ">", "1942434400000000"),
        (2, "<", "3000000000000000"),
    ],
    "segmented download to a read-only object is refused before data moves": [
        (0, ">", "210810000a000000"),
        (0, "<", "8008100002000106"),
        (1, ">", "0041424344454647"),
        (1, "<", "8000000001000405"),
    ],
    "segmented download of too many bytes is refused before data moves": [
        (0, ">", "210420000b000000"),
        (0, "<", "8004200012000706"),
    ],
    "segmented download of more than fits into an object without a limit": [
        (0, ">", "2103200001000100"),
        (0, "<", "8003200005000405"),
    ],
    "segmented download that brings more than indicated": [
        (0, ">", "2104200006000000"),
        (0, "<", "6004200000000000"),
        (1, ">", "0041424344454647"),
        (1, "<", "8004200012000706"),
    ],
    "segmented download that brings less than indicated": [
        (0, ">", "2104200006000000"),
        (0, "<", "6004200000000000"),
        (1, ">", "0541424344450000"),
        (1, "<", "8004200013000706"),
    ],
    "segmented download without the size of more than the object holds": [
        (0, ">", "2004200000000000"),
        (0, "<", "6004200000000000"),
        (1, ">", "0041424344454647"),
        (1, "<", "2000000000000000"),
        (2, ">", "1041424344454647"),
        (2, "<", "8004200012000706"),
    ],
    "segmented download without the size of less than the object holds": [
        (0, ">", "2002200000000000"),
        (0, "<", "6002200000000000"),
        (1, ">", "0d41000000000000"),
        (1, "<", "8002200010000706"),
    ],
    "segmented download with a toggle bit that does not alternate": [
        (0, ">", "210420000a000000"),
        (0, "<", "6004200000000000"),
        (1, ">", "0041424344454647"),
        (1, "<", "2000000000000000"),
        (2, ">", "0948494a00000000"),
        (2, "<", "8004200000000305"),
    ],
    "segmented download that is never begun times out": [
        (0, ">", "210420000a000000"),
        (0, "<", "6004200000000000"),
        (2000, "<", "8004200000000405"),
        (9000, ">", "8000000000000008"),
    ],
    "segmented download whose value is refused at the end": [
        (0, ">", "2106200001000000"),
        (0, "<", "6006200000000000"),
        (1, ">", "0dff000000000000"),
        (1, "<", "8006200031000906"),
    ],
    "the client aborts a segmented download": [
        (0, ">", "210420000a000000"),
        (0, "<", "6004200000000000"),
        (1, ">", "8004200000000008"),
        (9000, ">", "8000000000000008"),
    ],
    # ---- commands out of place
    "a download segment without a transfer": [(0, ">", "0041424344454647"), (0, "<", "8000000001000405")],
    "an upload segment without a transfer": [(0, ">", "6000000000000000"), (0, "<", "8000000001000405")],
    "a block upload end without a transfer": [(0, ">", "a100000000000000"), (0, "<", "8000000001000405")],
    "a block upload acknowledgement without a transfer": [(0, ">", "a201010000000000"), (0, "<", "8000000001000405")],
    "a block upload start without a transfer": [(0, ">", "a300000000000000"), (0, "<", "8000000001000405")],
    "a block download end without a transfer": [(0, ">", "c100000000000000"), (0, "<", "8000000001000405")],
    "a command that does not exist": [(0, ">", "e008100000000000"), (0, "<", "8000000001000405")],
    "an abort without a transfer": [(0, ">", "8008100000000405"), (0, ">", "9f08100000000405")],
    "a command that does not exist ends the transfer": [
        (0, ">", "4008100000000000"),
        (0, "<", "410810000a000000"),
        (1, ">", "ff00000000000000"),
        (1, "<", "8008100001000405"),
        (2, ">", "6000000000000000"),
        (2, "<", "8000000001000405"),
    ],
    "a download segment in an upload ends it": [
        (0, ">", "4008100000000000"),
        (0, "<", "410810000a000000"),
        (1, ">", "0041424344454647"),
        (1, "<", "8008100001000405"),
    ],
    "an upload segment in a download ends it": [
        (0, ">", "210420000a000000"),
        (0, "<", "6004200000000000"),
        (1, ">", "6000000000000000"),
        (1, "<", "8004200001000405"),
    ],
    "a frame that has not eight bytes is none": [
        (0, ">", "40001000"),
        (0, ">", ""),
        (0, ">", "80"),
        (0, ">", "40001000000000"),
        (0, ">", "4008100000000000"),
        (0, "<", "410810000a000000"),
        (1999, ">", "60"),
        (2000, "<", "8008100000000405"),
    ],
    # ---- a new request in the midst of a transfer
    "an upload replaces an upload": [
        (0, ">", "4008100000000000"),
        (0, "<", "410810000a000000"),
        (1, ">", "6000000000000000"),
        (1, "<", "004b4f4e54524f4e"),
        (2, ">", "4001100000000000"),
        (2, "<", "4f01100005000000"),
        (3, ">", "7000000000000000"),
        (3, "<", "8000000001000405"),
    ],
    "a segmented download replaces a segmented upload, with its own toggle bit": [
        (0, ">", "4008100000000000"),
        (0, "<", "410810000a000000"),
        (1, ">", "6000000000000000"),
        (1, "<", "004b4f4e54524f4e"),
        (2, ">", "2104200001000000"),
        (2, "<", "6004200000000000"),
        (3, ">", "0d41000000000000"),
        (3, "<", "2000000000000000"),
    ],
    "a refused request in the midst of a transfer ends it too": [
        (0, ">", "4008100000000000"),
        (0, "<", "410810000a000000"),
        (1, ">", "4034120000000000"),
        (1, "<", "8034120000000206"),
        (2, ">", "6000000000000000"),
        (2, "<", "8000000001000405"),
    ],
    "an upload replaces a block upload": [
        (0, ">", "a403200004000000"),
        (0, "<", "c60320001e000000"),
        (1, ">", "4001100000000000"),
        (1, "<", "4f01100005000000"),
        (2, ">", "a300000000000000"),
        (2, "<", "8000000001000405"),
    ],
    "an upload replaces a block download that awaits its end": [
        (0, ">", "c604200001000000"),
        (0, "<", "a40420007f000000"),
        (1, ">", "8141000000000000"),
        (1, "<", "a2017f0000000000"),
        (2, ">", "4001100000000000"),
        (2, "<", "4f01100005000000"),
    ],
    # ---- block download
    "block download with size and CRC": [
        (0, ">", "c60420000a000000"),
        (0, "<", "a40420007f000000"),
        (1, ">", "0141424344454647"),
        (1, ">", "8248494a00000000"),
        (1, "<", "a2027f0000000000"),
        (2, ">", "d1" + crc(b"ABCDEFGHIJ") + "0000000000"),
        (2, "<", "a100000000000000"),
    ],
    "block download without size and CRC": [
        (0, ">", "c0042000ffffffff"),
        (0, "<", "a40420007f000000"),
        (1, ">", "8141424300000000"),
        (1, "<", "a2017f0000000000"),
        (2, ">", "d1ffff0000000000"),
        (2, "<", "a100000000000000"),
    ],
    "block download of no bytes": [
        (0, ">", "c604200000000000"),
        (0, "<", "a40420007f000000"),
        (1, ">", "8100000000000000"),
        (1, "<", "a2017f0000000000"),
        (2, ">", "dd00000000000000"),
        (2, "<", "a100000000000000"),
    ],
    "block download with a wrong CRC": [
        (0, ">", "c60420000a000000"),
        (0, "<", "a40420007f000000"),
        (1, ">", "0141424344454647"),
        (1, ">", "8248494a00000000"),
        (1, "<", "a2027f0000000000"),
        (2, ">", "d1" + crc(b"ABCDEFGHIX") + "0000000000"),
        (2, "<", "8004200004000405"),
    ],
    "block download that brings less than indicated": [
        (0, ">", "c60420000a000000"),
        (0, "<", "a40420007f000000"),
        (1, ">", "8141424344454647"),
        (1, "<", "a2017f0000000000"),
        (2, ">", "c1" + crc(b"ABCDEFG") + "0000000000"),
        (2, "<", "8004200013000706"),
    ],
    "block download that brings more than indicated, as the end request tells": [
        (0, ">", "c604200009000000"),
        (0, "<", "a40420007f000000"),
        (1, ">", "0141424344454647"),
        (1, ">", "8248494a00000000"),
        (1, "<", "a2027f0000000000"),
        (2, ">", "d1" + crc(b"ABCDEFGHIJ") + "0000000000"),
        (2, "<", "8004200012000706"),
    ],
    "block download without the size of more than the object holds ends as soon as that is certain": [
        (0, ">", "c404200000000000"),
        (0, "<", "a40420007f000000"),
        (1, ">", "0141424344454647"),
        (1, ">", "0241424344454647"),
        (1, "<", "8004200012000706"),
    ],
    "segments that were under way when a sub-block was cut short are no requests": [
        (0, ">", "c404200000000000"),
        (0, "<", "a40420007f000000"),
        (1, ">", "0141424344454647"),
        (1, ">", "0241424344454647"),
        (1, "<", "8004200012000706"),
        (2, ">", "0341424344454647"),
        (12, ">", "0441424344454647"),
        (12, ">", "8541424344454647"),
        (13, ">", "0641424344454647"),
        (13, "<", "8000000001000405"),
    ],
    "segments under way may take long altogether": [
        (0, ">", "c404200000000000"),
        (0, "<", "a40420007f000000"),
        (100, ">", "0141424344454647"),
        (200, ">", "0241424344454647"),
        (200, "<", "8004200012000706"),
        (250, ">", "0341424344454647"),
        (300, ">", "0441424344454647"),
        (351, ">", "0541424344454647"),
        (351, "<", "8000000001000405"),
        (351, ">", "0141424344454647"),
        (351, "<", "8000000001000405"),
    ],
    "after the last segment under way the next is a request": [
        (0, ">", "c404200000000000"),
        (0, "<", "a40420007f000000"),
        (1, ">", "0141424344454647"),
        (1, ">", "0241424344454647"),
        (1, "<", "8004200012000706"),
        (2, ">", "8341424344454647"),
        (2, ">", "0141424344454647"),
        (2, "<", "8000000001000405"),
    ],
    "a block download after one that was cut short starts afresh": [
        (0, ">", "c404200000000000"),
        (0, "<", "a40420007f000000"),
        (1, ">", "0141424344454647"),
        (1, ">", "0241424344454647"),
        (1, "<", "8004200012000706"),
        (2, ">", "c60420000a000000"),
        (2, "<", "a40420007f000000"),
        (3, ">", "0141424344454647"),
        (3, ">", "8248494a00000000"),
        (3, "<", "a2027f0000000000"),
        (4, ">", "d1" + crc(b"ABCDEFGHIJ") + "0000000000"),
        (4, "<", "a100000000000000"),
    ],
    "a request right after a sub-block was cut short is served": [
        (0, ">", "c404200000000000"),
        (0, "<", "a40420007f000000"),
        (1, ">", "0141424344454647"),
        (1, ">", "0241424344454647"),
        (1, "<", "8004200012000706"),
        (2, ">", "4001100000000000"),
        (2, "<", "4f01100005000000"),
        (3, ">", "0141424344454647"),
        (3, "<", "8000000001000405"),
        (3, ">", "0341424344454647"),
        (3, "<", "8000000001000405"),
    ],
    "what comes later than segments under way can is a request": [
        (0, ">", "c404200000000000"),
        (0, "<", "a40420007f000000"),
        (1, ">", "0141424344454647"),
        (1, ">", "0241424344454647"),
        (1, "<", "8004200012000706"),
        (52, ">", "0341424344454647"),
        (52, "<", "8000000001000405"),
    ],
    "block download with segment number 0": [
        (0, ">", "c60320001e000000"),
        (0, "<", "a40320007f000000"),
        (2, ">", "0100010203040506"),
        (2, ">", "0000010203040506"),
        (2, "<", "8003200003000405"),
    ],
    "block download that loses a segment in the middle": [
        (0, ">", "c60320001e000000"),
        (0, "<", "a40320007f000000"),
        *said(">", segments(DATA30, [0]), 1),
        (1, ">", segments(DATA30, range(5))[2]),
        (1, ">", segments(DATA30, range(5))[3]),
        (1, ">", segments(DATA30, range(5))[4]),
        (1, "<", "a2017f0000000000"),
        *said(">", segments(DATA30, [1, 2, 3, 4]), 2),
        (2, "<", "a2047f0000000000"),
        (3, ">", "d5" + crc(DATA30) + "0000000000"),
        (3, "<", "a100000000000000"),
    ],
    "block download that loses all but the last segment": [
        (0, ">", "c60320001e000000"),
        (0, "<", "a40320007f000000"),
        (1, ">", segments(DATA30, range(5))[4]),
        (1, "<", "a2007f0000000000"),
        *said(">", segments(DATA30, range(5)), 2),
        (2, "<", "a2057f0000000000"),
        (3, ">", "d5" + crc(DATA30) + "0000000000"),
        (3, "<", "a100000000000000"),
    ],
    "block download in which a segment comes twice": [
        (0, ">", "c604200008000000"),
        (0, "<", "a40420007f000000"),
        (1, ">", "0141424344454647"),
        (1, ">", "0141424344454647"),
        (1, ">", "8248000000000000"),
        (1, "<", "a2027f0000000000"),
        (2, ">", "d9" + crc(b"ABCDEFGH") + "0000000000"),
        (2, "<", "a100000000000000"),
    ],
    "block download whose last segment is lost times out": [
        (0, ">", "c604200008000000"),
        (0, "<", "a40420007f000000"),
        (1, ">", "0141424344454647"),
        (2001, "<", "8004200000000405"),
    ],
    "block download whose end request is missing times out": [
        (0, ">", "c604200001000000"),
        (0, "<", "a40420007f000000"),
        (1, ">", "8141000000000000"),
        (1, "<", "a2017f0000000000"),
        (2001, "<", "8004200000000405"),
    ],
    "the client aborts a block download in the midst of a sub-block": [
        (0, ">", "c604200008000000"),
        (0, "<", "a40420007f000000"),
        (1, ">", "0141424344454647"),
        (1, ">", "8004200000000008"),
        (1, ">", "0248000000000000"),
        (1, "<", "8000000001000405"),
    ],
    "the client aborts a block download and goes on with a segment": [
        (0, ">", "c604200008000000"),
        (0, "<", "a40420007f000000"),
        (1, ">", "8004200000000008"),
        (1, ">", "0141424344454647"),
        (1, "<", "8000000001000405"),
    ],
    "block download to a read-only object is refused before data moves": [
        (0, ">", "c60810000a000000"),
        (0, "<", "8008100002000106"),
    ],
    "block download of too many bytes is refused before data moves": [
        (0, ">", "c60420000b000000"),
        (0, "<", "8004200012000706"),
    ],
    "block download whose value is refused at the end": [
        (0, ">", "c606200001000000"),
        (0, "<", "a40620007f000000"),
        (1, ">", "8165000000000000"),
        (1, "<", "a2017f0000000000"),
        (2, ">", "d9" + crc(b"\x65") + "0000000000"),
        (2, "<", "8006200031000906"),
    ],
    "block download that says only in an empty segment that it is over": [
        (0, ">", "c604200007000000"),
        (0, "<", "a40420007f000000"),
        (1, ">", "0141424344454647"),
        (1, ">", "8200000000000000"),
        (1, "<", "a2027f0000000000"),
        (2, ">", "dd" + crc(b"ABCDEFG") + "ffffffffff"),
        (2, "<", "a100000000000000"),
    ],
    "block download whose last segment is empty": [
        (0, ">", "c606200001000000"),
        (0, "<", "a40620007f000000"),
        (1, ">", "8165000000000000"),
        (1, "<", "a2017f0000000000"),
        (2, ">", "dd" + crc(b"") + "0000000000"),
        (2, "<", "8006200013000706"),
    ],
    "a segment where the end of a block download is due": [
        (0, ">", "c604200001000000"),
        (0, "<", "a40420007f000000"),
        (1, ">", "8141000000000000"),
        (1, "<", "a2017f0000000000"),
        (2, ">", "0241000000000000"),
        (2, "<", "8004200001000405"),
    ],
    # ---- block upload
    "block upload with CRC in one sub-block": [
        (0, ">", "a40320007f000000"),
        (0, "<", "c60320001e000000"),
        (1, ">", "a300000000000000"),
        *said("<", segments(DATA30, range(5)), 1),
        (2, ">", "a2057f0000000000"),
        (2, "<", "d5" + crc(DATA30) + "0000000000"),
        (3, ">", "a100000000000000"),
        (9000, ">", "8000000000000008"),
    ],
    "block upload without CRC in sub-blocks of sizes that change": [
        (0, ">", "a003200002000000"),
        (0, "<", "c60320001e000000"),
        (1, ">", "a300000000000000"),
        *said("<", segments(DATA30, range(2)), 1),
        (2, ">", "a202010000000000"),
        *said("<", segments(DATA30, [2]), 2),
        (3, ">", "a2017f0000000000"),
        *said("<", segments(DATA30, [3, 4]), 3),
        (4, ">", "a202010000000000"),
        (4, "<", "d500000000000000"),
        (5, ">", "a100000000000000"),
    ],
    "block upload of no bytes": [
        (0, ">", "a40120007f000000"),
        (0, "<", "c601200000000000"),
        (1, ">", "a300000000000000"),
        (1, "<", "8100000000000000"),
        (2, ">", "a2017f0000000000"),
        (2, "<", "dd00000000000000"),
        (3, ">", "a100000000000000"),
    ],
    "block upload of seven bytes or fewer": [
        (0, ">", "a40010007f000000"),
        (0, "<", "c600100004000000"),
        (1, ">", "a300000000000000"),
        (1, "<", "8192010200000000"),
        (2, ">", "a2017f0000000000"),
        (2, "<", "cd" + crc(bytes.fromhex("92010200")) + "0000000000"),
        (3, ">", "a100000000000000"),
    ],
    "block upload repeats what follows the last acknowledged segment": [
        (0, ">", "a403200004000000"),
        (0, "<", "c60320001e000000"),
        (1, ">", "a300000000000000"),
        *said("<", segments(DATA30, range(4)), 1),
        (2, ">", "a201030000000000"),
        *said("<", segments(DATA30, [1, 2, 3]), 2),
        (3, ">", "a200040000000000"),
        *said("<", segments(DATA30, [1, 2, 3, 4]), 3),
        (4, ">", "a203040000000000"),
        *said("<", segments(DATA30, [4]), 4),
        (5, ">", "a201040000000000"),
        (5, "<", "d5" + crc(DATA30) + "0000000000"),
        (6, ">", "a100000000000000"),
    ],
    "block upload of no more than the threshold is expedited": [
        (0, ">", "a40010007f040000"),
        (0, "<", "4300100092010200"),
        (1, ">", "a300000000000000"),
        (1, "<", "8000000001000405"),
    ],
    "block upload of no more than the threshold is segmented": [
        (0, ">", "a40810007f0a0000"),
        (0, "<", "410810000a000000"),
        (1, ">", "6000000000000000"),
        (1, "<", "004b4f4e54524f4e"),
        (2, ">", "7000000000000000"),
        (2, "<", "19494b2100000000"),
    ],
    "block upload of more than the threshold": [
        (0, ">", "a40810007f090000"),
        (0, "<", "c60810000a000000"),
    ],
    "block upload with block size 0": [(0, ">", "a403200000000000"), (0, "<", "8003200002000405")],
    "block upload with block size 128": [(0, ">", "a403200080000000"), (0, "<", "8003200002000405")],
    "block upload of an object that does not exist": [(0, ">", "a434120001000000"), (0, "<", "8034120000000206")],
    "block upload acknowledged with block size 0": [
        (0, ">", "a403200004000000"),
        (0, "<", "c60320001e000000"),
        (1, ">", "a300000000000000"),
        *said("<", segments(DATA30, range(4)), 1),
        (2, ">", "a204000000000000"),
        (2, "<", "8003200002000405"),
    ],
    "block upload acknowledged with block size 128 at its very end": [
        (0, ">", "a40010007f000000"),
        (0, "<", "c600100004000000"),
        (1, ">", "a300000000000000"),
        (1, "<", "8192010200000000"),
        (2, ">", "a201800000000000"),
        (2, "<", "8000100002000405"),
    ],
    "block upload acknowledged beyond what was sent": [
        (0, ">", "a403200004000000"),
        (0, "<", "c60320001e000000"),
        (1, ">", "a300000000000000"),
        *said("<", segments(DATA30, range(4)), 1),
        (2, ">", "a205040000000000"),
        (2, "<", "8003200003000405"),
    ],
    "block upload acknowledged before it was started": [
        (0, ">", "a403200004000000"),
        (0, "<", "c60320001e000000"),
        (1, ">", "a200040000000000"),
        (1, "<", "8003200001000405"),
    ],
    "block upload started twice": [
        (0, ">", "a403200001000000"),
        (0, "<", "c60320001e000000"),
        (1, ">", "a300000000000000"),
        *said("<", segments(DATA30, [0]), 1),
        (2, ">", "a300000000000000"),
        (2, "<", "8003200001000405"),
    ],
    "block upload ended by the client before all is sent": [
        (0, ">", "a403200001000000"),
        (0, "<", "c60320001e000000"),
        (1, ">", "a300000000000000"),
        *said("<", segments(DATA30, [0]), 1),
        (2, ">", "a100000000000000"),
        (2, "<", "8003200001000405"),
    ],
    "block upload that the client aborts for its CRC": [
        (0, ">", "a40010007f000000"),
        (0, "<", "c600100004000000"),
        (1, ">", "a300000000000000"),
        (1, "<", "8192010200000000"),
        (2, ">", "a2017f0000000000"),
        (2, "<", "cd" + crc(bytes.fromhex("92010200")) + "0000000000"),
        (3, ">", "8000100004000405"),
        (9000, ">", "8000000000000008"),
    ],
    "block upload whose start is missing times out": [
        (0, ">", "a403200004000000"),
        (0, "<", "c60320001e000000"),
        (2000, "<", "8003200000000405"),
    ],
    "block upload whose acknowledgement is missing times out": [
        (0, ">", "a403200001000000"),
        (0, "<", "c60320001e000000"),
        (1, ">", "a300000000000000"),
        *said("<", segments(DATA30, [0]), 1),
        (2001, "<", "8003200000000405"),
    ],
    "block upload whose end is not confirmed times out": [
        (0, ">", "a40010007f000000"),
        (0, "<", "c600100004000000"),
        (1, ">", "a300000000000000"),
        (1, "<", "8192010200000000"),
        (2, ">", "a2017f0000000000"),
        (2, "<", "cd" + crc(bytes.fromhex("92010200")) + "0000000000"),
        (2002, "<", "8000100000000405"),
    ],
}


@pytest.mark.parametrize("lines", DIALOGUES.values(), ids=DIALOGUES.keys())
def test_dialogue(lines: list[Line]) -> None:
    Bench().play(lines)


@pytest.mark.parametrize(
    ("name", "written"),
    [
        ("expedited download with the size", (0x1017, 0, b"\xf4\x01")),
        ("expedited download without the size has the object's length", (0x1017, 0, b"\xf4\x01")),
        ("expedited download without the size fills what it can of a string", (0x2004, 0, b"ABCD")),
        ("segmented download with the size", (0x2004, 0, b"ABCDEFGHIJ")),
        ("segmented download without the size", (0x2004, 0, b"A")),
        ("segmented download of no bytes", (0x2004, 0, b"")),
        ("segmented download of four bytes in segments that are not full", (0x2002, 0, b"ABCD")),
        ("block download with size and CRC", (0x2004, 0, b"ABCDEFGHIJ")),
        ("block download without size and CRC", (0x2004, 0, b"ABC")),
        ("block download of no bytes", (0x2004, 0, b"")),
        ("block download that says only in an empty segment that it is over", (0x2004, 0, b"ABCDEFG")),
        ("a block download after one that was cut short starts afresh", (0x2004, 0, b"ABCDEFGHIJ")),
        ("block download that loses a segment in the middle", (0x2003, 0, DATA30)),
        ("block download that loses all but the last segment", (0x2003, 0, DATA30)),
        ("block download in which a segment comes twice", (0x2004, 0, b"ABCDEFGH")),
    ],
)
def test_a_confirmed_download_has_written_its_data_once(name: str, written: tuple[int, int, bytes]) -> None:
    bench = Bench()
    bench.play(DIALOGUES[name])
    assert bench.objects.written == [written]
    assert not bench.server.busy


@pytest.mark.parametrize(
    "name", [name for name, lines in DIALOGUES.items() if "download" in name and lines[-1][2].startswith("80")]
)
def test_a_refused_download_has_written_nothing(name: str) -> None:
    bench = Bench()
    bench.play(DIALOGUES[name])
    assert bench.objects.written == []


def test_an_upload_is_a_snapshot_of_its_beginning() -> None:
    bench = Bench()
    bench.play(DIALOGUES["segmented upload"][:4])
    bench.objects.entries[0x1008, 0].value = b"something else"
    assert bench.request(bytes.fromhex("7000000000000000")) == [bytes.fromhex("19494b2100000000")]
    assert bench.objects.uploads == 1


def test_a_download_is_checked_once_and_before_data_moves() -> None:
    segmented = Bench()
    segmented.play(DIALOGUES["segmented download with the size"][:2])
    assert segmented.objects.checks == [(0x2004, 0, 10)]
    block = Bench()
    block.play(DIALOGUES["block download without size and CRC"])
    assert block.objects.checks == [(0x2004, 0, None)]


def test_a_sub_block_of_127_segments_and_the_next_one() -> None:
    data = bytes(i % 251 for i in range(130 * 7))
    first = segments(data, range(127))
    second = segments(data, range(127, 130))
    bench = Bench()
    bench.play(
        [
            (0, ">", "c6032000" + len(data).to_bytes(4, "little").hex()),
            (0, "<", "a40320007f000000"),
            *said(">", first, 1),
            (1, "<", "a27f7f0000000000"),
            *said(">", second, 2),
            (2, "<", "a2037f0000000000"),
            (3, ">", "c1" + crc(data) + "0000000000"),
            (3, "<", "a100000000000000"),
            (4, ">", "a40320007f000000"),
            (4, "<", "c6032000" + len(data).to_bytes(4, "little").hex()),
            (5, ">", "a300000000000000"),
            *said("<", first, 5),
            (6, ">", "a27f7f0000000000"),
            *said("<", second, 6),
            (7, ">", "a2037f0000000000"),
            (7, "<", "c1" + crc(data) + "0000000000"),
            (8, ">", "a100000000000000"),
        ]
    )
    assert bench.objects.written == [(0x2003, 0, data)]
    assert not bench.server.busy


def test_within_a_sub_block_the_bytes_of_a_request_are_a_segment() -> None:
    data = bytes(7 * 64)
    lines = segments(data, range(64))
    assert lines[63].startswith("c0") and segments(data, range(64), end=False)[63].startswith("40")
    bench = Bench()
    bench.play(
        [
            (0, ">", "c4032000" + "00000000"),
            (0, "<", "a40320007f000000"),
            *said(">", segments(data, range(64), end=False), 1),
            *said(">", ["c100000000000000"], 1),
            (1, "<", "a2417f0000000000"),
        ]
    )


def test_a_sub_block_cut_short_by_a_reset_writes_nowhere() -> None:
    """Segment 23h with data 17h 10h … would be an expedited download to 1017h."""
    bench = Bench()
    bench.play([(0, ">", "c403200000000000"), (0, "<", "a40320007f000000")])
    lines = segments(bytes.fromhex("17100001020304") * 0x30, range(0x30), end=False)
    for line in lines[:0x20]:
        assert bench.request(bytes.fromhex(line)) == []
    bench.server.reset()
    for line in lines[0x20:]:
        assert bench.request(bytes.fromhex(line)) == []
    assert bench.objects.written == []
    assert not bench.server.busy


def test_segments_on_their_way_when_a_reset_comes_are_no_requests_either() -> None:
    bench = Bench()
    bench.play([(200, ">", "c403200000000000"), (200, "<", "a40320007f000000")])
    bench.server.reset()
    bench.now += 50 * MS
    assert bench.request(bytes.fromhex("0141424344454647")) == []
    assert bench.request(bytes.fromhex("0241424344454647")) == []
    assert bench.request(bytes.fromhex("4001100000000000")) == [bytes.fromhex("4f01100005000000")]


def test_a_segmented_upload_has_no_segment_too_many() -> None:
    bench = Bench()
    bench.objects.entries[0x2003, 0].value = b"ABCDEFG"
    bench.play(
        [
            (0, ">", "4003200000000000"),
            (0, "<", "4103200007000000"),
            (0, ">", "6000000000000000"),
            (0, "<", "0141424344454647"),
        ]
    )
    assert not bench.server.busy


def test_a_segmented_download_to_an_object_without_a_limit_ends_at_64_kib() -> None:
    bench = Bench()
    bench.request(bytes.fromhex("2003200000000000"))
    toggle = 0
    for _ in range(65536 // 7):
        assert bench.request(bytes((toggle,)) + bytes(7)) == [bytes((0x20 | toggle,)) + bytes(7)]
        toggle ^= 0x10
    assert bench.request(bytes((toggle,)) + bytes(7)) == [bytes.fromhex("8003200005000405")]


def test_a_block_download_to_an_object_without_a_limit_ends_at_64_kib() -> None:
    bench = Bench()
    bench.request(bytes.fromhex("c003200000000000"))
    answers = []
    for place in range(65536 // 7 + 1):
        answers += bench.request(bytes((place % 127 + 1,)) + bytes(7))
    assert answers[-1] == bytes.fromhex("8003200005000405")
    assert all(answer == bytes.fromhex("a27f7f0000000000") for answer in answers[:-1])
    assert len(answers) == 65536 // 7 // 127 + 1


# ---- confirmed later

WRITE_LATE = bytes.fromhex("2305200073617665")
LATE_OK = bytes.fromhex("6005200000000000")


def test_a_late_confirmation_answers_the_download() -> None:
    bench = Bench()
    assert bench.request(WRITE_LATE) == []
    assert bench.server.busy and bench.server.waiting is not None
    assert bench.server.next_deadline() is None
    bench.wait_until(60_000 * MS)
    assert bench.answers == []
    bench.server.confirm(None, bench.now)
    assert bench.answers == [LATE_OK]
    assert not bench.server.busy and bench.server.waiting is None
    bench.server.confirm(None, bench.now)
    assert bench.answers == [LATE_OK]


def test_a_late_refusal_aborts_the_download() -> None:
    bench = Bench()
    assert bench.request(WRITE_LATE) == []
    bench.server.confirm(Abort.HARDWARE, bench.now)
    assert bench.answers == [bytes.fromhex("8005200000000606")]
    assert not bench.server.busy


@pytest.mark.parametrize(
    ("begin", "last", "answer"),
    [
        (["2105200004000000"], "0773617665000000", "2000000000000000"),
        (["c605200004000000", "8173617665000000"], "cd" + crc(b"save") + "0000000000", "a100000000000000"),
    ],
    ids=["segmented", "block"],
)
def test_segmented_and_block_downloads_are_confirmed_later_too(begin: list[str], last: str, answer: str) -> None:
    bench = Bench()
    for line in begin:
        assert len(bench.request(bytes.fromhex(line))) == 1
    assert bench.request(bytes.fromhex(last)) == []
    assert bench.objects.written == [(0x2005, 0, b"save")]
    bench.wait_until(10_000 * MS)
    bench.server.confirm(None, bench.now)
    assert bench.answers == [bytes.fromhex(answer)]


@pytest.mark.parametrize(
    ("line", "answers"),
    [
        ("4001100000000000", ["4f01100005000000"]),
        ("6000000000000000", ["8005200001000405"]),
        ("8005200000000405", []),
    ],
    ids=["new request", "orphan segment", "client abort"],
)
def test_the_confirmation_of_a_dropped_download_is_ignored(line: str, answers: list[str]) -> None:
    bench = Bench()
    bench.request(WRITE_LATE)
    assert bench.request(bytes.fromhex(line)) == [bytes.fromhex(answer) for answer in answers]
    bench.answers.clear()
    bench.server.confirm(None, bench.now)
    bench.server.confirm(Abort.HARDWARE, bench.now)
    assert bench.answers == []


def test_the_confirmation_of_a_dropped_download_does_not_confirm_the_next_one() -> None:
    bench = Bench()
    bench.request(WRITE_LATE)
    first = bench.server.waiting
    bench.request(WRITE_LATE)
    second = bench.server.waiting
    assert first is not None and second is not None and first != second
    bench.answers.clear()
    bench.server.confirm(None, bench.now, first)
    assert bench.answers == []
    bench.server.confirm(None, bench.now, second)
    assert bench.answers == [LATE_OK]


def test_a_dictionary_may_confirm_from_within_the_download() -> None:
    class Eager(Dictionary):
        def download(self, index: int, sub: int, data: bytes, now: int) -> bool:
            super().download(index, sub, data, now)
            server.confirm(None, now)
            return sub == 0

    answers: list[bytes] = []
    server = SdoServer(Eager({(0x2005, 0): Entry(size=4), (0x2005, 1): Entry(size=4)}), answers.append)
    server.receive(WRITE_LATE, 0)
    assert answers == [LATE_OK]
    server.receive(bytes.fromhex("2305200173617665"), 0)
    assert answers == [LATE_OK, bytes.fromhex("6005200100000000")]
    assert not server.busy


def test_a_dictionary_may_reset_the_server_from_within_the_download() -> None:
    class Restarting(Dictionary):
        def download(self, index: int, sub: int, data: bytes, now: int) -> bool:
            server.reset()
            return True

    answers: list[bytes] = []
    server = SdoServer(Restarting(), answers.append)
    server.receive(WRITE_LATE, 0)
    assert answers == []
    assert not server.busy and server.next_deadline() is None


# ---- reset and time


@pytest.mark.parametrize(
    "begin",
    [
        ["4008100000000000"],
        ["210420000a000000"],
        ["a403200004000000"],
        ["a403200004000000", "a300000000000000"],
        ["c604200001000000"],
        ["c604200001000000", "8141000000000000"],
        ["2305200073617665"],
    ],
)
def test_a_reset_drops_a_transfer_without_a_word(begin: list[str]) -> None:
    bench = Bench()
    for line in begin:
        bench.request(bytes.fromhex(line))
    assert bench.server.busy
    bench.answers.clear()
    bench.server.reset()
    assert not bench.server.busy
    assert bench.server.next_deadline() is None
    bench.wait_until(9_000 * MS)
    bench.server.advance(bench.now)
    assert bench.answers == []
    assert bench.request(bytes.fromhex("6000000000000000")) == [bytes.fromhex("8000000001000405")]


def test_a_request_later_than_the_time_out_finds_the_transfer_ended() -> None:
    """Also when nobody called advance in time."""
    bench = Bench()
    bench.request(bytes.fromhex("4008100000000000"))
    bench.now = 2_000 * MS
    assert bench.request(bytes.fromhex("4001100000000000")) == [
        bytes.fromhex("8008100000000405"),
        bytes.fromhex("4f01100005000000"),
    ]


def test_advance_before_the_time_out_does_nothing() -> None:
    bench = Bench()
    bench.server.advance(0)
    bench.request(bytes.fromhex("4008100000000000"))
    bench.answers.clear()
    bench.server.advance(2_000 * MS - 1)
    assert bench.answers == [] and bench.server.busy
    bench.server.advance(2_000 * MS)
    assert bench.answers == [bytes.fromhex("8008100000000405")]
    bench.server.advance(5_000 * MS)
    assert len(bench.answers) == 1


# ---- paced block upload


def test_a_paced_block_upload_sends_bursts_of_four() -> None:
    data = bytes(range(70))
    bench = Bench(segment_ns=1 * MS)
    bench.objects.entries[0x2003, 0].value = data
    lines = segments(data, range(10))
    bench.play(
        [
            (0, ">", "a40320007f000000"),
            (0, "<", "c603200046000000"),
            (1, ">", "a300000000000000"),
            *said("<", lines[:4], 1),
            *said("<", lines[4:8], 5),
            *said("<", lines[8:], 9),
            (10, ">", "a20a7f0000000000"),
            (10, "<", "c1" + crc(data) + "0000000000"),
            (11, ">", "a100000000000000"),
        ]
    )


def test_paced_sub_blocks_keep_the_distance_between_them() -> None:
    bench = Bench(segment_ns=1 * MS)
    bench.play(
        [
            (0, ">", "a403200002000000"),
            (0, "<", "c60320001e000000"),
            (1, ">", "a300000000000000"),
            *said("<", segments(DATA30, [0, 1]), 1),
            (1.5, ">", "a202020000000000"),
            *said("<", segments(DATA30, [2, 3]), 3),
            (7, ">", "a202020000000000"),
            *said("<", segments(DATA30, [4]), 7),
        ]
    )


def test_an_early_acknowledgement_of_a_paced_sub_block_begins_a_new_one() -> None:
    data = bytes(range(70))
    bench = Bench(segment_ns=1 * MS)
    bench.objects.entries[0x2003, 0].value = data
    bench.play(
        [
            (0, ">", "a403200008000000"),
            (0, "<", "c603200046000000"),
            (0, ">", "a300000000000000"),
            *said("<", segments(data, range(4))),
            (1, ">", "a202030000000000"),
            *said("<", segments(data, [2, 3, 4]), 4),
            (5, ">", "a204030000000000"),
            (5, "<", "8003200003000405"),
        ]
    )


def test_the_time_out_runs_from_the_last_burst() -> None:
    data = bytes(range(49))
    bench = Bench(segment_ns=100 * MS)
    bench.objects.entries[0x2003, 0].value = data
    lines = segments(data, range(7))
    bench.play(
        [
            (0, ">", "a40320007f000000"),
            (0, "<", "c603200031000000"),
            (0, ">", "a300000000000000"),
            *said("<", lines[:4]),
            *said("<", lines[4:], 400),
            (2400, "<", "8003200000000405"),
        ]
    )


def test_a_late_advance_sends_one_burst_only() -> None:
    bench = Bench(segment_ns=1 * MS)
    bench.objects.entries[0x2003, 0].value = bytes(100)
    bench.request(bytes.fromhex("a40320007f000000"))
    assert len(bench.request(bytes.fromhex("a300000000000000"))) == 4
    bench.answers.clear()
    bench.now = 50 * MS
    bench.server.advance(bench.now)
    assert len(bench.answers) == 4
    bench.server.advance(bench.now)
    assert len(bench.answers) == 4
    assert bench.server.next_deadline() == 54 * MS


def test_a_client_that_aborts_stops_the_paced_segments() -> None:
    bench = Bench(segment_ns=1 * MS)
    bench.objects.entries[0x2003, 0].value = bytes(100)
    bench.request(bytes.fromhex("a40320007f000000"))
    bench.request(bytes.fromhex("a300000000000000"))
    assert bench.request(bytes.fromhex("8003200000000008")) == []
    assert bench.server.next_deadline() is None
    bench.server.advance(9_000 * MS)
    assert bench.answers == []
