"""Reports to systemd by the protocol of sd_notify, and writes priorities for its journal.

No library is used. No call raises or blocks, because a service manager that does not listen must
not disturb the gateway.
"""

import logging
import os
import socket
from collections.abc import Mapping
from typing import TextIO

_MAX_CHARACTERS = 800
"""Maximum length of a status line.

systemd reads 4096 bytes of a datagram, and a character has up to 4 bytes.
"""
_PRIORITIES = {
    logging.CRITICAL: 2,
    logging.ERROR: 3,
    logging.WARNING: 4,
    logging.INFO: 6,
}
"""Priority in syslog by the level of logging. Other levels have priority 7 (debug)."""


class Notifier:
    """The notify socket of the service manager. Only one thread may use it.

    Without a service manager every call does nothing. If the queue of the socket is full, a
    message is sent with the next call. A keep-alive is not sent later, because ``watchdog`` is
    called often.
    """

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        if environment is None:
            environment = os.environ
        self._address = _address(environment.get("NOTIFY_SOCKET", ""))
        self.watchdog_ns: int | None = None
        """Longest interval between calls of ``watchdog``: half of the manager's limit.

        None if the manager does not watch this process.
        """
        if self._address:
            self.watchdog_ns = _watchdog_ns(environment)
        self._socket: socket.socket | None = None
        self._pending: dict[str, str] = {}
        self._status = ""

    @property
    def is_present(self) -> bool:
        """True if there is a service manager."""
        return bool(self._address)

    def ready(self, status: str = "") -> None:
        """Report that the gateway has started."""
        self._send({"READY": "1"} | self._news(status))

    def status(self, text: str) -> None:
        """Send a status line, if it has changed."""
        news = self._news(text)
        if news:
            self._send(news)

    def stopping(self, status: str = "") -> None:
        """Report that the gateway is about to end."""
        self._pending.pop("READY", None)
        self._send({"STOPPING": "1"} | self._news(status))

    def watchdog(self) -> None:
        """Send a keep-alive, if the manager watches this process."""
        if self.watchdog_ns is not None:
            self._send({"WATCHDOG": "1"})
            self._pending.pop("WATCHDOG", None)

    def close(self) -> None:
        """Close the socket. A later call opens it again."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _news(self, text: str) -> dict[str, str]:
        """Return the variable for the status line, or nothing if the line has not changed.

        The line contains no line break, because the manager would read another variable after it.
        """
        printable = "".join(each if each.isprintable() else " " for each in text)
        line = " ".join(printable.split())[:_MAX_CHARACTERS]
        if not line or line == self._status:
            return {}
        self._status = line
        return {"STATUS": line}

    def _send(self, variables: dict[str, str]) -> None:
        if not self._address:
            return
        self._pending |= variables
        lines = [f"{name}={value}\n" for name, value in self._pending.items()]
        message = "".join(lines).encode(errors="replace")
        try:
            if self._socket is None:
                kind = socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC
                self._socket = socket.socket(socket.AF_UNIX, kind)
            self._socket.sendto(message, self._address)
        except (OSError, ValueError):  # queue full, or no listener: the next call sends it
            return
        self._pending.clear()


def _address(name: str) -> str:
    """Return the address of a socket in the file system or, with @, in the abstract namespace.

    Empty for other names.
    """
    if name.startswith("@"):
        return "\0" + name[1:]
    if name.startswith("/"):
        return name
    return ""


def _watchdog_ns(environment: Mapping[str, str]) -> int | None:
    """Return half of the manager's time limit for this process, or None without a limit."""
    try:
        limit_us = int(environment.get("WATCHDOG_USEC", "0"))
        pid = int(environment.get("WATCHDOG_PID") or os.getpid())
    except ValueError:
        return None
    if pid != os.getpid() or limit_us <= 0:
        return None
    limit_ns = limit_us * 1000
    return limit_ns // 2


def is_journal(stream: TextIO, environment: Mapping[str, str] | None = None) -> bool:
    """Return True if the stream leads to the journal, and is not redirected to a file or pipe."""
    if environment is None:
        environment = os.environ
    journal = environment.get("JOURNAL_STREAM", "")
    try:
        status = os.fstat(stream.fileno())
    except (OSError, ValueError):  # the stream is closed, or has no descriptor
        return False
    return journal == f"{status.st_dev}:{status.st_ino}"


def log_formatter(stream: TextIO) -> logging.Formatter | None:
    """Return the formatter for a stream to the journal, or None for any other stream.

    It writes a priority, but no time, because the journal adds the time.
    """
    if not is_journal(stream):
        return None
    return JournalFormatter("%(message)s")


class JournalFormatter(logging.Formatter):
    """Writes the priority before each line, for example ``<3>`` for an error.

    The journal makes an entry of each line.
    """

    def format(self, record: logging.LogRecord) -> str:
        priority = _PRIORITIES.get(record.levelno, 7)
        lines = super().format(record).split("\n")
        return "\n".join(f"<{priority}>{line}" for line in lines)
