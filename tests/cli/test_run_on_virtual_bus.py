"""The gateway at work on pseudo terminals and python-can's in-process bus."""

import os
import termios
import threading
import time
from collections.abc import Iterator
from typing import Any, Self

import can
import pytest

from kontronik_can_gw.config.assemble import assemble
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.desk.pty import PtyEsc
from kontronik_can_gw.esc.kontronik import Layout, LiveData, encode
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.runtime.loop import Loop

LIVE = LiveData(
    electrical_speed=12_345, battery_voltage=2442, battery_current=-17, operating_state=21
)


class Bench:
    """A gateway's loop in a thread, and a participant of its bus that knows the DBC."""

    def __init__(self, port: str) -> None:
        channel = f"bench-{os.getpid()}-{id(self)}"
        tables = {
            "can": {"interface": "virtual", "channel": channel},
            "esc": [{"port": port, "pole_pairs": 7}],
        }
        loaded = assemble(parse(tables, "bench.toml"))
        assert loaded.database is not None
        self.database = loaded.database
        self.bus = can.Bus(interface="virtual", channel=channel)
        self.gateway = Gateway(loaded.escs, loaded.layout, time.monotonic_ns())
        self.loop = Loop(self.gateway, [port], loaded.config.can, False)
        self._thread = threading.Thread(target=self.loop.run)

    def __enter__(self) -> Self:
        self.loop.open()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self.bus.shutdown()

    def speed(self, wanted: int, seconds: float = 60) -> None:
        """Wait for a speed on the bus."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            if (message := self.bus.recv(left)) is not None:
                known = self.database.get_message_by_frame_id(message.arbitration_id)
                signals: Any = known.decode_simple(bytes(message.data), decode_choices=False)
                if signals.get("ElectricalSpeed") == wanted:
                    return
        raise AssertionError(f"speed {wanted}: not within {seconds} s")

    def stop(self) -> None:
        self.loop.stop()
        self._thread.join(60)
        assert not self._thread.is_alive()


@pytest.fixture
def esc() -> Iterator[PtyEsc]:
    with PtyEsc() as made:
        yield made
        made.check()
        assert made.received == 0, f"the gateway wrote to the ESC: {made.first_received!r}"


# --- end to end


def test_a_terminal_that_echoes_gets_no_echo_from_the_gateway() -> None:
    master, slave = os.openpty()  # fresh: echo on, lines, translations
    try:
        os.set_blocking(master, False)
        assert termios.tcgetattr(slave)[3] & termios.ECHO
        with Bench(os.ttyname(slave)) as running:
            modes = termios.tcgetattr(slave)
            assert not modes[3] & (termios.ECHO | termios.ECHONL | termios.ICANON | termios.ISIG)
            assert not modes[1] & termios.OPOST
            for speed in (1, 0x0A0D03, 0x1A1104):  # with the bytes of CR, LF, ^C, ^Z, ^Q, ^D
                os.write(master, encode(LIVE._replace(electrical_speed=speed), Layout.V4))
                running.speed(speed)
            # what an ESC sends at power-up, to see whether someone answers
            os.write(master, b"+++AT\rATSN?\r\n")
            os.write(master, encode(LIVE, Layout.V4))
            running.speed(12_345)
            with pytest.raises(BlockingIOError):
                os.read(master, 1)
    finally:
        os.close(slave)
        os.close(master)


def test_stopping_a_loop_that_has_ended_writes_to_nobody(esc: PtyEsc) -> None:
    with Bench(esc.path) as running:
        running.stop()
        read, write = os.pipe2(os.O_NONBLOCK)  # likely the numbers that the loop's own pipe had
        more = [os.pipe2(os.O_NONBLOCK) for _ in range(8)]
        running.loop.stop()
        for reader, writer in [(read, write), *more]:
            with pytest.raises(BlockingIOError):
                os.read(reader, 1)
            os.close(reader)
            os.close(writer)
