"""Does what systemd does for kontronik-can-gw-restart@.path and .service.

It watches the same file as the path unit, and runs the commands of the service.
"""

import subprocess
import threading
import time
from pathlib import Path
from typing import Self

UNITS = Path(__file__).resolve().parents[2] / "kontronik_can_gw" / "systemd"
RUN = Path("/run")
_PERIOD_S = 0.05


def setting(unit: str, key: str, interface: str) -> list[str]:
    """Return the values of a key in a unit of this interface."""
    lines = (UNITS / f"kontronik-can-gw-restart@.{unit}").read_text().splitlines()
    values = [line.partition("=")[2] for line in lines if line.startswith(f"{key}=")]
    return [value.replace("%i", interface) for value in values]


class RestartUnit:
    """The enabled path unit of one interface. ``run`` is used in place of /run."""

    def __init__(self, interface: str, run: Path) -> None:
        (path,) = setting("path", "PathChanged", interface)
        self._file = run / Path(path).relative_to(RUN)
        self._commands = setting("service", "ExecStart", interface)
        self.starts = 0
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="restart unit", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        self._thread.join(10)

    def _run(self) -> None:
        before = self._changed()
        while not self._closed.is_set():
            time.sleep(_PERIOD_S)
            changed = self._changed()
            if changed != before:
                before = changed
                self.starts += 1
                for command in self._commands:
                    # As in systemd, a failing command ends the service.
                    if subprocess.run(command.split(), check=False).returncode:
                        break

    def _changed(self) -> int | None:
        try:
            return self._file.stat().st_mtime_ns
        except OSError:
            return None
