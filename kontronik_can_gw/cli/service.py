"""``service``: installs the gateway as a systemd service, and removes it.

The files in the package's folder ``systemd`` are copied. Only the path of the program in the units
is replaced. Without --root the command changes this machine, as root, and calls systemd's tools.
With --root only files below that folder are changed.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from collections.abc import Iterator
from pathlib import Path

from kontronik_can_gw.cli.arguments import option
from kontronik_can_gw.cli.common import say
from kontronik_can_gw.cli.init import example
from kontronik_can_gw.config.parse import load, parse
from kontronik_can_gw.errors import RunError, UserError

NAME = "kontronik-can-gw"
PLAIN = Path(__file__).parents[1] / "systemd"
"""The folder of the original files."""
_PROGRAM = f"/usr/bin/{NAME}"
"""The path of the program in the original units."""
_RESTART = f"{NAME}-restart"
"""The units that restart a CAN interface, whose instances are named after it."""
_KINDS = ("", "-mqtt", "-metrics", "-web")
"""Suffixes of the services: the gateway's, and three optional ones."""
_OWN_FOLDERS = (
    r"(?m)^(StateDirectory|RuntimeDirectory|CacheDirectory|Environment=STATE_DIRECTORY)=.*"
)
"""Lines of units with folders that each instance has for itself."""
UNITS = "etc/systemd/system"
_WANTS = f"{UNITS}/multi-user.target.wants"
_BOOTED = Path("/run/systemd/system")
"""Exists if systemd runs (sd_booted)."""
_PATIENCE_S = 120
"""Longest time that a tool may take."""
_OBSOLETE = (
    f"{UNITS}/{NAME}*.service.d/prometheus.conf",
    f"{UNITS}/{NAME}*@.service.d/instance.conf",
    f"etc/systemd/network/50-{NAME}-*.example",
)
"""Files that earlier versions installed. Their set-up of a CAN interface works and is kept."""


def _name(text: str) -> str:
    if text == "gateway" or not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,31}", text):
        problem = f"{text!r} is not a name of letters, digits, _ . -, or it is gateway"
        raise argparse.ArgumentTypeError(problem)
    return text


def _program(text: str) -> str:
    if not re.fullmatch(r"/[\w/.+@~=,:-]+", text) or ".." in Path(text).parts:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not an absolute path without spaces, quotes, % and the like"
        )
    return text


_ROOT = option(
    "--root DIR",
    "only write files below DIR, for example for a disk image, and call no tools",
    type=Path,
)
OPTIONS = ()
ACTIONS = {
    "install": (
        "write units, udev rules and an example configuration, create the user, enable the service",
        (
            _ROOT,
            option(
                "--instance NAME",
                "set up one of several gateways, with NAME.toml and kontronik-can-gw@NAME",
                type=_name,
            ),
            option("--now", "also start or restart the service"),
            option(
                "--executable PATH",
                "the program that the service runs (default: this one)",
                type=_program,
            ),
        ),
    ),
    "uninstall": (
        "stop and disable all services, and remove the files that install wrote",
        (_ROOT,),
    ),
}
EPILOG = (
    "Both actions need root, except with --root, and print each step. "
    "systemctl shows the state of the services. "
    "Exit codes: 0 done, 1 a step failed, 2 wrong usage."
)


def main(args: argparse.Namespace) -> int:
    """Install or uninstall. Raises UserError or RunError if this machine does not allow it.

    An OSError of a file is raised as RunError.
    """
    root: Path | None = args.root
    if root is not None and not root.is_dir():
        raise UserError(f"{root}: is not a folder. --root names the top folder of a disk image.")
    if root is None and not _BOOTED.is_dir():
        raise RunError(
            "this system does not run systemd. For a disk image give --root DIR. "
            "Without systemd, let your init start: kontronik-can-gw run --wait"
        )
    if root is None and os.geteuid() != 0:
        command = f"sudo {_own_program()} service {args.action}"
        raise RunError(f"service {args.action}: needs root. Type {command} with the same options.")
    top = root or Path("/")
    try:
        if args.action == "install":
            _install(args, top)
        else:
            _uninstall(top, staged=root is not None)
    except OSError as error:
        raise RunError(f"{error.filename}: {error.strerror}") from None
    return 0


def planned(program: str) -> Iterator[tuple[str, str]]:
    """Yield path below the root and text of each file."""
    for kind in _KINDS:
        text = _plain(f"{NAME}{kind}.service").replace(_PROGRAM, program)
        yield f"{UNITS}/{NAME}{kind}.service", text
        # each instance has its own configuration and folders
        template = text.replace("/gateway.toml", "/%i.toml")
        template = re.sub(_OWN_FOLDERS, r"\g<0>-%i", template)
        yield f"{UNITS}/{NAME}{kind}@.service", template
    for suffix in ("path", "service"):
        name = f"{_RESTART}@.{suffix}"
        yield f"{UNITS}/{name}", _plain(name)
    yield f"etc/sysusers.d/{NAME}.conf", _plain("sysusers.conf")
    yield f"etc/tmpfiles.d/{NAME}.conf", _plain("tmpfiles.conf")
    yield f"etc/udev/rules.d/70-{NAME}.rules", _plain("udev.rules")


def _plain(name: str) -> str:
    return (PLAIN / name).read_text(encoding="utf-8")


# --- install


def _install(args: argparse.Namespace, root: Path) -> None:
    """Write the files, and enable the service if its configuration is usable.

    Raises RunError if --now cannot start it.
    """
    program = args.executable or _own_program()
    if args.root is None:
        _check_program(program, is_own=args.executable is None)
    config = f"etc/{NAME}/{args.instance or 'gateway'}.toml"
    _write_files(root, program, config)
    problems = _not_ready(root / config)
    template = f"{NAME}{'@' if args.instance else ''}.service"
    unit = template.replace("@", f"@{args.instance}")
    units = []
    lines = problems
    if problems:
        lines.append(
            f"{unit} was not enabled. After the correction: sudo systemctl enable --now {unit}"
        )
    else:
        units.append(unit)
        _enable(root, unit, template)
        lines.append(f"{unit} is enabled. See: systemctl status {unit}")
        can = load(root / config).can
        if can.restart_after_ns:
            path_unit = f"{_RESTART}@{can.channel}.path"
            units.append(path_unit)
            _enable(root, path_unit, f"{_RESTART}@.path")
            lines.append(f"{path_unit} is enabled, because can.restart_after_s is not 0")
    if args.root is None:
        _reload()
    if args.now and not units:
        raise RunError(*lines)
    if args.now and args.root is None:
        for enabled in units:
            _call("systemctl", "restart", enabled)
    for line in lines:
        say(line)


def _write_files(root: Path, program: str, config: str) -> None:
    """Write units, rules and a missing configuration, and remove files of earlier versions."""
    files = dict(planned(program))
    if not (root / config).exists():
        files[config] = example()
    for place in files:
        # some roots have absolute links, for example to /etc, which would change this machine
        if not (root / place).parent.resolve().is_relative_to(root.resolve()):
            raise RunError(f"{(root / place).parent}: is outside of {root}")
    for place, text in files.items():
        _put(root / place, text)
    for path in _obsolete_files(root):
        path.unlink()
        say(f"{path}: removed")


def _enable(root: Path, unit: str, template: str) -> None:
    """Enable a unit, as `systemctl enable` does."""
    link = root / _WANTS / unit
    link.parent.mkdir(parents=True, exist_ok=True)
    link.unlink(missing_ok=True)
    link.symlink_to(f"/{UNITS}/{template}")


def _put(path: Path, text: str) -> None:
    """Write a file that all users may read. An existing different file is renamed and reported."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o755)
    done = "new"
    if os.path.lexists(path):
        if path.is_file() and path.read_text(encoding="utf-8", errors="replace") == text:
            return
        kept = _set_aside(path)
        done = f"replaced, the old file is {kept}"
        if path.suffix == ".rules":  # in 0.5.0 users wrote the names of ports into this file
            done += f". Your lines are in {kept}. Move them to 71-esc.rules"
    path.write_text(text, encoding="utf-8")
    path.chmod(0o644)
    say(f"{path}: {done}")


def _set_aside(path: Path) -> str:
    """Rename a file with the first free ending of .bak, .bak2 and so on. Return the new name."""
    name = f"{path.name}.bak"
    number = 1
    while os.path.lexists(path.with_name(name)):
        number += 1
        name = f"{path.name}.bak{number}"
    path.rename(path.with_name(name))
    return name


def _obsolete_files(root: Path) -> list[Path]:
    found: list[Path] = []
    for place in _OBSOLETE:
        found += root.glob(place)
    return found


def _not_ready(config: Path) -> list[str]:
    """Return the reasons why the service must not send yet.

    Its configuration is faulty, or it is the unedited example.
    """
    try:
        ports = {esc.port for esc in load(config).esc}
    except UserError as error:
        return list(error.problems)
    example_config = parse(tomllib.loads(example()), "")
    if ports & {esc.port for esc in example_config.esc}:
        return [f"{config}: is the unchanged example. Set ports, bit rate and motors first."]
    return []


def _own_program() -> str:
    """Return the path of this Python's installed program. Raises UserError if there is none."""
    scripts = Path(sysconfig.get_path("scripts"))
    for folder in (scripts, Path(sys.argv[0]).absolute().parent):
        if os.access(folder / NAME, os.X_OK):
            return str(folder / NAME)
    raise UserError(f"this Python has no installed {NAME}. Give its path with --executable.")


def _check_program(program: str, *, is_own: bool) -> None:
    """Raise UserError if the service's user cannot run the program.

    ``is_own``: the program uses this Python and this package.
    """
    paths = [Path(program), Path(program).resolve()]
    if is_own:
        paths += [Path(sys.executable).resolve(), Path(__file__).resolve()]
    for path in paths:
        for part in (*reversed(path.parents), path):
            # the service has a /tmp of its own
            is_temporary = str(part) in ("/tmp", "/var/tmp")  # noqa: S108
            if is_temporary or not _is_accessible(part):
                raise UserError(
                    f"{path}: the service's user cannot access {part}. "
                    f"Install the program where all users may read, for example in /opt/{NAME}."
                )


def _is_accessible(path: Path) -> bool:
    """Return True if all users may enter a folder or read a file."""
    if not path.exists():
        return False
    needed = 1 if path.is_dir() else 4
    return bool(path.stat().st_mode & needed)


# --- uninstall


def _uninstall(root: Path, *, staged: bool) -> None:
    """Stop, disable and remove the services. Configurations, parameters and the user are kept."""
    if not staged:
        units = (f"{NAME}*.path", f"{NAME}*.service")
        _call("systemctl", "stop", *units)
        _call("systemctl", "reset-failed", *units)
    found = [path for path in (root / _WANTS).glob(f"{NAME}*") if path.is_symlink()]
    found += _obsolete_files(root)
    for place, text in planned(""):
        path = root / place
        there = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else text
        if _without_program(there) != _without_program(text):
            say(f"{path}: was changed, kept as {_set_aside(path)}")
        elif os.path.lexists(path):
            found.append(path)
    for path in found:
        path.unlink()
        say(f"{path}: removed")
    if not staged:
        _call("systemctl", "daemon-reload")
    if found:
        say(
            f"kept: /etc/{NAME}, /var/lib/{NAME}*, /run/{NAME}* (sudo rm -r), the user {NAME} "
            "(sudo userdel) and /etc/systemd/network"
        )
    else:
        say("nothing is installed")


def _without_program(unit: str) -> str:
    """Return the text of a unit without the program that it starts."""
    return re.sub(r"(?m)^(ExecStart=(?:/bin/sh .* sh )?)\S*", r"\1", unit)


# --- tools


def _reload() -> None:
    """Make systemd create user and folders, and read units and udev rules."""
    commands = (
        ("systemd-sysusers", f"/etc/sysusers.d/{NAME}.conf"),
        ("systemd-tmpfiles", "--create", f"/etc/tmpfiles.d/{NAME}.conf"),
        ("systemctl", "daemon-reload"),
        ("udevadm", "control", "--reload"),
        ("udevadm", "trigger", "--action=change", "--subsystem-match=tty"),
        ("id", NAME),
    )
    for words in commands:
        if shutil.which(words[0]):
            _call(*words)


def _call(*words: str) -> None:
    """Call a tool. Raises RunError with its output if it fails."""
    command = " ".join(words)
    environment = os.environ | {"LC_ALL": "C.UTF-8"}
    try:
        done = subprocess.run(
            words,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_PATIENCE_S,
            stdin=subprocess.DEVNULL,
            env=environment,
        )
    except subprocess.TimeoutExpired:
        raise RunError(f"`{command}` did not end within {_PATIENCE_S} s") from None
    except OSError as error:
        raise RunError(f"`{command}` cannot be started: {error.strerror}") from None
    if done.returncode:
        output = " ".join((done.stderr or done.stdout).split())
        raise RunError(f"`{command}` failed: {output}")
