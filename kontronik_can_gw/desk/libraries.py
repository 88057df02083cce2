"""Libraries that only some commands need, and how to install them for the Python that runs.

The package is on no index, so its extras can be named only inside a clone of the sources.
"""

import sys
import sysconfig
from pathlib import Path

from kontronik_can_gw.errors import RunError

EXTRAS = {
    "mf4": "asammdf>=8",
    "parquet": "pyarrow>=15",
    "mqtt": "paho-mqtt>=2",
    "metrics": "prometheus-client>=0.20",
    "web": "starlette>=0.40 uvicorn>=0.30 segno>=1.6",
}
"""The libraries of each extra in pyproject.toml, separated by spaces."""


def missing_library(purpose: str, extra: str) -> RunError:
    """The error for a command that needs the library of an extra."""
    requirement = EXTRAS[extra]
    advice = f"Install it: {install_command(requirement)}"
    marker = Path(sysconfig.get_path("stdlib"), "EXTERNALLY-MANAGED")
    # Python is the system's and refuses pip (PEP 668), as with the Debian package
    if sys.prefix == sys.base_prefix and marker.exists():
        advice = (
            "The Debian package leaves it out. In a clone of the sources: "
            f"python3 -m venv ~/kontronik && ~/kontronik/bin/pip install '.[{extra}]'. "
            "Then run ~/kontronik/bin/kontronik-can-gw."
        )
    return RunError(f"{purpose} needs {requirement}. {advice}")


def install_command(requirement: str) -> str:
    """The command that installs or upgrades a library for the Python that runs."""
    quoted = " ".join(f"'{each}'" for each in requirement.split())
    if {"pipx", "venvs"} <= set(Path(sys.prefix).parts):
        return f"pipx inject --force kontronik-can-gw {quoted}"
    return f"{sys.executable} -m pip install --upgrade {quoted}"
