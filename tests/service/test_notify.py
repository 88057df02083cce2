"""Notifications of the gateway to systemd, read from a socket, and its log lines in the journal."""

import logging
import os
import secrets
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from kontronik_can_gw.runtime.system.sd_notify import Notifier, is_journal, log_formatter

pytestmark = pytest.mark.promise("watchdog")


class Manager:
    """The socket at systemd's end."""

    def __init__(self, address: str) -> None:
        self.environment = {"NOTIFY_SOCKET": address}
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self.socket.bind("\0" + address[1:] if address.startswith("@") else address)

    def told(self) -> list[list[str]]:
        """Return the messages since the last call, each as a list of lines."""
        found = []
        while True:
            try:
                found.append(self.socket.recv(65536).decode().splitlines())
            except BlockingIOError:
                return found


WATCHED = {"WATCHDOG_USEC": "10000000"}


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Manager]:
    abstract = f"@kcg-test-{secrets.token_hex(8)}"
    found = Manager(str(tmp_path / "notify") if request.param == "path" else abstract)
    with found.socket:
        yield found


def test_ready_status_watchdog_and_end_are_notified(manager: Manager) -> None:
    notifier = Notifier(manager.environment | WATCHED | {"WATCHDOG_PID": str(os.getpid())})
    notifier.ready("two ESCs")
    notifier.status("one ESC")
    notifier.watchdog()
    notifier.stopping("going")
    notifier.close()
    assert manager.told() == [
        ["READY=1", "STATUS=two ESCs"],
        ["STATUS=one ESC"],
        ["WATCHDOG=1"],
        ["STOPPING=1", "STATUS=going"],
    ]


@pytest.mark.parametrize(
    ("texts", "told"),
    [
        (("a", "a", "b", "b", "a", "a ", ""), ["a", "b", "a"]),
        (("bus-off\nSTOPPING=1\r\0\x85\u2028MAINPID=1\udcff",), ["bus-off STOPPING=1 MAINPID=1"]),
        (("😀" * 5000,), ["😀" * 750]),
    ],
)
def test_status_is_one_line_that_is_notified_when_it_changes(
    manager: Manager,
    texts: tuple[str, ...],
    told: list[str],
) -> None:
    notifier = Notifier(manager.environment)
    for text in texts:
        notifier.status(text)
    found = [line for lines in manager.told() for line in lines]
    for line, text in zip(found, told, strict=True):
        assert line.startswith(f"STATUS={text}")
    assert all(len(line.encode()) <= 4096 for line in found)


@pytest.mark.parametrize(
    "address",
    ["", "vsock:2:1", "@", "/no/such/folder/notify", "/" + "x" * 300, "/with\0null"],
)
def test_unusable_socket_does_no_harm(address: str) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "1000"})
    for _ in range(3):
        notifier.ready("x")
        notifier.watchdog()
        notifier.stopping()
    notifier.close()
    assert notifier.is_present == (address[:1] in ("/", "@"))
    assert Notifier({"WATCHDOG_USEC": "1000"}).watchdog_ns is None


def test_full_socket_never_blocks_and_loses_no_state(manager: Manager) -> None:
    notifier = Notifier(manager.environment | WATCHED)
    for _ in range(5000):  # more than the capacity of any queue
        notifier.watchdog()
    notifier.ready("up")
    notifier.status("lost")
    earlier = manager.told()
    assert len(earlier) < 5000
    assert ["READY=1", "STATUS=up"] not in earlier
    notifier.watchdog()
    assert manager.told() == [["READY=1", "STATUS=lost", "WATCHDOG=1"]]
    notifier.watchdog()
    assert manager.told() == [["WATCHDOG=1"]]
    for _ in range(5000):
        notifier.watchdog()
    notifier.ready()
    notifier.stopping()  # after which "ready" is no longer true
    manager.told()
    notifier.stopping()
    assert manager.told() == [["STOPPING=1"]]


def test_manager_that_returns_is_notified_again(tmp_path: Path) -> None:
    path = tmp_path / "notify"
    notifier = Notifier({"NOTIFY_SOCKET": str(path)})
    for text in ("one", "three"):
        manager = Manager(str(path))
        with manager.socket:
            notifier.status(text)
            assert manager.told() == [[f"STATUS={text}"]]
        path.unlink()
        notifier.status(f"{text}, to nobody")
    notifier.close()


@pytest.mark.parametrize(
    ("variables", "half"),
    [
        ({"WATCHDOG_USEC": "10000000"}, 5_000_000_000),
        ({"WATCHDOG_USEC": "3", "WATCHDOG_PID": str(os.getpid())}, 1_500),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": "1"}, None),
        *(({"WATCHDOG_USEC": text}, None) for text in ("0", "-5", "soon")),
        ({"WATCHDOG_USEC": "5", "WATCHDOG_PID": "me"}, None),
    ],
)
def test_watchdog_is_used_only_by_the_named_process(
    variables: dict[str, str],
    half: int | None,
) -> None:
    assert Notifier({"NOTIFY_SOCKET": "/none"} | variables).watchdog_ns == half


# --- the log


def test_each_line_has_its_priority_if_the_journal_reads_it(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    with (tmp_path / "log").open("w") as stream:
        status = os.fstat(stream.fileno())
        named = f"{status.st_dev}:{status.st_ino}"
        for value in (f"{named}1", "rubbish", ""):
            assert not is_journal(stream, {"JOURNAL_STREAM": value})
        monkeypatch.setenv("JOURNAL_STREAM", named)
        formatter = log_formatter(stream)
    assert not is_journal(stream, {"JOURNAL_STREAM": named}), "a closed one"
    assert formatter is not None
    lost = logging.LogRecord(
        "x",
        logging.ERROR,
        __file__,
        1,
        "lost\nfor good",
        (),
        None,
    )
    assert formatter.format(lost) == "<3>lost\n<3>for good"
