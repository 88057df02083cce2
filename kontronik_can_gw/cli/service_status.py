"""``service status``: shows systemd's state of the services, their configurations and log lines."""

import argparse
import json
import os
from datetime import datetime
from pathlib import Path

from kontronik_can_gw.cli import service_files as files
from kontronik_can_gw.cli import show
from kontronik_can_gw.cli.service_files import NAME
from kontronik_can_gw.cli.service_machine import check_systemd, output, run
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.printable import printable

NOT_RUNNING = 3
"""Exit code for "not running", as of systemctl."""
_PRIORITIES = ("emergency", "alert", "critical", "error", "warning", "notice", "", "debug")
_WANTED = (
    "LoadState",
    "ActiveState",
    "SubState",
    "StateChangeTimestamp",
    "UnitFileState",
    "StatusText",
    "MainPID",
    "NRestarts",
    "MemoryCurrent",
    "Result",
    "ExecMainStatus",
)


def status(args: argparse.Namespace) -> int:
    check_systemd()
    units = [files.unit(args.instance)] if args.instance else _known_units()
    running = [_show_unit(unit, args.lines) for unit in units]
    return 0 if all(running) else NOT_RUNNING


def _known_units() -> list[str]:
    """The loaded or enabled services; the plain one if there is no instance."""
    listed = output(
        "systemctl", "list-units", "--all", "--plain", "--no-legend", f"{NAME}@*.service"
    )
    enabled = output("systemctl", "list-unit-files", "--plain", "--no-legend", f"{NAME}@*.service")
    rows = [line.split()[0] for line in (listed + "\n" + enabled).splitlines() if line.strip()]
    instances = sorted(
        {row for row in rows if row.startswith(f"{NAME}@") and row != f"{NAME}@.service"}
    )
    plain = files.unit(None)
    shown = properties(plain)
    unused = shown.get("ActiveState") == "inactive" and shown.get("UnitFileState") != "enabled"
    return instances if instances and unused else [plain, *instances]


def properties(unit: str) -> dict[str, str]:
    shown = output("systemctl", "show", "--property", ",".join(_WANTED), unit)
    return {
        name: value
        for name, found, value in (line.partition("=") for line in shown.splitlines())
        if found
    }


def _show_unit(unit: str, lines: int) -> bool:
    """Print the state of a service; True if it runs."""
    shown = properties(unit)
    state = shown.get("ActiveState", "unknown")
    if shown.get("LoadState") == "not-found":
        show(f"{unit}: not installed. See: kontronik-can-gw service install --help")
        return False
    since = f" since {shown['StateChangeTimestamp']}" if shown.get("StateChangeTimestamp") else ""
    at_start = (
        "starts with the machine"
        if shown.get("UnitFileState") == "enabled"
        else "does not start with the machine"
    )
    show(f"{unit}: {state} ({shown.get('SubState', '')}){since}; {at_start}")
    if text := shown.get("StatusText"):
        show(f"  says           {text}")
    words = [f"pid {shown['MainPID']}"] if shown.get("MainPID", "0") != "0" else []
    words.append(f"restarted {shown.get('NRestarts') or 0} times")
    if (memory := shown.get("MemoryCurrent", "")).isdecimal() and int(memory) < 1 << 60:
        words.append(f"{int(memory) >> 20} MB")
    if shown.get("Result", "success") != "success":
        words.append(f"last ended by {shown['Result']}, status {shown.get('ExecMainStatus', '?')}")
    show(f"  process        {', '.join(words)}")
    name = unit.removeprefix(NAME).removeprefix("@").removesuffix(".service") or None
    for number, line in enumerate(_judge(Path("/") / files.configuration(name))):
        show(f"  {'' if number else 'configuration':<13}  {line}")
    for number, line in enumerate(_log(unit, lines)):
        show(f"  {'' if number else 'log':<13}  {line}")
    return state in ("active", "reloading")


def _judge(own: Path) -> list[str]:
    from kontronik_can_gw.config.parse import load

    try:
        load(own)
    except UserError as error:
        return list(error.problems)
    return [str(own)]


def _log(unit: str, lines: int) -> list[str]:
    if not lines:
        return []
    done = run(
        "journalctl",
        "--unit",
        unit,
        "--lines",
        str(lines),
        "--no-pager",
        "--quiet",
        "--output",
        "json",
    )
    found = [line for text in done.stdout.splitlines() if (line := _entry(text))]
    return found or [
        "nothing that this user may read (sudo shows all)" if os.geteuid() else "empty"
    ]


def _entry(text: str) -> str:
    """An entry of the journal as a line; empty where it is invalid."""
    try:
        entry = json.loads(text)
        message = entry["MESSAGE"]
        if isinstance(message, list):  # bytes that are not UTF-8
            message = bytes(message).decode(errors="replace")
        time = datetime.fromtimestamp(int(entry["__REALTIME_TIMESTAMP"]) // 1_000_000).astimezone()
        word = _PRIORITIES[int(entry.get("PRIORITY", 6))]
    except (ValueError, KeyError, TypeError, IndexError, OverflowError, OSError):
        return ""
    return f"{time:%Y-%m-%d %H:%M:%S}  {word + ': ' if word else ''}{printable(str(message))}"
