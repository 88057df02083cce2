"""Simulated Lawicel adapters on pseudo terminals, used by the kernel's slcan driver.

They form a CAN bus with bit rates and error states. A frame reaches every adapter that is open at
the same bit rate. Without such an adapter the frame is not acknowledged. The sender's controller
then becomes error passive and repeats the frame, as a real one does. The adapters report the state
of their controllers.

The driver counts a frame as sent when the adapter reads it. An adapter that cannot send reads no
further frame, so its frames wait in the kernel. When the interface is restarted, one kind of
adapter discards its frames, and the other kind (``keeps``) sends them later.
"""

import contextlib
import fcntl
import os
import select
import struct
import subprocess
import termios
import threading
import time
import tty

_N_SLCAN = 17
_TIOCSETD = 0x5423
_SIOCGIFNAME = 0x8910
FRAMES = (b"t", b"T", b"r", b"R")
"""First letters of frames. Other letters are commands."""
SHORTEST_FRAME = len("t1230\r")
WAIT_S = 0.05
_RATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)


class Adapter:
    """One adapter and its interface ``name``. A thread simulates its firmware."""

    def __init__(self, bus: "Bus", name: str) -> None:
        self.name = name
        self.rate: int | None = None
        self.is_open = False
        self.is_stuck = False
        """The controller sends nothing, but takes commands."""
        self.is_stuck_until_restart = False
        """The same, until the interface is restarted."""
        self.keeps = False
        """True if it keeps its frames when the interface is restarted."""
        self._kept: list[bytes] = []
        """Frames that it sends as soon as it can."""
        self._unread = 0
        """Number of bytes that it has seen but not read, because it cannot send."""
        self.silent = False
        """Bus-off: it takes frames from the computer but sends none on the bus."""
        self._bus = bus
        self._closed = False
        self._master, self._slave = os.openpty()
        os.set_blocking(self._master, False)
        tty.setraw(self._slave)
        fcntl.ioctl(self._slave, _TIOCSETD, struct.pack("i", _N_SLCAN))
        made = fcntl.ioctl(self._slave, _SIOCGIFNAME, bytes(16)).split(b"\0")[0].decode()
        subprocess.run(["ip", "link", "set", made, "name", name], check=True)
        self._thread = threading.Thread(target=self._run, name=f"adapter {name}", daemon=True)
        self._thread.start()

    def up(self, bitrate: int) -> None:
        """Set the bit rate and bring the interface up."""
        command = f"ip link set {self.name} up type can bitrate {bitrate}"
        subprocess.run(command.split(), check=True)

    def down(self) -> None:
        subprocess.run(["ip", "link", "set", self.name, "down"], check=True)

    def tell(self, text: str) -> None:
        """Send a text to the driver, as the firmware does."""
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, text.encode() + b"\r")

    def tell_state(
        self,
        state: str,
        receive: int = 0,
        transmit: int = 0,
    ) -> None:
        """Report the state ``a`` (active), ``w`` (warning), ``p`` (passive) or ``b`` (bus-off).

        The error counters are part of the report.
        """
        self.tell(f"s{state}{receive:03d}{transmit:03d}")

    def tell_errors(self, codes: str) -> None:
        """Report bus errors: ``a`` acknowledge, ``b`` bit0, ``B`` bit1, ``c`` CRC, ``f`` form.

        Further codes are ``o`` for an overrun and ``s`` for a stuff error.
        """
        self.tell(f"e{len(codes)}{codes}")

    def _run(self) -> None:
        waiting = b""
        while not self._closed:
            if not self._can_send:
                self._wait()
                continue
            self._send_kept()
            if not select.select([self._master], [], [], 0.05)[0]:
                continue
            try:
                waiting += os.read(self._master, 4096)
            except BlockingIOError:
                continue
            except OSError:
                return
            *commands, waiting = waiting.split(b"\r")
            for command in commands:
                self._do(command)

    @property
    def _can_send(self) -> bool:
        """False if a frame cannot be sent now and has to wait."""
        is_stuck = self.is_stuck or self.is_stuck_until_restart
        return not self.is_open or not (is_stuck or self.silent or self._bus.blocks(self))

    def _wait(self) -> None:
        """Read commands of the driver, but no frame.

        The driver writes one frame and waits until it is read. Then only a command can follow.
        """
        time.sleep(WAIT_S)
        size = struct.unpack("i", fcntl.ioctl(self._master, termios.FIONREAD, bytes(4)))[0]
        is_command = 0 < size < SHORTEST_FRAME or 0 < self._unread < size
        self._unread = size
        if not is_command:
            if size and self._bus.blocks(self) and not self._bus.is_jammed:
                self._bus.report_missing_acknowledge(self)
            return
        self._unread = 0
        for command in os.read(self._master, 4096).split(b"\r"):
            if command[:1] in FRAMES:
                if self.keeps:
                    self._kept.append(command)
            else:
                self._do(command)

    def _send_kept(self) -> None:
        self._unread = 0
        if self.is_open:
            for frame in self._kept:
                self._bus.carry(self, frame)
            self._kept = []

    def _do(self, command: bytes) -> None:
        kind = command[:1]
        if kind in FRAMES:
            if self.is_open:
                self._bus.carry(self, command)
            return
        if kind == b"S":
            self.rate = _RATES[int(command[1:])]
        elif kind == b"O":
            self.is_open = True
            self.silent = False
            self.is_stuck_until_restart = False
        elif kind == b"C":
            self.is_open = False

    def close(self) -> None:
        """Unplug the adapter, which removes the interface."""
        self._closed = True
        self._thread.join(2)
        os.close(self._slave)
        os.close(self._master)


class Bus:
    """The wire between adapters."""

    def __init__(self, *names: str) -> None:
        self.adapters = [Adapter(self, name) for name in names]

        self.is_jammed = False
        """Another device fills the bus, so no adapter can send."""

    def blocks(self, source: Adapter) -> bool:
        """Return True if no frame of an adapter can be sent."""
        return self.is_jammed or not self._receivers(source)

    def _receivers(self, source: Adapter) -> list[Adapter]:
        return [
            adapter
            for adapter in self.adapters
            if adapter.is_open
            and adapter.rate == source.rate
            and not adapter.silent
            and adapter is not source
        ]

    def carry(self, source: Adapter, frame: bytes) -> None:
        for adapter in self._receivers(source):
            adapter.tell(frame.decode())

    def report_missing_acknowledge(self, source: Adapter) -> None:
        source.tell_errors("a")
        source.tell_state("p", 0, 128)

    def close(self) -> None:
        for adapter in self.adapters:
            adapter.close()
