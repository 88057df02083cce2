"""The command line of ``web``: its addresses, and one clear line for each mistake."""

import re
import socket
from pathlib import Path

import pytest
from command_line import refused, run
from harness import LoggedProcess
from live_bench import wait_until
from simulated_bus import flight, layout_of, write_log
from vcan_tools import PROGRAM

from kontronik_can_gw.desk.live.access import Address, cache_folder

pytestmark = pytest.mark.promise("live-access")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("logs") / "bus.log", flight(layout_of(["esc1"]), 2))


def test_address_and_its_code_are_printed_again(tmp_path: Path) -> None:
    said = refused(1, "web", "--address", "--cache", tmp_path)
    assert said == "no page was served yet. Start it: kontronik-can-gw web"
    address = Address.stored(cache_folder(tmp_path), "192.168.4.1", 8044, False)
    done = run("web", "--address", "--cache", tmp_path)
    url, *code = done.out.splitlines()
    assert url == f"http://192.168.4.1:8044/?token={address.token}"
    assert len(code) > 15
    assert len({len(line) for line in code}) == 1
    assert set("".join(code)) <= set(" █▀▄")
    Address.stored(cache_folder(tmp_path), "127.0.0.1", 8044, True)
    assert run("web", "--address", "--cache", tmp_path).out == "http://127.0.0.1:8044/\n"


def test_mistakes_are_one_clear_line(tmp_path: Path, log: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        said = refused(1, "web", log, "--listen", f"127.0.0.1:{port}", "--cache", tmp_path)
    assert said.startswith(f"--listen 127.0.0.1:{port}: cannot be used: Address already in use")
    assert "does not exist" in refused(2, "web", tmp_path / "missing.log")
    file = tmp_path / "file"
    file.write_text("")
    said = refused(1, "web", log, "--listen", "127.0.0.1:0", "--cache", file)
    assert "Give another --cache." in said
    for text in ("8044", "example.org:80", "127.0.0.1:99999"):
        assert "is not an address and port" in run("web", "--listen", text).err


def test_captures_that_cannot_be_read_are_told_at_the_start(tmp_path: Path, log: Path) -> None:
    words = ["web", str(log), "--listen", "127.0.0.1:0", "--cache", str(tmp_path)]
    words += ["--captures", str(tmp_path / "nowhere")]
    served = LoggedProcess([*map(str, PROGRAM), *words])
    wait_until(lambda: "nowhere" in served.log, "the warning")
    served.process.terminate()
    assert served.wait() == 0
    (warning,) = [line for line in served.log.splitlines() if "warning" in line]
    assert warning.endswith("/nowhere: cannot be read: No such file or directory.")


@pytest.mark.parametrize("options", [(), ("--no-token",)])
def test_log_never_contains_the_token(tmp_path: Path, log: Path, options: tuple[str, ...]) -> None:
    """The token is printed on a terminal only, because others can read the journal."""
    words = ["web", str(log), "--listen", "0.0.0.0:0", "--cache", str(tmp_path), *options]
    served = LoggedProcess([*map(str, PROGRAM), *words])
    wait_until(lambda: "token" in served.log, "the last line")
    stored = Address.stored_in(tmp_path)
    assert stored is not None
    assert stored.is_open == bool(options)
    assert re.search(r"http://[\d.]+:\d+/ shows bus.log", served.log)
    assert stored.token not in served.log
    assert ("warning: --no-token: everybody" in served.log) == bool(options)
    served.process.terminate()
    assert served.wait() == 0
