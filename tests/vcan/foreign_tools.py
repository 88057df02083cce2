"""A CANopen master and a decoder of other projects, run as processes.

tests/foreign/install.sh installs them.
"""

import json
import os
import queue
import shutil
import subprocess
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import pytest
from vcan_tools import LIMIT_S, Recorded

FOREIGN = Path(__file__).resolve().parents[1] / "foreign"
PACKAGES = FOREIGN / ".cache"
NODE_CANOPEN = PACKAGES / "node" / "node_modules" / "canopen"


def need(there: bool, what: str) -> None:
    """Skip a test if its foreign program is not installed."""
    if not there:
        pytest.skip(f"{what} is not installed: run tests/foreign/install.sh")


class Refused(Exception):
    """The node answered with an abort code or an LSS error code, or did not answer."""

    def __init__(self, text: str, code: int | None) -> None:
        super().__init__(text)
        self.code = code


def refusal(
    transfer: Callable[..., object],
    *arguments: object,
    **more: object,
) -> int | None:
    """Return the code of a transfer that must be refused."""
    with pytest.raises(Refused) as refused:
        transfer(*arguments, **more)
    return refused.value.code


class NodeMaster:
    """The JavaScript master on an interface: calls of node_master.js, and its events."""

    def __init__(self, interface: str) -> None:
        command = ["node", str(FOREIGN / "node_master.js"), str(PACKAGES / "node"), interface]
        self.events: list[dict[str, Any]] = []
        self._answers: queue.Queue[dict[str, Any]] = queue.Queue()
        self._ready = threading.Event()
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
        )
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()
        assert self._ready.wait(LIMIT_S), "node_master.js did not start"

    def _read(self) -> None:
        assert self._process.stdout
        for line in self._process.stdout:
            message = json.loads(line)
            if message.get("event") == "ready":
                self._ready.set()
            elif "event" in message:
                self.events.append(message)
            else:
                self._answers.put(message)

    def __call__(self, call: str, **arguments: Any) -> Any:
        """Return the result of a call. Raise Refused if the node refuses it."""
        assert self._process.stdin
        self._process.stdin.write(json.dumps({"call": call, **arguments}) + "\n")
        answer = self._answers.get(timeout=120)
        if "error" in answer:
            raise Refused(answer["error"], answer.get("code"))
        return answer["result"]

    def upload(
        self,
        node: int,
        index: int,
        sub: int = 0,
        block: bool = False,
    ) -> bytes:
        return bytes.fromhex(self("upload", node=node, index=index, sub=sub, block=block))

    def download(
        self,
        node: int,
        index: int,
        sub: int,
        data: bytes,
        block: bool = False,
    ) -> None:
        self(
            "download",
            node=node,
            index=index,
            sub=sub,
            data=data.hex(),
            block=block,
        )

    def of(self, event: str) -> list[dict[str, Any]]:
        """Return the events of one kind so far."""
        return [each for each in list(self.events) if each["event"] == event]

    def states(self, node: int) -> list[int]:
        """Return the NMT states of this node's heartbeats so far, without repetition."""
        return [each["state"] for each in self.of("heartbeat") if each["node"] == node]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin
        assert self._process.stdout
        self._process.stdin.close()
        try:
            self._process.wait(LIMIT_S)
        finally:
            self._process.kill()
        self._thread.join(LIMIT_S)
        self._process.stdout.close()


FIELDS = {
    "can_id": "can.id",
    "function": "canopen.function_code",
    "sdo_command": "canopen.sdo.cmd",
    "sdo_index": "canopen.sdo.main_idx",
    "sdo_sub": "canopen.sdo.sub_idx",
    "sdo_abort": "canopen.sdo.abort_code",
    "emcy_code": "canopen.em.err_code",
    "state": "canopen.nmt_guard.state",
    "nmt_command": "canopen.nmt_ctrl.cd",
    "lss_command": "canopen.lss.cs",
    "pdo": "canopen.pdo.data.bytes",
    "malformed": "_ws.malformed",
}
"""Fields of tshark by our names."""


def tshark(frames: Sequence[Recorded], log: Path) -> list[SimpleNamespace]:
    """Write frames to a log and decode it with tshark.

    Each result has the ``FIELDS`` as tshark prints them. A missing field is empty.
    """
    lines = []
    for at, can_id, data in frames:
        lines.append(f"({at:.6f}) can0 {can_id:03X}#{data.hex().upper()}\n")
    log.write_text("".join(lines))
    command = ["tshark", "-r", str(log), "-d", "can.subdissector,canopen", "-T", "fields"]
    command += ["-E", "separator=/t", "-E", "occurrence=f"]
    for name in FIELDS.values():
        command += ["-e", name]
    # tshark writes its settings to HOME, which may be read-only.
    run = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "HOME": str(log.parent)},
    )
    decoded = []
    for line in run.stdout.splitlines():
        values = dict(zip(FIELDS, line.split("\t"), strict=True))
        decoded.append(SimpleNamespace(**values))
    return decoded


def has_tshark() -> bool:
    return shutil.which("tshark") is not None
