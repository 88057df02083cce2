"""A headless Chromium, controlled with the DevTools protocol through a pair of pipes.

So the tests need neither a driver, nor a port, nor a library.
"""

import base64
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

PROGRAM = (
    os.environ.get("CHROMIUM")
    or shutil.which("chromium")
    or shutil.which("chromium-browser")
    or shutil.which("google-chrome")
)
MISSING = "no Chromium: apt-get install chromium, or give its path in the variable CHROMIUM"
OPTIONS = """
    --headless --no-sandbox --disable-gpu --disable-quic --no-first-run
    --disable-background-networking --disable-component-update --disable-sync
    --disable-dev-shm-usage --hide-scrollbars --remote-debugging-pipe
"""
_TIMEOUT_S = 60


class Browser:
    """One page of one browser.

    ``errors`` are exceptions of scripts and errors on the console. ``requests`` are the addresses
    of all files that the page loaded.
    """

    def __init__(self, profile: Path, options: Sequence[str] = ()) -> None:
        assert PROGRAM is not None, MISSING
        to_browser, self._out = os.pipe()
        self._in, from_browser = os.pipe()
        fds = (to_browser, from_browser)
        # the browser reads from 3 and writes to 4
        command = ["bash", "-c", 'exec 8<&"$0" 9>&"$1"; exec "${@:2}" 3<&8 4>&9', *map(str, fds)]
        command += [
            PROGRAM,
            *OPTIONS.split(),
            *options,
            f"--user-data-dir={profile}",
            "about:blank",
        ]
        quiet = subprocess.DEVNULL
        self._process = subprocess.Popen(
            command,
            stdin=quiet,
            stdout=quiet,
            stderr=quiet,
            pass_fds=fds,
        )
        for fd in fds:
            os.close(fd)
        self._number = 0
        self._buffer = b""
        self._session: str | None = None
        self.errors: list[str] = []
        self.requests: list[str] = []
        self._loaded = False
        page = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._out)
        self._process.terminate()
        try:
            self._process.wait(60)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._in)

    def call(self, method: str, **params: object) -> dict[str, Any]:
        """Send a command of the protocol and return its result."""
        self._number += 1
        message: dict[str, object] = {"id": self._number, "method": method, "params": params}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        number = self._number
        while True:
            answer = self._receive()
            if answer.get("id") == number:
                assert "error" not in answer, f"{method}: {answer['error']}"
                result: dict[str, Any] = answer["result"]
                return result

    def _receive(self) -> dict[str, Any]:
        end = time.monotonic() + _TIMEOUT_S
        while b"\0" not in self._buffer:
            left = max(0.0, end - time.monotonic())
            assert select.select([self._in], [], [], left)[0], "the browser does not answer"
            data = os.read(self._in, 1 << 20)
            assert data, "the browser has ended"
            self._buffer += data
        text, _, self._buffer = self._buffer.partition(b"\0")
        message: dict[str, Any] = json.loads(text)
        self._notice(message)
        return message

    def _notice(self, message: dict[str, Any]) -> None:
        params = message.get("params", {})
        match message.get("method"):
            case "Runtime.exceptionThrown":
                self.errors.append(str(params["exceptionDetails"]))
            case "Log.entryAdded" if params["entry"]["level"] == "error":
                self.errors.append(params["entry"]["text"])
            case "Runtime.consoleAPICalled" if params["type"] in ("error", "assert"):
                self.errors.append(str(params["args"]))
            case "Network.requestWillBeSent":
                self.requests.append(params["request"]["url"])
            case "Page.loadEventFired":
                self._loaded = True

    def open(
        self,
        page: Path | str,
        width: int = 1280,
        height: int = 900,
        dark: bool = False,
        phone: bool = False,
        ready: str = "'flight' in window",
    ) -> None:
        """Show a file or an address in a window of this size.

        Waits until it is loaded, the expression ``ready`` is true, and it is drawn.
        """
        size = {"width": width, "height": height, "deviceScaleFactor": 1 + phone, "mobile": phone}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        self.call("Emulation.setTouchEmulationEnabled", enabled=phone)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])
        # Until the page before is gone, it reports errors, such as a server that has ended.
        self._navigate("about:blank")
        self.errors.clear()
        self.requests.clear()
        self._navigate(page if isinstance(page, str) else page.resolve().as_uri())
        while not self.run(ready):
            self.settle()
        self.settle()

    def _navigate(self, address: str) -> None:
        self._loaded = False
        self.call("Page.navigate", url=address)
        while not self._loaded:
            self._receive()

    def settle(self) -> None:
        """Wait until two frames are drawn."""
        frame = "await new Promise(requestAnimationFrame);"
        self.run(f"(async () => {{ {frame} {frame} }})()")

    def run(self, script: str) -> Any:
        """Return the value of an expression. A promise is awaited."""
        found = self.call(
            "Runtime.evaluate",
            expression=script,
            awaitPromise=True,
            returnByValue=True,
        )
        assert "exceptionDetails" not in found, found["exceptionDetails"].get("exception", found)
        return found["result"].get("value")

    def picture(self, file: Path) -> None:
        """Write a picture of the window as PNG."""
        shot = self.call("Page.captureScreenshot", format="png")
        file.write_bytes(base64.b64decode(shot["data"]))

    def mouse(
        self,
        kind: str,
        x: float,
        y: float,
        buttons: int = 0,
    ) -> None:
        """Send an event of the mouse: ``Moved``, ``Pressed`` or ``Released``."""
        event = {"type": f"mouse{kind}", "x": x, "y": y, "buttons": buttons, "clickCount": 1}
        button = "left" if kind != "Moved" else "none"
        self.call("Input.dispatchMouseEvent", **event, button=button)
