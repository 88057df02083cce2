"""``web`` on a real vcan with a running gateway: losses, restarts and lost interfaces."""

import json
import re
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

import pytest
from bus_watch import TIMEOUT_NS
from harness import PtyPort
from live_bench import wait_until
from raw_bus import RawBus
from report_browser import MISSING, PROGRAM, Browser
from vcan_tools import GatewayProcess, configuration, ip, wait_for

from kontronik_can_gw.times import SECOND

pytestmark = pytest.mark.promise("live-page")

SLOW = ("--js-flags=--jitless",)
"""User Mode Linux has no address space for compiled JavaScript."""
Start = Callable[..., GatewayProcess]


class Heard:
    """Receives the updates of the server, as a further client."""

    def __init__(self, url: str) -> None:
        self.layout: Any = None
        self.updates: list[tuple[float, Any]] = []
        """Times of arrival (monotonic), and the updates."""
        self._answer = urllib.request.urlopen(f"{url}events", timeout=60)
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        event = ""
        for line in self._answer:
            text = line.decode().strip()
            if text.startswith("event: "):
                event = text[7:]
            elif text.startswith("data: ") and event == "layout":
                self.layout = json.loads(text[6:])
            elif text.startswith("data: ") and event == "update":
                self.updates.append((time.monotonic(), json.loads(text[6:])))

    @property
    def last(self) -> Any:
        return self.updates[-1][1] if self.updates else None

    def value(self, source: str, esc: int = 0) -> Any:
        """Return value and age of the newest update."""
        if self.last is None:
            return None
        names = [quantity["source"] for quantity in self.layout["quantities"]]
        return self.last["escs"][esc]["values"][names.index(source)]


@pytest.fixture
def web(vcan: str, tmp_path: Path) -> Iterator[tuple[GatewayProcess, str]]:
    """Yield the process of ``web`` on the interface, and its address."""
    words = ("--listen", "127.0.0.1:0", "--cache", tmp_path / "cache")
    served = GatewayProcess(None, vcan, *words, command="web")
    served.wait_for_line(f"shows {vcan}")
    (url,) = re.findall(r"http://\S+/", served.log)
    yield served, url
    assert served.end() == 0
    assert "Traceback" not in served.log


def test_page_follows_gateway_esc_and_interface(
    vcan: str,
    escs: list[PtyPort],
    start_gateway: Start,
    web: tuple[GatewayProcess, str],
) -> None:
    heard = Heard(web[1])
    wait_for(lambda: heard.last and heard.last["state"][0] == "error", "no gateway")
    gateway = start_gateway(configuration(vcan, escs))
    gateway.wait_for_line("esc1: /")
    escs[0].on = True

    def is_valid() -> bool:
        value = heard.value("battery_voltage")
        return value is not None and value[1] is None and heard.last["escs"][0]["isGood"]

    wait_for(is_valid, lambda: heard.last)
    assert heard.last["state"][0] == "ok"
    escs[0].on = False
    wait_for(lambda: heard.value("battery_voltage")[1] is not None, "the age of an old value")
    wait_for(
        lambda: any("no telemetry" in alarm["text"] for alarm in heard.last["alarms"]),
        lambda: heard.last["alarms"],
    )
    escs[0].on = True
    wait_for(is_valid, "values again")
    assert gateway.end() == 0
    wait_for(lambda: "no gateway heard" in heard.last["state"][1], lambda: heard.last["state"])
    wait_for(lambda: heard.value("battery_voltage")[1] is not None, "the age of an old value")
    gateway = start_gateway(configuration(vcan, escs))
    wait_for(is_valid, "values of the new gateway")
    ip("link", "set", vcan, "down")
    wait_for(lambda: any("is down" in text for _, text in heard.last["notices"]), "the fault")
    assert heard.last["state"] == ["error", "no connection to the CAN bus"]
    ip("link", "set", vcan, "up")
    wait_for(is_valid, "values after the interface is up again")


def test_missing_interface_is_told_at_the_start_and_on_the_page(tmp_path: Path) -> None:
    words = ("--listen", "127.0.0.1:0", "--cache", tmp_path / "cache")
    served = GatewayProcess(None, "nosuch0", *words, command="web")
    served.wait_for_line("shows nosuch0")
    (warning,) = [line for line in served.log.splitlines() if "warning" in line]
    assert "nosuch0" in warning
    assert "does not exist" in warning
    (url,) = re.findall(r"http://\S+/", served.log)
    heard = Heard(url)
    wait_for(lambda: heard.last is not None, "an update")
    assert any("does not exist" in text for _, text in heard.last["notices"])
    assert served.end() == 0


class LastFrame:
    """A context manager that notes the time of the newest frame on an interface."""

    def __init__(self, interface: str) -> None:
        self.at_ns = 0
        """Monotonic time."""
        self._bus = RawBus(interface, (0, 0))
        self._is_stopped = False
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        while not self._is_stopped:
            if self._bus.receive(0.1):
                self.at_ns = time.monotonic_ns()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_stopped = True
        self._thread.join()


@pytest.mark.extended
@pytest.mark.skipif(PROGRAM is None, reason=MISSING)
@pytest.mark.parametrize("lost", ["telemetry", "gateway"])
def test_loss_is_shown_within_half_a_second_of_its_timeout(
    vcan: str,
    escs: list[PtyPort],
    start_gateway: Start,
    web: tuple[GatewayProcess, str],
    tmp_path: Path,
    lost: str,
) -> None:
    """Counts from the ESC's last telemetry frame, or from the gateway's last CAN frame.

    The gateway has a timeout of 250 ms. A receiver waits for a second for a message that is sent
    with telemetry.
    """
    timeout_ns = SECOND if lost == "gateway" else TIMEOUT_NS
    gateway = start_gateway(configuration(vcan, escs, esc=""))
    gateway.wait_for_line("esc1: /")
    escs[0].on = True
    voltage = "document.querySelector('.figure[data-source=battery_voltage]')"
    with LastFrame(vcan) as frame, Browser(tmp_path / "profile", SLOW) as browser:
        browser.open(web[1], ready="!!(globalThis.live && live.updates > 1)")
        is_old = f"{voltage}.classList.contains('old')"
        wait_until(lambda: not browser.run(is_old), "a value", 60)
        browser.run(
            f"""globalThis.changes = [];
            new MutationObserver(() => changes.push([Date.now(), {is_old}]))
              .observe({voltage}, {{ attributes: true }})"""
        )
        wait_until(lambda: browser.run("changes.some(([, old]) => !old)"), "a new value", 60)
        if lost == "gateway":
            gateway.kill()
        else:
            escs[0].on = False
        wait_until(lambda: browser.run("changes.some(([, old]) => old)"), "a grey figure", 60)
        shown_s = browser.run("changes.find(([, old]) => old)[0]") / 1000
        offset_s = time.time() - time.monotonic()
        last_ns = frame.at_ns if lost == "gateway" else escs[0].sent[-1]
        late_s = shown_s - offset_s - (last_ns + timeout_ns) / SECOND
        assert -0.1 < late_s < 0.5
        assert browser.errors == []
