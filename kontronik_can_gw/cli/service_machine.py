"""The machine that ``service`` works on: systemd's tools, the service's user, and access to the program."""

import contextlib
import os
import pwd
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterable
from pathlib import Path

from kontronik_can_gw.cli.common import say
from kontronik_can_gw.cli.service_files import NAME, SYSUSERS, TMPFILES
from kontronik_can_gw.errors import RunError, UserError

_EXECUTABLE = re.compile(r"/[\w/.+@~=,:-]+")
_HOMES = ("/home", "/root", "/run/user")
_BOOTED = Path("/run/systemd/system")
"""Exists where systemd runs (sd_booted)."""
_HIDDEN = ("/tmp", "/var/tmp")  # noqa: S108  the service has its own (PrivateTmp=)


def check_rights(root: Path | None, action: str) -> None:
    """UserError or RunError where an action cannot be done below ``root``, or to this machine (None)."""
    if root is None:
        check_systemd()
        if os.geteuid() != 0:
            raise RunError(f"only root may do that: sudo {own_executable()} service {action} ...")
    elif not root.is_dir():
        raise UserError(f"{root}: is not a folder. --root names the top folder of a disk image.")


def check_systemd() -> None:
    if not _BOOTED.is_dir():
        raise RunError(
            "this system does not run systemd. For a disk image: --root DIR. Without systemd: run --wait"
        )


def run(*words: str) -> "subprocess.CompletedProcess[str]":
    environment = os.environ | {"LC_ALL": "C.UTF-8", "SYSTEMD_PAGER": "", "SYSTEMD_COLORS": "0"}
    try:
        return subprocess.run(
            words,
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
            timeout=120,
            stdin=subprocess.DEVNULL,
            env=environment,
        )
    except OSError as error:
        raise RunError(f"{words[0]}: cannot be started: {error.strerror}") from None
    except subprocess.TimeoutExpired:
        raise RunError(f"`{' '.join(words)}` did not end within two minutes.") from None


def show_property(unit: str, name: str) -> str:
    """A property of a unit, as systemctl shows it."""
    return run("systemctl", "show", "--value", "--property", name, unit).stdout.strip()


def listed(verb: str, *patterns: str) -> list[str]:
    """Names of the units that ``list-units`` or ``list-unit-files`` has."""
    done = run("systemctl", verb, "--all", "--plain", "--no-legend", *patterns)
    return [line.split()[0] for line in done.stdout.splitlines() if line.strip()]


def call(*words: str) -> None:
    """Call a tool. RunError with its output where it fails."""
    done = run(*words)
    if done.returncode:
        said = done.stderr.strip() or f"exit code {done.returncode}"
        raise RunError(f"`{' '.join(words)}` failed: {said.splitlines()[0].strip()}")


def reload(channel: str | None) -> None:
    """Make user and lock folder and apply units, udev rules and, with a channel, network files."""
    if shutil.which("systemd-sysusers"):
        call("systemd-sysusers", f"/{SYSUSERS}")
    _check_user()
    if shutil.which("systemd-tmpfiles"):
        call("systemd-tmpfiles", "--create", f"/{TMPFILES}")
    call("systemctl", "daemon-reload")
    if shutil.which("udevadm"):
        call("udevadm", "control", "--reload")
        call("udevadm", "trigger", "--action=change", "--subsystem-match=tty")
    else:
        say("no udevadm here: the udev rules act after the next start")
    if channel is None:
        return
    if show_property("systemd-networkd.service", "ActiveState") == "active":
        call("networkctl", "reload")
    else:
        say(
            f"systemd-networkd does not run here. For {channel}: sudo systemctl enable --now systemd-networkd"
        )
    say(
        f"the queue length of {channel} holds from the next start of the machine; now: sudo ip link set {channel} txqueuelen 128"
    )


def _check_user() -> None:
    try:
        pwd.getpwnam(NAME)
    except KeyError:
        raise RunError(
            f"user {NAME}: could not be made. By hand: sudo useradd --system {NAME}, in the group of serial ports"
        ) from None


def own_executable() -> str:
    """Path of the installed program of this Python. UserError where there is none."""
    started = Path(sys.argv[0]).absolute().parent
    for folder in (sysconfig.get_path("scripts"), f"{sys.prefix}/bin", started):
        if os.access(Path(folder) / NAME, os.X_OK):
            return str(Path(folder) / NAME)
    raise UserError(f"no installed {NAME} belongs to this Python. Name it with --executable.")


def check_executable(executable: str, root: Path) -> bool:
    """True if the program is below a home folder. UserError if the service could not run it."""
    if not _EXECUTABLE.fullmatch(executable) or ".." in Path(executable).parts:
        raise UserError(
            f"{executable}: must be an absolute path without spaces, quotes, % and the like: --executable"
        )
    program, needed = root / executable.lstrip("/"), [Path(executable)]
    if root != Path("/") and not program.exists():
        say(f"warning: {program}: is not there yet")
    elif not os.access(program, os.X_OK) or not program.is_file():
        raise UserError(f"{program}: is not a program. Name the installed one with --executable.")
    elif root == Path("/"):
        needed = _needed(program)
        for path in needed:
            _check_reachable(path)
    return any(_is_below(path, _HOMES) for path in needed)


def _check_reachable(path: Path) -> None:
    if _is_below(path, _HIDDEN):
        raise UserError(
            f"{path}: the service has a /tmp of its own and does not see it. Install the program in /opt/{NAME}."
        )
    if (closed := closed_to_others(path)) is not None:
        raise UserError(
            f"{path}: the service's user cannot reach it: {closed} is closed to others. "
            f"Install the program where all may read, as in /opt/{NAME}."
        )


def _is_below(path: Path, folders: Iterable[str]) -> bool:
    return any(path.is_relative_to(folder) for folder in folders)


def _needed(program: Path) -> list[Path]:
    """Files needed to run the program: itself, its interpreter, and the package if it is this one."""
    needed = [program, program.resolve()]
    with contextlib.suppress(OSError):
        first = program.open("rb").readline(4096).decode(errors="replace")
        interpreter = Path(first[2:].split()[0]) if first.startswith("#!/") else Path()
        if interpreter.name.startswith("python"):
            needed += [interpreter, interpreter.resolve()]
            if interpreter.parent == Path(sys.executable).parent:
                needed.append(Path(__file__).resolve())
    return list(dict.fromkeys(needed))


def closed_to_others(path: Path) -> Path | None:
    """The first folder or file on the path without access for others; None: all are accessible."""
    for part in reversed([path, *path.parents]):
        with contextlib.suppress(OSError):
            if part.stat().st_mode & (1 if part.is_dir() else 4) == 0:
                return part
    return None
