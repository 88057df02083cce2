"""Simulated Lawicel adapters on pseudo terminals, used by the kernel's slcan driver.

They form a CAN bus with bit rates and error states. A frame reaches every adapter that is open at
the same bit rate. Without such an adapter the frame is not acknowledged, and the sender's
controller becomes error passive, as a real one does. The adapters report the state of their
controllers.
"""

import contextlib
import fcntl
import os
import select
import struct
import subprocess
import threading
import time
import tty

_N_SLCAN = 17
_TIOCSETD = 0x5423
_SIOCGIFNAME = 0x8910
_RATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)


class Adapter:
    """One adapter and its interface ``name``. A thread simulates its firmware."""

    def __init__(self, bus: "Bus", name: str) -> None:
        self.name = name
        self.rate: int | None = None
        self.is_open = False
        self.stalled = False
        """The firmware hangs: it neither receives nor sends."""
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
            if self.stalled:
                time.sleep(0.01)
                continue
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

    def _do(self, command: bytes) -> None:
        kind = command[:1]
        if kind and kind in b"tTrR":
            if self.is_open and not self.silent:
                self._bus.carry(self, command)
            return
        if kind == b"S":
            self.rate = _RATES[int(command[1:])]
        elif kind == b"O":
            self.is_open = True
            self.silent = False
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

    def carry(self, source: Adapter, frame: bytes) -> None:
        acknowledged = False
        for adapter in self.adapters:
            hears = adapter.is_open and adapter.rate == source.rate and not adapter.silent
            if hears and adapter is not source:
                acknowledged = True
                if not adapter.stalled:
                    adapter.tell(frame.decode())
        if not acknowledged:
            source.tell_errors("a")
            source.tell_state("p", 0, 128)

    def close(self) -> None:
        for adapter in self.adapters:
            adapter.close()
