"""``service status``: systemd's own account of the services, with their last log lines."""

import argparse

from kontronik_can_gw.cli import service_files as files
from kontronik_can_gw.cli import show
from kontronik_can_gw.cli.service_files import NAME
from kontronik_can_gw.cli.service_machine import check_systemd, listed, run, show_property

NOT_RUNNING = 3
"""Exit code for "not running", as of systemctl."""


def status(args: argparse.Namespace) -> int:
    check_systemd()
    units = [files.unit(args.instance)] if args.instance else _known_units()
    running = [_show_unit(unit, args.lines) for unit in units]
    return 0 if all(running) else NOT_RUNNING


def _known_units() -> list[str]:
    """The plain service unless only instances are in use, and the instances."""
    pattern = f"{NAME}@*.service"
    names = {name for verb in ("list-units", "list-unit-files") for name in listed(verb, pattern)}
    instances = sorted(names - {f"{NAME}@.service"})
    plain = files.unit(None)
    unused = show_property(plain, "ActiveState") == "inactive"
    unused = unused and show_property(plain, "UnitFileState") != "enabled"
    return instances if instances and unused else [plain, *instances]


def _show_unit(unit: str, lines: int) -> bool:
    """Print what systemctl says of a service; True if it runs."""
    if show_property(unit, "LoadState") == "not-found":
        show(f"{unit}: not installed. See: kontronik-can-gw service install --help")
        return False
    done = run("systemctl", "status", "--no-pager", "--full", "--lines", str(lines), unit)
    for line in (done.stdout or done.stderr).splitlines():
        show(line)
    return show_property(unit, "ActiveState") == "active"
