"""``replay``: plays a recording on a CAN bus or on pseudo terminals."""

import argparse
import time
from dataclasses import replace
from pathlib import Path
from threading import Event

from kontronik_can_gw.capture.format import EntryKind
from kontronik_can_gw.cli.arguments import LAYOUT, number_from, option
from kontronik_can_gw.cli.common import say, stopping_on_signals
from kontronik_can_gw.cli.desk import given_layout, reading, terminals
from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.desk.recordings.inputs import Input
from kontronik_can_gw.desk.recordings.played import PlayedInput
from kontronik_can_gw.desk.recordings.stream import name_of
from kontronik_can_gw.desk.sources import can_config
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.transmit_queue import Sent
from kontronik_can_gw.runtime.can.can_port import CanPort
from kontronik_can_gw.runtime.can.open_can import check_interface, open_can
from kontronik_can_gw.runtime.system.locks import Locks, in_use, names_of
from kontronik_can_gw.times import SECOND

_DRAIN_S = 0.2
"""Time for a gateway to read the last bytes before the terminals are closed."""
_BUSY_S = 0.0005
"""Pause before a frame is sent again while the queue is full."""
_MAX_BUSY_S = 5
"""Longest time for which the queue may stay full."""


def _speed(text: str) -> float | None:
    if text == "max":
        return None
    return number_from(0.01, 1000, "factor (or max)")(text)


OPTIONS = (
    option("FILE", "the recording, or - for standard input", type=Path),
    option(
        "--on",
        "target: a CAN bus, or a pseudo terminal for each ESC",
        choices=("can", "pty"),
        required=True,
    ),
    LAYOUT,
    option(
        "--speed FACTOR",
        "speed relative to real time, 0.01 to 1000, or max for the greatest (default 1)",
        type=_speed,
        default=1.0,
    ),
    option("--interface NAME", "--on can: python-can interface (default socketcan)"),
    option(
        "--channel NAME",
        "--on can: channel of the interface, for example vcan0 (default: can.channel of -c)",
    ),
    option("--unmarked", "--on can: do not mark the frames as replay"),
    option(
        "--link PATH",
        "--on pty: symbolic link to the terminal; {n} is the number of the ESC, from 1",
    ),
    option(
        "--delay S",
        "--on pty: seconds for a gateway to open the terminals (default 1)",
        type=number_from(0, 3600),
        default=1.0,
    ),
)
_ONLY_FOR = {"can": ("interface", "channel", "unmarked"), "pty": ("link",)}
EPILOG = """\
FILE is a capture (.kcap; a folder or a common prefix of file names stands for
all parts of one run) or a file of plain UART bytes. A capture is replayed
through the gateway's core with the recorded clock, so frames and times equal
the live run bit for bit.

--on can  sends the frames on a CAN bus. Their GatewayState is set to Replay,
          because the values are old. With --unmarked they are sent exactly as
          recorded. It is refused while a gateway on this machine sends the
          same messages. Frames that the gateway received are not sent. To send
          a CAN log, use canplayer of can-utils.
--on pty  plays the bytes of each ESC on a separate pseudo terminal, for a
          gateway to read, and prints its name: "esc1 /dev/pts/5".

To write the frames to a log, use kontronik-can-gw convert FILE flight.log.

examples:
  kontronik-can-gw replay flight.kcap --on can --channel vcan0
  kontronik-can-gw replay flight.kcap --on pty --link /tmp/esc{n} --speed 4

exit codes: 0 done; 1 failed while running; 2 wrong usage, or FILE cannot
be opened or is not a recording
"""


class Pace:
    """The relation of recorded time and real time.

    ``speed`` is the number of recorded seconds in a real second. None: as fast as possible.
    """

    def __init__(self, speed: float | None) -> None:
        self.speed = speed
        self.latest_ns = 0
        """Greatest delay so far."""
        self.stopped = Event()
        self._origin: tuple[int, int] | None = None
        """Real time and recorded time of the first call of ``wait``."""

    def wait(self, time_ns: int) -> bool:
        """Pause until a recorded time is due. The first call does not pause.

        Returns False if the replay was stopped.
        """
        if self.speed is not None:
            now = time.monotonic_ns()
            if self._origin is None:
                self._origin = (now, time_ns)
            begin_ns, first_ns = self._origin
            due_ns = begin_ns + int((time_ns - first_ns) / self.speed)
            late_ns = now - due_ns
            if late_ns < 0:
                self.stopped.wait(-late_ns / SECOND)
                late_ns += time.monotonic_ns() - now
            self.latest_ns = max(self.latest_ns, late_ns)
        return not self.stopped.is_set()


def main(args: argparse.Namespace) -> int:
    """Replay args.file."""
    for place, names in _ONLY_FOR.items():
        given = [name for name in names if getattr(args, name)]
        if place != args.on and given:
            raise UserError(f"--{given[0]}: is for --on {place}. Leave it out.")
    pace = Pace(args.speed)
    with reading(args.file, given_layout(args)) as recording:
        _play(args, recording, pace)
    return 0


def _play(args: argparse.Namespace, recording: Input, pace: Pace) -> None:
    """Play a recording to its end or until a signal. Raises UserError for a log of CAN frames."""

    def stop() -> None:
        pace.stopped.set()
        if recording.stream is not None:
            recording.stream.end()

    with stopping_on_signals(stop):
        if not isinstance(recording, PlayedInput):
            raise UserError(
                f"{name_of(args.file)}: is a log of CAN frames, which has no bytes of ESCs. "
                "To send a candump log, type canplayer -I FILE (of can-utils). "
                "kontronik-can-gw convert makes a candump log of any other log."
            )
        play = {"can": _on_can, "pty": _on_pty}[args.on]
        text = play(args, recording, pace)
        if "times" in recording.provenance:
            text += f"; times are {recording.provenance['times']}"
        if pace.stopped.is_set():
            text += ", stopped"
        say(text)
        for line in recording.damage:
            say(f"warning: {line}")


def _on_can(args: argparse.Namespace, recording: PlayedInput, pace: Pace) -> str:
    can = _bus(args, recording, fd=any(plan.fd for plan in recording.sent_layout.messages))
    check_interface(can)
    locks = Locks()
    if can.interface != "virtual":
        _hold(locks, can.channel, recording)
    port = open_can(can)
    count = 0
    recording.is_marked = not args.unmarked
    try:
        for time_ns, frame, received in recording.frames():
            if received:
                continue
            if not pace.wait(time_ns):
                break
            _send(
                port,
                frame,
                can.channel,
                pace,
            )
            count += 1
    finally:
        port.close()
        locks.close()
    late = f", at most {pace.latest_ns / 1e6:.1f} ms late" if pace.speed else ""
    return f"{count} frames to {can.channel}{late}"


def _bus(args: argparse.Namespace, recording: PlayedInput, fd: bool) -> CanConfig:
    """Return the interface of the options or the configuration.

    Raises UserError if there is none.
    """
    if args.config and recording.bus.config:
        return replace(can_config(recording.bus, args.interface, args.channel), fd=fd)
    if args.channel is None:
        raise UserError(
            "--on can: no interface. Give --channel, for example vcan0, or a configuration (-c)."
        )
    return CanConfig(args.interface or "socketcan", args.channel, fd=fd)


def _hold(locks: Locks, channel: str, recording: PlayedInput) -> None:
    """Lock the messages and nodes, so that no gateway can send the same ones.

    Raises RunError if a gateway sends them already.
    """
    gateway = recording.setup.gateway(recording.sent_layout, recording.created_ns)
    for taken in locks.lock_only(names_of(gateway, channel)):
        raise in_use(taken)


def _send(port: CanPort, frame: CanFrame, channel: str, pace: Pace) -> None:
    """Send one frame. Wait while the queue is full.

    Raises RunError if the bus accepts no frames for ``_MAX_BUSY_S``, or the interface is down.
    """
    since = time.monotonic()
    while (answer := port.send(frame)) is not Sent.OK:
        if answer in (Sent.DOWN, Sent.GONE):
            raise RunError(f"CAN {channel}: is down or was removed.")
        if pace.stopped.is_set():
            return
        if time.monotonic() - since > _MAX_BUSY_S:
            raise RunError(
                f"CAN {channel}: no frame could be sent for {_MAX_BUSY_S} s. "
                "No other node acknowledges, or the bus is full."
            )
        time.sleep(_BUSY_S)


def _on_pty(args: argparse.Namespace, recording: PlayedInput, pace: Pace) -> str:
    names = [esc.name for esc in recording.setup.escs]
    total = 0
    with terminals(names, args.link) as opened:
        pace.stopped.wait(args.delay)
        for entry in recording.entries():
            if entry.kind != EntryKind.BYTES:
                continue
            if not pace.wait(entry.time_ns):
                break
            if entry.esc < len(opened):
                opened[entry.esc].write(entry.data)
                total += len(entry.data)
        pace.stopped.wait(_DRAIN_S)
        for terminal in opened:
            terminal.check()
    received = [name for name, each in zip(names, opened, strict=True) if each.received]
    if received:
        raise RunError(
            f"{', '.join(received)}: the gateway transmits to the ESC, "
            "which could take it for a command"
        )
    dropped = sum(terminal.dropped_bytes for terminal in opened)
    lost = f", {dropped} of them dropped (not read)" if dropped else ""
    return f"{total} bytes to {len(names)} pseudo terminals{lost}"
