"""The gateway at work on a pseudo terminal and python-can's in-process bus."""

import os
import termios
import threading
import time
from typing import Any

import can
import pytest

from kontronik_can_gw.config.assemble import assemble
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.esc.kontronik import Layout, LiveData, encode
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.runtime.loop import Loop


def live(speed: int) -> bytes:
    return encode(LiveData(electrical_speed=speed, battery_voltage=2442), Layout.V4)


def test_a_terminal_that_echoes_gets_no_echo_from_the_gateway() -> None:
    master, slave = os.openpty()  # fresh: echo on, lines, translations
    os.set_blocking(master, False)
    assert termios.tcgetattr(slave)[3] & termios.ECHO
    settings = {"interface": "virtual", "channel": f"echo-{os.getpid()}"}
    loaded = assemble(parse({"can": settings, "esc": [{"port": os.ttyname(slave)}]}, "echo.toml"))
    database = loaded.database
    assert database is not None

    def wait_for(speed: int) -> None:
        for message in iter(lambda: bus.recv(60), None):
            known = database.get_message_by_frame_id(message.arbitration_id)
            signals: Any = known.decode_simple(bytes(message.data), decode_choices=False)
            if signals.get("ElectricalSpeed") == speed:
                return
        raise AssertionError(f"no speed {speed}")

    gateway = Gateway(loaded.escs, loaded.layout, time.monotonic_ns())
    loop = Loop(gateway, [os.ttyname(slave)], loaded.config.can, False)
    thread = threading.Thread(target=loop.run)
    with can.Bus(interface="virtual", channel=settings["channel"]) as bus:
        loop.open()
        thread.start()
        try:
            modes = termios.tcgetattr(slave)
            assert not modes[3] & (termios.ECHO | termios.ECHONL | termios.ICANON | termios.ISIG)
            assert not modes[1] & termios.OPOST
            for speed in (1, 0x0A0D03, 0x1A1104):  # with the bytes of CR, LF, ^C, ^Z, ^Q, ^D
                os.write(master, live(speed))
                wait_for(speed)
            # what an ESC sends at power-up, to see whether someone answers
            os.write(master, b"+++AT\rATSN?\r\n" + live(12_345))
            wait_for(12_345)
            with pytest.raises(BlockingIOError):
                os.read(master, 1)
        finally:
            loop.stop()
            thread.join(60)
            loop.stop()  # of one that has ended: nothing happens
    os.close(slave)
    os.close(master)
