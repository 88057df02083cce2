"""What is reported to systemd and its journal: sd_notify's protocol and the priorities of log lines, without a library.

Nothing here raises and nothing blocks: a supervisor that does not listen must not disturb the gateway.
"""

import logging
import os
import socket
from collections.abc import Mapping
from typing import TextIO

_MAX_CHARACTERS = 800
"""Of a status line: systemd reads 4096 bytes of a datagram, and a character has up to 4."""
_PRIORITIES = {logging.CRITICAL: 2, logging.ERROR: 3, logging.WARNING: 4, logging.INFO: 6}
"""Syslog's, by logging's level; anything else is for debugging, 7."""


class Notifier:
    """The notify socket of the service manager; one thread uses it. Where there is none every call does nothing.

    What the socket does not take now (its queue is full) goes with the next call, but for the sign of life: ``watchdog`` is called often.
    """

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        environment = os.environ if environment is None else environment
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = {"@": "\0" + address[1:], "/": address}.get(address[:1], "")
        self.watchdog_ns = _watchdog_ns(environment) if self._address else None
        """How often ``watchdog`` is to be called at the latest: half of what the manager allows. None: it does not watch this process."""
        self._socket: socket.socket | None = None
        self._pending: dict[str, str] = {}
        self._status = ""

    @property
    def present(self) -> bool:
        """True where a service manager listens."""
        return bool(self._address)

    def ready(self, status: str = "") -> None:
        """The gateway has started."""
        self._send({"READY": "1"} | self._news(status))

    def status(self, text: str) -> None:
        """Send a line for people, if it is another one than before."""
        if news := self._news(text):
            self._send(news)

    def stopping(self, status: str = "") -> None:
        """About to end."""
        self._pending.pop("READY", None)
        self._send({"STOPPING": "1"} | self._news(status))

    def watchdog(self) -> None:
        """Send a sign of life; nothing where nobody watches."""
        if self.watchdog_ns is not None:
            self._send({"WATCHDOG": "1"})
            self._pending.pop("WATCHDOG", None)

    def close(self) -> None:
        """Give the socket back; a later call opens it again."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _news(self, text: str) -> dict[str, str]:
        """The line, if it is new. It can hold nothing that would be read as a message of its own."""
        line = " ".join("".join(c if c.isprintable() else " " for c in text).split())[
            :_MAX_CHARACTERS
        ]
        if not line or line == self._status:
            return {}
        self._status = line
        return {"STATUS": line}

    def _send(self, what: dict[str, str]) -> None:
        if not self._address:
            return
        self._pending |= what
        message = "".join(f"{name}={value}\n" for name, value in self._pending.items())
        try:
            if self._socket is None:
                self._socket = socket.socket(
                    socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC
                )
            self._socket.sendto(message.encode(errors="replace"), self._address)
        except (OSError, ValueError):  # full, or nobody there: it goes with the next call
            return
        self._pending.clear()


def _watchdog_ns(environment: Mapping[str, str]) -> int | None:
    """Half of the time that the manager waits for this process, None where it does not."""
    try:
        microseconds = int(environment.get("WATCHDOG_USEC", "0"))
        meant = int(environment.get("WATCHDOG_PID") or os.getpid()) == os.getpid()
    except ValueError:
        return None
    return microseconds * 500 if meant and microseconds > 0 else None


def is_journal(stream: TextIO, environment: Mapping[str, str] | None = None) -> bool:
    """True where what is written to the stream goes to the journal itself, and not to a file or pipe that took its place."""
    named = (os.environ if environment is None else environment).get("JOURNAL_STREAM", "")
    try:
        status = os.fstat(stream.fileno())
    except (OSError, ValueError):  # closed, or none that has a descriptor
        return False
    return named == f"{status.st_dev}:{status.st_ino}"


def log_formatter(stream: TextIO) -> logging.Formatter | None:
    """Make the formatter for a stream to the journal: no time, which the journal has itself, and a priority. None for any other."""
    return JournalFormatter("%(message)s") if is_journal(stream) else None


class JournalFormatter(logging.Formatter):
    """Each line begins with its priority, ``<3>`` for an error: the journal takes each as an entry of its own."""

    def format(self, record: logging.LogRecord) -> str:
        mark = f"<{_PRIORITIES.get(record.levelno, 7)}>"
        return "\n".join(mark + line for line in super().format(record).split("\n"))
