"""``service uninstall``: stops, disables and removes what an install wrote. Files of the user are kept."""

import argparse
import contextlib
import shutil
from collections.abc import Sequence
from pathlib import Path

from kontronik_can_gw.cli import service_files as files
from kontronik_can_gw.cli.common import say
from kontronik_can_gw.cli.service_files import NAME, WANTS
from kontronik_can_gw.cli.service_machine import (
    call,
    check_rights,
    listed,
    run,
    show_property,
)
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.runtime.locks import is_held


def uninstall(args: argparse.Namespace) -> int:
    live, root = args.root is None, args.root or Path("/")
    check_rights(args.root, "uninstall")
    links = sorted((root / WANTS).glob(f"{NAME}*.service"))
    if args.instance:
        if args.purge:
            raise UserError("--purge removes everything: not with --instance")
        units = _units(args.instance)
        _disable(units, [link for link in links if link.name in units], live)
        if live:
            _remove_runtime_folders(root, f"{NAME}-{args.instance}")
        return 0
    found = files.installed(root)
    doomed = _kept_data(root) if args.purge else []
    if not found and not links and not doomed:
        say("nothing is installed")
        return 0
    units = _units(None)
    if live:
        units += listed("list-units", *_units("*"))
    _disable(units, links, live)
    for path in found:
        _remove_file(path)
    for kind in ("", "@"):
        with contextlib.suppress(OSError):  # missing, or it holds drop-ins of others
            (root / files.UNITS / f"{NAME}{kind}.service.d").rmdir()
    for path in doomed:
        files.remove(path)
    if live:
        _remove_runtime_folders(root, f"{NAME}*")
        call("systemctl", "daemon-reload")
        if shutil.which("udevadm"):
            call("udevadm", "control", "--reload")
        if args.purge:
            run("userdel", NAME)
    kept = [] if args.purge else _kept_data(root)
    if kept:
        say(f"kept: {', '.join(map(str, kept))} (--purge removes them)")
    return 0


def _units(instance: str | None) -> list[str]:
    """An instance's service and those beside it."""
    return [files.unit(instance, kind) for kind in ("", *files.COMPANIONS)]


def _disable(units: Sequence[str], links: Sequence[Path], live: bool) -> None:
    for unit in dict.fromkeys(units) if live else ():
        if show_property(unit, "LoadState") == "loaded":
            call("systemctl", "disable", "--now", unit)
            run("systemctl", "reset-failed", unit)
            say(f"{unit}: stopped and disabled")
    for link in links:
        if link.is_symlink():
            files.remove(link)


def _kept_data(root: Path) -> list[Path]:
    patterns = (files.CONFIGURATIONS, f"var/lib/{NAME}", f"var/lib/{NAME}-*")
    return [path for pattern in patterns for path in sorted(root.glob(pattern))]


def _remove_runtime_folders(root: Path, pattern: str) -> None:
    """Remove runtime folders that outlive the units."""
    held = (root / "proc/locks").read_text()
    for path in sorted((root / "run").glob(pattern)):
        with contextlib.suppress(OSError):
            if any(is_held(file.lstat(), held) for file in path.glob("lock/*")):
                say(f"{path}: kept, a gateway that is no service has locks there")
            else:
                shutil.rmtree(path)


def _remove_file(path: Path) -> None:
    if files.is_ours(files.read(path) or ""):
        files.remove(path)
    else:
        say(f"{path}: was changed by hand, kept as {files.put_aside(path).name}")
