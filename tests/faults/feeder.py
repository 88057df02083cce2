"""Simulated ESCs that send frames in real time, and record each frame's time and completeness.

Every field of frame n is computed from n and the ESC by a fixed mixing function. A value on the bus
therefore shows which frames may have carried it. Values that are wrong, old or combined from two
frames are recognised. All values are inside the protocol specification's ranges and differ from the
DBC's codes for "not available" and "error".

The feeder's thread writes the records. Other threads may read them, and may set ``on``, ``write``,
``mangle`` and ``rate_hz``.
"""

import contextlib
import sys
import threading
import time
from array import array
from bisect import bisect_right
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Self

sys.path.append(str(Path(__file__).resolve().parents[1]))

import specification

from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData, device_and_variant
from kontronik_can_gw.esc.kontronik.states import Device

SECOND = 1_000_000_000
SPEED = 1
CURRENT = 2
"""Bits of ``seen``: the messages that are sent after each live frame."""
_MASK = 0xFFFFFFFF
POLE_PAIRS = 7
GEAR = 9.8
PROGRAMMING_ALLOWED = 1 << 17
"""A bit that is set in every recorded idle frame. It is not an alarm."""


class Identity(NamedTuple):
    """The ESC on a line. Each ESC has a different ``salt``, so its values differ."""

    salt: int = 1
    layout: WireLayout = WireLayout.V4
    device: Device = Device.KOSMIK
    cells: int = 6
    alarms: bool = False
    """Set and clear alarm bits. They change every 128 frames."""


def mix(n: int, salt: int) -> int:
    """Return 32 bits that depend on all bits of both arguments."""
    x = (n * 0x9E3779B1 + salt * 0x85EBCA77 + 0x7F4A7C15) & _MASK
    x = ((x ^ x >> 16) * 0x21F0AAAD) & _MASK
    x = ((x ^ x >> 15) * 0x735A2D97) & _MASK
    return x ^ x >> 15


def live(identity: Identity, n: int) -> LiveData:
    """Return live frame n of an ESC."""
    a, b, c, d = (mix(n, identity.salt * 8 + i) for i in range(4))
    errors = PROGRAMMING_ALLOWED
    if identity.alarms and n >> 7 & 1:
        errors |= 1 << (n >> 8) % 12
    return LiveData(
        electrical_speed=10_000 + a % 200_000,
        battery_voltage=2_000 + b % 3_000,
        battery_current=-500 + (b >> 12) % 3_500,
        motor_current=-800 + c % 5_000,
        peak_current=(c >> 13) % 6_000,
        consumed_charge=n % 65_000,
        bec_current=100 + d % 5_000,
        bec_voltage=5_000 + (d >> 13) % 3_400,
        pwm_input=1_000 + (a >> 18) % 1_000,
        throttle=-100 + (a >> 8) % 201,
        output_opening=(b >> 24) % 101,
        power_stage_temperature=-20 + (c >> 3) % 120,
        bec_temperature=-20 + (d >> 5) % 120,
        operating_errors=errors,
        operating_state=18 + (d >> 24) % 9,
        timing=(a >> 4) % 250,
    )


def info(identity: Identity, m: int) -> InfoData:
    """Return info frame m of an ESC."""
    a, b, c = (mix(m, identity.salt * 8 + 4 + i) for i in range(3))
    return InfoData(
        device_and_variant=device_and_variant(identity.device, 100 + identity.salt % 900),
        firmware_word=(identity.salt % 250) << 8 | 14,
        selftest_errors=0,
        cell_count=identity.cells,
        max_electrical_speed=200_000 + a % 50_000,
        min_battery_voltage=1_000 + b % 1_000,
        max_battery_voltage=5_000 + (b >> 12) % 1_000,
        max_battery_current=c % 6_000,
        max_motor_current=(c >> 12) % 6_000,
        max_peak_current=m % 10_000,
        max_bec_current=1 + (a >> 12) % 6_000,
        min_bec_voltage=4_000 + (a >> 16) % 1_000,
        max_throttle=(b >> 20) % 101,
        max_output_opening=(b >> 24) % 101,
        min_power_stage_temperature=-30 + (c >> 20) % 10,
        max_power_stage_temperature=100 + (c >> 24) % 20,
        min_bec_temperature=-30 + (a >> 20) % 10,
        max_bec_temperature=100 + (a >> 24) % 20,
    )


def physical(data: Any, fields: Sequence[specification.Field]) -> dict[str, float]:
    return {field.name: getattr(data, field.name) / field.steps for field in fields}


@lru_cache(1024)
def live_values(identity: Identity, n: int) -> dict[str, float]:
    """Return the physical values of a live frame, and its error bits as "flags".

    The names are the DBC's signal names in snake case.
    """
    data = live(identity, n)
    values = physical(data, specification.LIVE_FIELDS)
    speed = values["electrical_speed"]
    voltage = values["battery_voltage"]
    return {
        **values,
        "flags": data.operating_errors & 0xFFFFFF,
        "operating_state_raw": data.operating_state,
        "motor_speed": speed / POLE_PAIRS,
        "output_speed": speed / POLE_PAIRS / GEAR,
        "mean_cell_voltage": voltage / identity.cells,
        "battery_power": voltage * values["battery_current"],
    }


@lru_cache(1024)
def info_values(identity: Identity, m: int) -> dict[str, float]:
    """Return the physical values of an info frame, and its self-test errors as "flags"."""
    data = info(identity, m)
    return {
        **physical(data, specification.INFO_FIELDS),
        "flags": data.selftest_errors,
        "variant": data.device_and_variant & 1023,
        "firmware_main": data.firmware_word >> 8,
        "firmware_sub": data.firmware_word & 255,
        "device": data.device_and_variant >> 10,
        "device_raw": data.device_and_variant >> 10,
    }


class FedEsc:
    """One ESC: its identity and the frames that it has sent. Subclasses send the bytes.

    ``mangle`` gets the bytes of a frame. It returns the bytes to send, and whether they contain the
    complete frame. The ESC sends ``rate_hz`` frames a second. Every ``info_every``-th frame is an
    info frame.
    """

    path: str
    """The path that the gateway opens."""

    def __init__(
        self,
        identity: Identity,
        rate_hz: float = 50,
        info_every: int = 100,
    ) -> None:
        self.rate_hz = rate_hz
        self.info_every = info_every
        self.on = True
        self.mangle: Callable[[bytes], tuple[bytes, bool]] | None = None
        self.sent = array("q")
        """Monotonic nanoseconds at which live frame n was sent."""
        self.whole = bytearray()
        """1 for each of these frames that was sent completely."""
        self.seen = bytearray()
        """Messages with live frame n that were seen on the bus. The bus watch writes it."""
        self.info_sent = array("q")
        self.identity = identity
        """The ESC on the line. If it is set, the next frame is the new ESC's."""
        self._was: list[Identity] = []
        """The ESC that sent live frame n."""
        self._was_of_info: list[Identity] = []
        self._ticks = 0
        self.due_ns = 0

    def write(self, data: bytes) -> bool:
        """Send bytes on the line. Return False if not all were taken."""
        raise NotImplementedError

    def received(self) -> int:
        """Return the number of bytes that the ESC has received.

        The kernel's echo between plugging in and the gateway's setting of the port is not counted.
        """
        raise NotImplementedError

    def close(self) -> None:
        raise NotImplementedError

    def live(self, n: int) -> LiveData:
        return live(self._was[n], n)

    def values(self, n: int) -> dict[str, float]:
        """Return the physical values of live frame n."""
        return live_values(self._was[n], n)

    def values_of_info(self, m: int) -> dict[str, float]:
        return info_values(self._was_of_info[m], m)

    def newest(self, at_ns: int) -> int:
        """Return the number of the newest live frame sent until this time, or -1."""
        return bisect_right(self.sent, at_ns) - 1

    def newest_info(self, at_ns: int) -> int:
        return bisect_right(self.info_sent, at_ns) - 1

    def send_one(self) -> None:
        """Send the next frame now."""
        self._ticks += 1
        is_info = self._ticks % self.info_every == 3  # the first one is sent soon
        identity = self.identity
        data: InfoData | LiveData
        if is_info:
            data = info(identity, len(self.info_sent))
        else:
            data = live(identity, len(self.sent))
        wire = encode(data, identity.layout)
        whole = True
        if self.mangle is not None:
            wire, whole = self.mangle(wire)
        self.note(time.monotonic_ns(), is_info)
        taken = self.write(wire)
        if not is_info:
            self.whole[-1] = taken and whole

    def note(self, at_ns: int, is_info: bool = False) -> None:
        """Record that a frame is sent at this time.

        ``sent`` is written last, because a reader that finds a frame there reads the other lists.
        """
        if is_info:
            self._was_of_info.append(self.identity)
            self.info_sent.append(at_ns)
        else:
            self._was.append(self.identity)
            self.seen.append(0)
            self.whole.append(0)
            self.sent.append(at_ns)


class Feeder:
    """The thread that sends the frames.

    The distance of frames is at least 0.8 periods, so delayed frames are not sent in a burst.
    """

    def __init__(self, escs: Sequence[FedEsc]) -> None:
        self.escs = list(escs)
        self.error: BaseException | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="feeder", daemon=True)

    def start(self) -> Self:
        now = time.monotonic_ns()
        for number, esc in enumerate(self.escs):
            period = SECOND / esc.rate_hz
            esc.due_ns = now + int(period * number / len(self.escs))
        self._thread.start()
        return self

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                now = time.monotonic_ns()
                for esc in self.escs:
                    if esc.due_ns > now:
                        continue
                    period = int(SECOND / esc.rate_hz)
                    if esc.on:
                        with contextlib.suppress(OSError):
                            esc.send_one()
                    earliest = time.monotonic_ns() + period * 8 // 10
                    esc.due_ns = max(esc.due_ns + period, earliest)
                next_due = min(esc.due_ns for esc in self.escs)
                pause = (next_due - time.monotonic_ns()) / SECOND
                if pause > 0.05:
                    self._stop.wait(pause)
                elif pause > 0:
                    time.sleep(pause)
        except BaseException as error:
            self.error = error
            raise

    def close(self) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(5)
