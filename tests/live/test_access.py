"""Which requests the server answers, and that its answers protect the page."""

import re
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from live_bench import FedBus, ServedPage, wait_until
from simulated_bus import flight, layout_of

from kontronik_can_gw.desk.live import server
from kontronik_can_gw.desk.live.access import Address, cache_folder
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.times import SECOND as S

pytestmark = pytest.mark.promise("live-access")

TOKEN = "a-token-of-the-test"


@pytest.fixture(scope="module")
def page() -> Iterator[ServedPage]:
    with ServedPage(FedBus(["esc1"])) as served:
        yield served


@pytest.fixture(scope="module")
def guarded() -> Iterator[ServedPage]:
    with ServedPage(FedBus(["esc1"]), TOKEN) as served:
        yield served


def test_pages_and_files_are_served_with_protecting_headers(page: ServedPage) -> None:
    for path in ("/", "/static/live.js", "/look/plots.js", "/look/vendor/uPlot.iife.min.js"):
        status, headers, body = page.get(path)
        assert status == 200
        assert body
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert headers["referrer-policy"] == "no-referrer"
        assert headers["x-content-type-options"] == "nosniff"
        assert "server" not in headers


def test_no_file_of_the_page_loads_anything_from_elsewhere(page: ServedPage) -> None:
    for path in ("/", "/static/live.js", "/static/live.css", "/look/plots.js"):
        text = page.get(path)[2].decode().replace("http://www.w3.org/2000/svg", "")
        assert "//" not in re.sub(r"(?m)(^|\s)//\s.*$", "", text), path


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "PATCH", "TRACE", "X"])
def test_only_get_and_head_are_allowed(page: ServedPage, method: str) -> None:
    status, headers, _ = page.get("/", method)
    assert status == 405
    assert headers["allow"] == "GET, HEAD"
    assert page.get("/events", "HEAD")[0] == 200


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1:8044", 200),
        ("192.168.4.1", 200),
        ("[::1]:8044", 200),
        ("localhost:1", 200),
        (socket.gethostname().upper(), 200),
        ("evil.example", 421),
        ("127.0.0.1.evil.example:8044", 421),
        ("", 421),
    ],
)
def test_names_in_the_host_header_are_checked(page: ServedPage, host: str, status: int) -> None:
    assert page.get("/", Host=host)[0] == status


def test_paths_outside_of_the_list_are_not_found(page: ServedPage) -> None:
    for path in ("/static/../server.py", "/static/%2e%2e%2fserver.py", "/look/..%2flive", "/etc"):
        status, _, body = page.get(path)
        assert status == 404
        assert b"/" not in body


def test_without_the_token_nothing_is_told(guarded: ServedPage) -> None:
    for path in ("/", "/events", "/static/live.js", "/?token=", "/?token=wrong", "/nowhere"):
        status, headers, body = guarded.get(path)
        assert status == 403
        assert b"web --address" in body
        assert b"esc1" not in body
        assert "set-cookie" not in headers
    wrong = f"kontronik-{guarded.port}=wrong"
    assert guarded.get("/", Cookie=wrong)[0] == 403


def test_token_becomes_a_cookie_and_leaves_the_address(guarded: ServedPage) -> None:
    status, headers, body = guarded.get(f"/?token={TOKEN}")
    assert status == 200
    assert TOKEN.encode() not in body
    cookie = headers["set-cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=strict" in cookie
    assert guarded.get("/", Cookie=cookie.partition(";")[0])[0] == 200


def test_only_the_page_itself_can_reset_the_extremes(page: ServedPage) -> None:
    frames = flight(layout_of(["esc1"]), 5)
    page.source.feed(frames, 5 * S)  # type: ignore[attr-defined]
    track = page.content.monitor.escs[0].tracks["battery_voltage"]
    wait_until(lambda: track.high is not None, "a value")
    assert page.get("/reset")[0] == 403
    assert page.get("/reset", "HEAD", X_Kontronik_Page="1")[0] == 204
    assert track.high is not None
    assert page.get("/reset", X_Kontronik_Page="1")[0] == 204
    wait_until(lambda: track.high is None, "the reset")


def test_too_many_pages_are_refused(page: ServedPage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "_MAX_PAGES", 0)
    assert page.get("/events")[0] == 503


def test_connections_that_are_kept_open_leave_room_for_others(page: ServedPage) -> None:
    kept = []
    for _ in range(server._MAX_CONNECTIONS):
        sock = socket.create_connection(("127.0.0.1", page.port), timeout=20)
        sock.sendall(b"HEAD / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert sock.recv(4096).startswith(b"HTTP/1.1 200")
        kept.append(sock)
    assert page.get("/")[0] == 200
    for sock in kept:
        sock.close()


def test_used_port_is_one_clear_line(page: ServedPage) -> None:
    with pytest.raises(RunError, match=rf"--listen 127.0.0.1:{page.port}: cannot be used"):
        server.listen("127.0.0.1", page.port)


def test_token_stays_and_only_its_owner_may_read_it(tmp_path: Path) -> None:
    folder = cache_folder(tmp_path / "cache")
    first = Address.stored(folder, "0.0.0.0", 8044, False)
    again = Address.stored(folder, "127.0.0.1", 9000, True)
    assert first.token == again.token
    assert len(first.token) >= 20
    assert Address.stored_in(folder) == again
    assert again.urls() == ["http://127.0.0.1:9000/"]
    assert first._replace(host="::1").urls() == [f"http://[::1]:8044/?token={first.token}"]
    (file,) = folder.iterdir()
    assert file.stat().st_mode & 0o777 == 0o600
    file.write_text("damaged")
    assert Address.stored_in(folder) is None
    assert Address.stored(folder, "127.0.0.1", 9000, True).token != first.token


def test_addresses_of_this_machine_are_found_without_netlink(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The service's sandbox permits no netlink."""

    def refused(*_: object) -> None:
        raise OSError(97, "Address family not supported by protocol")

    monkeypatch.setattr(socket, "if_nameindex", refused)
    urls = Address("0.0.0.0", 8044, "", True).urls()
    assert urls
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        try:
            sock.connect(("192.0.2.1", 9))  # sends nothing, but chooses this machine's address
        except OSError:
            return
        assert f"http://{sock.getsockname()[0]}:8044/" in urls


def test_cache_that_cannot_be_used_is_one_clear_line(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(RunError, match=r"file: cannot be used: .*--cache"):
        cache_folder(file)
