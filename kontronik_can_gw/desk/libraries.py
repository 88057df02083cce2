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
    "prove": "z3-solver>=4.12",
}
"""The library of each extra in pyproject.toml."""


def missing_library(purpose: str, extra: str) -> RunError:
    """The error for a command that needs the library of an extra."""
    requirement = EXTRAS[extra]
    if _is_system_python():
        advice = f"The Debian package leaves it out. {_clone_advice(extra)}"
    else:
        advice = f"Install it: {install_command(requirement)}"
    return RunError(f"{purpose} needs {requirement}. {advice}")


def unusable_library(purpose: str, extra: str, reason: str, remove: str = "") -> RunError:
    """The error for a library that is installed, but cannot be used.

    ``remove`` is the package that must be removed before, because it is another one.
    """
    requirement = EXTRAS[extra]
    again = _command("--force-reinstall", requirement)
    if _is_system_python():
        advice = _clone_advice(extra)
    elif remove:
        advice = f"Remove it: {_uninstall_command(remove)}. Then: {again}"
    else:
        advice = f"Install it again: {again}"
    return RunError(f"{purpose} needs {requirement}, but {reason}. {advice}")


def _clone_advice(extra: str) -> str:
    return (
        "In a clone of the sources: "
        f"python3 -m venv ~/kontronik && ~/kontronik/bin/pip install '.[{extra}]'. "
        "Then run ~/kontronik/bin/kontronik-can-gw."
    )


def install_command(requirement: str) -> str:
    """The command that installs or upgrades a library for the Python that runs."""
    return _command("--upgrade", requirement)


def _command(option: str, requirement: str) -> str:
    if _is_in_pipx():
        return f"pipx inject --force kontronik-can-gw '{requirement}'"
    return f"{sys.executable} -m pip install {option} '{requirement}'"


def _uninstall_command(package: str) -> str:
    if _is_in_pipx():
        return f"pipx runpip kontronik-can-gw uninstall {package}"
    return f"{sys.executable} -m pip uninstall {package}"


def _is_in_pipx() -> bool:
    return {"pipx", "venvs"} <= set(Path(sys.prefix).parts)


def _is_system_python() -> bool:
    """Whether Python is the system's and refuses pip (PEP 668), as with the Debian package."""
    marker = Path(sysconfig.get_path("stdlib"), "EXTERNALLY-MANAGED")
    return sys.prefix == sys.base_prefix and marker.exists()
