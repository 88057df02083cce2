"""``service``: installs the gateway as a systemd service, shows its state, removes it.

Without --root it works on this machine, as root, and calls systemd's tools; with it only files below that folder are changed.
"""

import argparse
import re
import tomllib
from importlib.util import find_spec
from pathlib import Path

from kontronik_can_gw.cli import service_files as files
from kontronik_can_gw.cli.arguments import number_from, option
from kontronik_can_gw.cli.common import say
from kontronik_can_gw.cli.init import example
from kontronik_can_gw.cli.service_files import COMPANIONS, WANTS, Choices
from kontronik_can_gw.cli.service_machine import (
    call,
    check_executable,
    check_rights,
    own_executable,
    reload,
)
from kontronik_can_gw.cli.service_removal import uninstall
from kontronik_can_gw.cli.service_status import status
from kontronik_can_gw.config.parse import load, parse
from kontronik_can_gw.errors import RunError, UserError


def _instance(text: str) -> str:
    if text == "gateway":
        raise argparse.ArgumentTypeError(f"{text!r} is the plain service's configuration")
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,31}", text):
        raise argparse.ArgumentTypeError(f"{text!r} is no name: letters, digits, _ . -")
    return text


def _channel(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,14}", text):
        raise argparse.ArgumentTypeError(f"{text!r} is not the name of an interface")
    return text


_BITRATE = number_from(
    5_000, 1_000_000, kind=int, problem="is not a bit rate in bit/s, 5000 to 1000000"
)
# fmt: off
_INSTANCE = option("--instance NAME", "one of several gateways: NAME.toml, kontronik-can-gw@NAME", type=_instance)
_ROOT = option("--root DIR", "only write below DIR, as for a disk image; call no tools", type=Path)
OPTIONS = ()
ACTIONS = {
    "install": ("write units, udev rules, user and an example configuration; enable", (
        _INSTANCE,
        _ROOT,
        option("--now", "start it too, or restart it"),
        option("--executable PATH", "the program (default: this one)"),
        option("--network BITRATE", "let systemd-networkd set up the CAN interface", type=_BITRATE),
        option("--channel NAME", "the CAN interface (default can0)", type=_channel, default="can0"),
        option("--mqtt", "a second service that publishes to the broker of the table [mqtt]"),
        option("--metrics", "a service that serves the statistics for Prometheus on 127.0.0.1:9123"),
    )),
    "status": ("state and last log lines of the services in use; exit code 0 running, 3 not", (
        _INSTANCE,
        option("-n --lines N", "lines of the log (default 10)", type=number_from(0, 10_000, "number of lines", kind=int), default=10),
    )),
    "uninstall": ("stop, disable, and remove what install wrote", (
        _INSTANCE,
        _ROOT,
        option("--purge", "remove configurations, stored parameters and the user too"),
    )),
}
# fmt: on
EPILOG = (
    "install and uninstall need root, except with --root, and print what they do. "
    "Exit code: 0 done, 1 something failed, 2 wrong usage; of status 0 running, 3 not running."
)


def main(args: argparse.Namespace) -> int:
    actions = {"install": _install, "status": status, "uninstall": uninstall}
    return actions[args.action](args)


def _install(args: argparse.Namespace) -> int:
    root = args.root or Path("/")
    check_rights(args.root, "install")
    executable = args.executable or own_executable()
    is_in_home = check_executable(executable, root)
    companions = [kind for kind in COMPANIONS if vars(args)[kind]]
    for kind in companions:
        _, module, library = COMPANIONS[kind]
        if args.executable is None and find_spec(module) is None:
            raise RunError(f"--{kind}: needs {library}: pip install 'kontronik-can-gw[{kind}]'")
    group = files.serial_group(root)
    choices = Choices(executable, is_in_home, group, args.channel, args.network, companions)
    plan = files.planned(choices, root)
    own = root / files.configuration(args.instance)
    files.check_inside(root, [*(root / file.path for file in plan), own, root / WANTS / "x"])
    for file in plan:
        say(f"{root / file.path}: {file.put(root)}")
    files.remove_obsolete(root)
    if args.network is not None:  # an active file replaces its example
        for name in files.network_files(args.channel):
            path = root / f"{name}.{files.EXAMPLE}"
            if path.exists():
                files.remove(path)
    if files.read(own) is None:
        files.write(own, example())
        say(f"{own}: new, an example")
    if args.root is None:
        reload(None if args.network is None else args.channel)
    _enable(args, own, companions)
    return 0


def _enable(args: argparse.Namespace, own: Path, companions: list[str]) -> None:
    """Enable the services, and start them with --now, if their configuration is usable."""
    unit = files.unit(args.instance)
    if problems := _not_ready(own):
        wanted = "enabled and started" if args.now else "enabled"
        then = "" if args.root else f" When it is right: sudo systemctl enable --now {unit}"
        text = [*problems, f"{unit} was not {wanted}.{then}"]
        if args.now:
            raise RunError(*text)
        for line in text:
            say(line)
        return
    _enable_unit(args, unit, "kontronik-can-gw service status")
    for kind in companions:
        unit = files.unit(args.instance, kind)
        if kind == "mqtt" and load(own).mqtt.broker is None:
            say(f"{own}: mqtt.broker is not set. {unit} was not enabled.")
        else:
            _enable_unit(args, unit, f"journalctl -u {unit}")


def _enable_unit(args: argparse.Namespace, unit: str, see: str) -> None:
    if args.root is not None:
        file = f"{unit.partition('@')[0]}@.service" if args.instance else unit
        files.link(args.root / WANTS / unit, f"/{files.UNITS}/{file}")
        say(f"{unit} is enabled")
        return
    call("systemctl", "enable", unit)
    if args.now:
        call("systemctl", "restart", unit)
        say(f"{unit} is enabled and runs. See: {see}")
    else:
        say(f"{unit} is enabled. Start it now: sudo systemctl restart {unit}")


def _not_ready(own: Path) -> list[str]:
    """Why the service must not send yet: its configuration is faulty, or the unedited example."""
    try:
        ports = {esc.port for esc in load(own).esc}
    except UserError as error:
        return list(error.problems)
    if ports & {esc.port for esc in parse(tomllib.loads(example()), "").esc}:
        return [f"{own}: is the example. Set ports, bit rate and motors first."]
    return []
