"""systemd runs this script in a booted Debian root (boot_root.sh), with the root's own Python.

It writes facts about the installed gateway to /media/facts.json.
"""

import contextlib
import json
import socket
import struct
import subprocess
import time
from pathlib import Path

VALUES = 0x698
"""Id of EscShaft in the shipped DBC."""
LIMIT_S = 120.0


def run(*words: str) -> str:
    done = subprocess.run(
        words,
        capture_output=True,
        text=True,
        check=False,
        timeout=LIMIT_S,
    )
    return done.stdout + done.stderr


def fresh() -> bool:
    """Return whether a value of the ESC appears on the bus.

    Before that the bytes of its message mean "not available".
    """
    start = time.monotonic()
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as bus:
        bus.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", VALUES, 0x7FF))
        bus.bind(("vcan0",))
        bus.settimeout(0.2)
        while time.monotonic() - start < LIMIT_S:
            with contextlib.suppress(TimeoutError):
                if bus.recv(16)[8:12] != b"\xff" * 4:
                    return True
    return False


def writable(folder: str) -> bool:
    try:
        Path(folder, "x").write_text("x")
    except OSError:
        return False
    return True


def main() -> None:
    facts = {
        "fresh": fresh(),
        "unit": run("systemctl", "show", "-p", "FragmentPath,ActiveState,User", "kontronik-can-gw"),
        "log": run("journalctl", "-u", "kontronik-can-gw", "-o", "cat", "--no-pager"),
        "status": run("kontronik-can-gw", "status", "--json"),
        "doctor": run("kontronik-can-gw", "doctor", "-c", "/etc/kontronik-can-gw/gateway.toml"),
        "writable": [folder for folder in ("/etc", "/usr/lib", "/var/lib") if writable(folder)],
    }
    Path("/media/facts.json").write_text(json.dumps(facts, indent=1))


if __name__ == "__main__":
    main()
