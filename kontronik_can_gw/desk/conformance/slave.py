"""The slave under test: raw frames to and from it, and its object dictionary.

A slave handles frames in their order. ``frames_until_answer`` uses that to observe that something
was not sent: it reads an object, and the frames before the answer are all that the slave sent.
"""

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from kontronik_can_gw.desk.conformance.eds_file import EdsFile

if TYPE_CHECKING:
    import can
    from canopen.objectdictionary import ODVariable

ABORT = 0x80
_NMT = 0x000
_SYNC = 0x080
_HEARTBEAT = 0x700
_SDO_REQUEST = 0x600
_SDO_ANSWER = 0x580
RESET_S = 0.1
"""Pause after the reset of a slave that sends no boot-up message."""
DEVICE_TYPE = 0x1000
"""An object that every slave has and that can be read."""


class ReceivedFrame(NamedTuple):
    """A frame that was received."""

    can_id: int
    data: bytes
    time_s: float
    """Time of the slave's clock at which it was read."""


class NoAnswer(Exception):
    """The slave did not answer a request within the time limit."""


class AbortedTransfer(Exception):
    """The slave aborted an SDO transfer."""

    def __init__(self, code: int) -> None:
        self.code = code
        super().__init__(f"abort {code:08X}h")


class Slave:
    """A slave on a bus. Every wait ends after ``limit_s`` seconds of ``clock``."""

    def __init__(
        self,
        bus: "can.BusABC",
        node_id: int,
        eds: EdsFile,
        limit_s: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.bus = bus
        self.node_id = node_id
        self.eds = eds.sections
        self.dictionary = eds.dictionary
        self.limit_s = limit_s
        self.clock = clock
        """Returns the time in seconds. The bus waits by the same clock."""
        self.has_boot_up = True
        """False after a reset without a boot-up message. Then no further one is waited for."""
        self.other_nodes: set[int] = set()
        """Node-IDs of other slaves whose boot-up messages or heartbeats were received."""

    # --- frames

    def send(
        self, can_id: int, data: bytes, *, extended: bool = False, remote: bool = False
    ) -> None:
        """Send a frame."""
        import can

        message = can.Message(
            arbitration_id=can_id,
            data=b"" if remote else data,
            dlc=len(data),
            is_extended_id=extended,
            is_remote_frame=remote,
        )
        self.bus.send(message, timeout=self.limit_s)

    def receive(self, until_s: float) -> ReceivedFrame | None:
        """Return the next frame, or None if no frame arrives until this time of the clock.

        A time in the past returns a frame that has arrived already.
        """
        while True:
            message = self.bus.recv(max(0.0, until_s - self.clock()))
            if message is None:
                return None
            is_data = not (message.is_error_frame or message.is_remote_frame)
            if is_data and not message.is_extended_id:
                frame = ReceivedFrame(message.arbitration_id, bytes(message.data), self.clock())
                node_id = frame.can_id - _HEARTBEAT
                if 0 < node_id < 0x80 and node_id != self.node_id:
                    self.other_nodes.add(node_id)
                return frame

    def waiting_frames(self) -> list[ReceivedFrame]:
        """Return the frames that have arrived."""
        return self.frames_during(0)

    def wait_for(
        self, condition: Callable[[ReceivedFrame], bool], limit_s: float | None = None
    ) -> ReceivedFrame:
        """Return the first frame that meets a condition. Raises NoAnswer after the limit."""
        until_s = self.clock() + (self.limit_s if limit_s is None else limit_s)
        while (frame := self.receive(until_s)) is not None:
            if condition(frame):
                return frame
        raise NoAnswer

    def frames_during(self, seconds: float) -> list[ReceivedFrame]:
        """Return all frames that arrive within this time."""
        until_s = self.clock() + seconds
        return list(iter(lambda: self.receive(until_s), None))

    def frames_until_answer(self) -> list[ReceivedFrame]:
        """Read the device type and return all frames that arrived before the answer.

        Raises NoAnswer after the time limit.
        """
        where = multiplexer(DEVICE_TYPE, 0)
        frames = self.waiting_frames()
        self.send_request(b"\x40" + where)
        until_s = self.clock() + self.limit_s
        while (frame := self.receive(until_s)) is not None:
            if self.is_answer(frame) and frame.data[1:4] == where:
                return frames
            frames.append(frame)
        raise NoAnswer

    def answers_until_answer(self) -> list[ReceivedFrame]:
        """Read the device type and return the SDO responses that arrived before its answer.

        Raises NoAnswer after the time limit.
        """
        return [frame for frame in self.frames_until_answer() if self.is_answer(frame)]

    # --- NMT and SYNC

    @property
    def heartbeat_id(self) -> int:
        return _HEARTBEAT + self.node_id

    def nmt(self, command: int, node_id: int | None = None) -> None:
        """Send an NMT command to the slave, or to another node. Node 0 stands for all nodes."""
        self.send(_NMT, bytes((command, self.node_id if node_id is None else node_id)))

    def sync(self) -> None:
        self.send(_SYNC, b"")

    def restart(self, command: int) -> list[ReceivedFrame]:
        """Reset the slave and enter PRE-OPERATIONAL. Return the frames up to its first answer.

        Raises NoAnswer if the slave does not answer after the reset.
        """
        self.waiting_frames()
        self.nmt(command)
        frames: list[ReceivedFrame] = []
        until_s = self.clock() + self.limit_s
        while self.has_boot_up:
            frame = self.receive(until_s)
            if frame is None:
                self.has_boot_up = False
                break
            frames.append(frame)
            if frame.can_id == self.heartbeat_id and frame.data == b"\0":
                break
        else:
            # its reset may still last, and would undo the effect of later commands
            frames += self.frames_during(RESET_S)
        self.nmt(0x80)
        return frames + self.frames_until_answer()

    # --- SDO

    def request(self, data: bytes) -> bytes:
        """Send an SDO request, which is padded with zeros, and return the answer.

        Raises NoAnswer after the time limit.
        """
        self.waiting_frames()  # so that an old answer is not taken for a new one
        self.send_request(data)
        return self.wait_for(self.is_answer).data.ljust(8, b"\0")

    def ask(self, data: bytes, where: bytes | None) -> bytes:
        """Send an SDO request and return the answer.

        ``where`` is the multiplexer of the transfer, or None without a transfer. Raises
        AbortedTransfer if the slave aborts the transfer, and UnexpectedAnswer if it names another
        object.
        """
        answer = self.request(data)
        if answer[0] != ABORT:
            return answer
        if where is not None and answer[1:4] != where:
            name = f"{int.from_bytes(where[:2], 'little'):04X}h:{where[2]:02X}"
            raise UnexpectedAnswer(answer, f"which does not name {name}")
        raise AbortedTransfer(int.from_bytes(answer[4:8], "little"))

    def send_request(self, data: bytes) -> None:
        """Send an SDO request without waiting for an answer."""
        self.send(_SDO_REQUEST + self.node_id, data.ljust(8, b"\0"))

    def is_answer(self, frame: ReceivedFrame) -> bool:
        return frame.can_id == _SDO_ANSWER + self.node_id

    def read(self, index: int, sub: int = 0) -> bytes:
        """Return the data of an object, by an upload of any kind. Raises AbortedTransfer."""
        where = multiplexer(index, sub)
        answer = self.ask(b"\x40" + where, where)
        if answer[0] & 0xE0 != 0x40 or answer[1:4] != where:
            raise UnexpectedAnswer(answer)
        if answer[0] & 2:
            if answer[0] & 1:
                return answer[4 : 8 - (answer[0] >> 2 & 3)]
            return answer[4 : 4 + self._size(index, sub)]  # the slave need not indicate it
        data = b""
        toggle = 0
        while True:
            part = self.ask(bytes((0x60 | toggle,)), where)
            if part[0] & 0xF0 != toggle:
                raise UnexpectedAnswer(part)
            data += part[1 : 8 - (part[0] >> 1 & 7)]
            toggle ^= 0x10
            if part[0] & 1:
                return data

    def _size(self, index: int, sub: int) -> int:
        """Return the number of bytes of an entry's data type, or 4 if it is not fixed."""
        from canopen.objectdictionary import datatypes

        variable = self.variable(index, sub)
        if variable is None or variable.data_type not in datatypes.INTEGER_TYPES:
            return 4
        return len(variable) // 8

    def number(self, index: int, sub: int = 0) -> int:
        """Return the value of an object as an unsigned number. Raises AbortedTransfer."""
        return int.from_bytes(self.read(index, sub), "little")

    def write(self, index: int, sub: int, data: bytes) -> None:
        """Write 1 to 4 bytes by an expedited download. Raises AbortedTransfer."""
        command = bytes((0x23 | 4 - len(data) << 2,))
        where = multiplexer(index, sub)
        answer = self.ask(command + where + data, where)
        if answer[:4] != b"\x60" + where:
            raise UnexpectedAnswer(answer)

    def write_number(self, index: int, sub: int, value: int) -> None:
        """Write a value in the size of the object's data type. Raises AbortedTransfer."""
        variable = self.variable(index, sub)
        assert variable is not None
        self.write(index, sub, encoded(variable, value))

    # --- the object dictionary

    def has(self, index: int, sub: int = 0) -> bool:
        return self.variable(index, sub) is not None

    def variable(self, index: int, sub: int = 0) -> "ODVariable | None":
        """Return an entry of the EDS, or None."""
        from canopen.objectdictionary import ODVariable

        found = self.dictionary.get(index)
        if found is None:
            return None
        if isinstance(found, ODVariable):
            return found if sub == 0 else None
        entry: ODVariable | None = found.subindices.get(sub)
        return entry

    def variables(self) -> "list[ODVariable]":
        """Return all entries of the EDS, in the order of index and sub-index."""
        from canopen.objectdictionary import ODVariable

        found = []
        for index in sorted(self.dictionary):
            entry = self.dictionary[index]
            if isinstance(entry, ODVariable):
                found.append(entry)
            else:
                found += [entry.subindices[sub] for sub in sorted(entry.subindices)]
        return found


class UnexpectedAnswer(Exception):
    """An SDO response does not fit its request."""

    def __init__(self, answer: bytes, reason: str = "") -> None:
        shown = f"answer {answer.hex(' ').upper()}"
        super().__init__(f"{shown}, {reason}" if reason else shown)


def encoded(variable: "ODVariable", value: int) -> bytes:
    """Return a number in the size of the entry's data type, also outside its limits."""
    size = len(variable) // 8
    return (value & (1 << 8 * size) - 1).to_bytes(size, "little")


def multiplexer(index: int, sub: int) -> bytes:
    """Return index and sub-index as an SDO frame has them."""
    return index.to_bytes(2, "little") + bytes((sub,))
