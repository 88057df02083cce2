"""``service``: installs the gateway as a systemd service, and removes it.

The files of the package's folder ``service`` are copied as they are, with the path of the program in the units. Without --root it works
on this machine, as root, and calls systemd's tools; with it only files below that folder are changed.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from importlib.util import find_spec
from pathlib import Path

from kontronik_can_gw.cli.arguments import option
from kontronik_can_gw.cli.common import say
from kontronik_can_gw.cli.init import example
from kontronik_can_gw.cli.service_files import (
    COMPANIONS,
    CONFIGURATIONS,
    NAME,
    NETWORK,
    OBSOLETE,
    UNITS,
    planned,
    put,
    remove,
    take_away,
    unit,
)
from kontronik_can_gw.config.parse import load, parse
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.runtime.disk import is_locked

_WANTS = f"{UNITS}/multi-user.target.wants"
_BOOTED = Path("/run/systemd/system")
"""Exists where systemd runs (sd_booted)."""


def _name(text: str) -> str:
    if text == "gateway" or not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,31}", text):
        problem = f"{text!r} is no name: letters, digits, _ . -, and not gateway"
        raise argparse.ArgumentTypeError(problem)
    return text


def _program(text: str) -> str:
    if not re.fullmatch(r"/[\w/.+@~=,:-]+", text) or ".." in Path(text).parts:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not an absolute path without spaces, quotes, % and the like"
        )
    return text


# fmt: off
_INSTANCE = option("--instance NAME", "one of several gateways: NAME.toml, kontronik-can-gw@NAME", type=_name)
_ROOT = option("--root DIR", "only write below DIR, as for a disk image; call no tools", type=Path)
OPTIONS = ()
ACTIONS = {
    "install": ("write units, udev rules, user and an example configuration; enable", (
        _INSTANCE,
        _ROOT,
        option("--now", "start it too, or restart it"),
        option("--executable PATH", "the program (default: this one)", type=_program),
        option("--mqtt", "a second service that publishes to the broker of the table [mqtt]"),
        option("--metrics", "a service that serves the statistics for Prometheus on 127.0.0.1:9123"),
    )),
    "uninstall": ("stop, disable, and remove what install wrote", (
        _INSTANCE,
        _ROOT,
    )),
}
# fmt: on
EPILOG = (
    "They need root, except with --root, and print what they do. systemctl shows how the services fare. "
    "Exit code: 0 done, 1 something failed, 2 wrong usage."
)


def main(args: argparse.Namespace) -> int:
    """Do it. RunError or UserError where this machine does not allow it, OSError of a file as RunError."""
    root: Path | None = args.root
    if root is not None and not root.is_dir():
        raise UserError(f"{root}: is not a folder. --root names the top folder of a disk image.")
    if root is None and not _BOOTED.is_dir():
        raise RunError(
            "this system does not run systemd. For a disk image: --root DIR. Without systemd: run --wait"
        )
    if root is None and os.geteuid() != 0:
        raise RunError(f"only root may do that: sudo {_own_program()} service {args.action} ...")
    try:
        return {"install": _install, "uninstall": _uninstall}[args.action](args)
    except OSError as error:
        raise RunError(f"{error.filename}: {error.strerror}") from None


# --- install


def _install(args: argparse.Namespace) -> int:
    root = args.root or Path("/")
    companions = [kind for kind in COMPANIONS if vars(args)[kind]]
    for kind in companions:
        if args.executable is None and find_spec(COMPANIONS[kind]) is None:
            raise RunError(f"--{kind}: pip install 'kontronik-can-gw[{kind}]'")
    program = args.executable or _own_program()
    if args.root is None:
        _check_program(program, is_own=args.executable is None)
    files = dict(planned(program, companions))
    own = root / CONFIGURATIONS / f"{args.instance or 'gateway'}.toml"
    if not own.exists():
        files[str(own.relative_to(root))] = example()
    for place in files:
        # a link to /etc, as in some roots, would lead to this machine
        if not (root / place).parent.resolve().is_relative_to(root.resolve()):
            raise RunError(f"{(root / place).parent}: leads out of {root}")
    for place, text in files.items():
        put(root / place, text)
    for path in (path for place in OBSOLETE for path in root.glob(place)):
        remove(path)
    if args.root is None:
        _reload()
    _enable(args, root, own, companions)
    return 0


def _reload() -> None:
    """Let systemd make user and folders, and read units and udev rules."""
    for words in (
        ("systemd-sysusers", f"/etc/sysusers.d/{NAME}.conf"),
        ("systemd-tmpfiles", "--create", f"/etc/tmpfiles.d/{NAME}.conf"),
        ("systemctl", "daemon-reload"),
        ("udevadm", "control", "--reload"),
        ("udevadm", "trigger", "--action=change", "--subsystem-match=tty"),
    ):
        if shutil.which(words[0]):
            _call(*words)
    _call("id", NAME)


def _enable(args: argparse.Namespace, root: Path, own: Path, companions: list[str]) -> None:
    """Enable the services, and start them with --now, if their configuration is usable."""
    if problems := _not_ready(own):
        then = f"When it is right: sudo systemctl enable --now {unit(args.instance)}"
        text = [*problems, f"{unit(args.instance)} was not enabled. {then}"]
        if args.now:
            raise RunError(*text)
        for line in text:
            say(line)
        return
    for kind in ("", *companions):
        name = unit(args.instance, kind)
        if kind == "mqtt" and load(own).mqtt.broker is None:
            say(f"{own}: mqtt.broker is not set. {name} was not enabled.")
            continue
        if args.root is not None:
            link = root / _WANTS / name
            link.parent.mkdir(parents=True, exist_ok=True)
            link.unlink(missing_ok=True)
            link.symlink_to(f"/{UNITS}/{unit('' if args.instance else None, kind)}")
        else:
            _call("systemctl", "enable", name)
            if args.now:
                _call("systemctl", "restart", name)
        say(
            f"{name} is enabled{' and runs' if args.now and not args.root else ''}. See: systemctl status {name}"
        )


def _not_ready(own: Path) -> list[str]:
    """Why the service must not send yet: its configuration is faulty, or the unedited example."""
    try:
        ports = {esc.port for esc in load(own).esc}
    except UserError as error:
        return list(error.problems)
    if ports & {esc.port for esc in parse(tomllib.loads(example()), "").esc}:
        return [f"{own}: is the example. Set ports, bit rate and motors first."]
    return []


def _own_program() -> str:
    """Path of the installed program of this Python. UserError where there is none."""
    for folder in (Path(sysconfig.get_path("scripts")), Path(sys.argv[0]).absolute().parent):
        if os.access(folder / NAME, os.X_OK):
            return str(folder / NAME)
    raise UserError(f"no installed {NAME} belongs to this Python. Name it with --executable.")


def _check_program(program: str, *, is_own: bool) -> None:
    """UserError where the service's user could not run it. ``is_own``: it is run by this Python, with this package."""
    paths = [Path(program), Path(program).resolve()]
    if is_own:
        paths += [Path(sys.executable).resolve(), Path(__file__).resolve()]
    for path in paths:
        for part in (*reversed(path.parents), path):
            mode = part.stat().st_mode & (1 if part.is_dir() else 4) if part.exists() else 0
            if not mode or str(part) in ("/tmp", "/var/tmp"):  # noqa: S108  it has its own
                raise UserError(
                    f"{path}: the service's user cannot reach it: {part}. Install the program where all may read, as in /opt/{NAME}."
                )


# --- uninstall


def _units(instance: str | None) -> list[str]:
    """Names of an instance's services, or patterns of all."""
    kinds = ("", *COMPANIONS)
    which = [instance] if instance else [None, "*"]
    return [unit(each, kind) for each in which for kind in kinds]


def _there(instance: str | None) -> list[str]:
    """Services that there are, loaded or only as files."""
    lines: list[str] = []
    for verb in ("list-units", "list-unit-files"):
        done = _run("systemctl", verb, "--all", "--plain", "--no-legend", *_units(instance))
        lines += done.stdout.splitlines()
    names = {line.split()[0] for line in lines if line.strip()}
    return sorted(name for name in names if not name.endswith("@.service"))


def _uninstall(args: argparse.Namespace) -> int:
    """Stop, disable and remove. Configurations, stored parameters and the user stay."""
    root = args.root or Path("/")
    for name in _there(args.instance) if args.root is None else ():
        _call("systemctl", "disable", "--now", name)
        _run("systemctl", "reset-failed", name)
        say(f"{name}: stopped and disabled")
    links = sorted((root / _WANTS).glob("*"))
    found = [path for path in links if any(map(path.match, _units(args.instance)))]
    kept: list[str] = []
    if not args.instance:
        owned = {root / place: text for place, text in planned("", COMPANIONS)}
        found += filter(os.path.lexists, owned)
        found += (path for place in OBSOLETE for path in root.glob(place))
        for path, text in owned.items():
            take_away(path, text)
        for folder in (root / f"run/{NAME}", *root.glob(f"run/{NAME}-*")):
            if not any(map(is_locked, folder.glob("lock/*"))):
                remove(folder)
        places = (CONFIGURATIONS, f"var/lib/{NAME}", f"var/lib/{NAME}-*", NETWORK)
        there = (path for place in places for path in root.glob(place))
        kept = [str(path) for path in there if path not in found]
    for path in found:
        remove(path)
    if args.root is None and not args.instance:
        _call("systemctl", "daemon-reload")
    say("done" if found else "nothing is installed")
    if kept:
        say(f"kept: {', '.join(kept)}, and the user {NAME} (sudo rm -r, sudo userdel)")
    return 0


# --- tools


def _run(*words: str) -> "subprocess.CompletedProcess[str]":
    environment = os.environ | {"LC_ALL": "C.UTF-8", "SYSTEMD_PAGER": "", "SYSTEMD_COLORS": "0"}
    try:
        return subprocess.run(
            words, capture_output=True, text=True, errors="replace", timeout=120, stdin=subprocess.DEVNULL, env=environment
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as error:
        raise RunError(f"`{' '.join(words)}` did not end: {error}") from None


def _call(*words: str) -> None:
    """Call a tool. RunError with its output where it fails."""
    done = _run(*words)
    if done.returncode:
        raise RunError(
            f"`{' '.join(words)}` failed: {' '.join((done.stderr or done.stdout).split())}"
        )
