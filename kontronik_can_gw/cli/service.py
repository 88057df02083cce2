"""``service``: installs the gateway as a systemd service, shows its state, removes it.

Without --root it works on this machine, as root, and calls systemd's tools; with it only files below that folder are changed.
"""

import argparse
import re
from pathlib import Path

from kontronik_can_gw.cli import service_files as files
from kontronik_can_gw.cli.arguments import number_from
from kontronik_can_gw.cli.common import say
from kontronik_can_gw.cli.service_files import NAME, WANTS, Choices
from kontronik_can_gw.cli.service_machine import (
    call,
    check_executable,
    check_rights,
    own_executable,
    reload,
)
from kontronik_can_gw.cli.service_removal import uninstall
from kontronik_can_gw.cli.service_status import status
from kontronik_can_gw.config.parse import load
from kontronik_can_gw.errors import RunError, UserError

_INSTANCE = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,31}")
_CHANNEL = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,14}")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "install and uninstall need root, except with --root, and print what they do. "
        "Exit code: 0 done, 1 something failed, 2 wrong usage; of status 0 running, 3 not running."
    )
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    install_parser = actions.add_parser(
        "install", help="write units, udev rules, user and an example configuration; enable"
    )
    status_parser = actions.add_parser(
        "status", help="state and last log lines of the services in use; exit code 0 running, 3 not"
    )
    uninstall_parser = actions.add_parser(
        "uninstall", help="stop, disable, and remove what install wrote"
    )
    for sub in (install_parser, status_parser, uninstall_parser):
        sub.add_argument(
            "--instance",
            type=_instance,
            metavar="NAME",
            help="one of several gateways: NAME.toml, kontronik-can-gw@NAME",
        )
    for sub in (install_parser, uninstall_parser):
        sub.add_argument(
            "--root",
            type=Path,
            metavar="DIR",
            help="only write below DIR, as for a disk image; call no tools",
        )
    _add_install_options(install_parser)
    uninstall_parser.add_argument(
        "--purge",
        action="store_true",
        help="remove configurations, stored parameters and the user too",
    )
    status_parser.add_argument(
        "-n", "--lines", type=_lines, default=10, metavar="N", help="lines of the log (default 10)"
    )


def _add_install_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--now", action="store_true", help="start it too, or restart it")
    parser.add_argument("--executable", metavar="PATH", help="the program (default: this one)")
    parser.add_argument(
        "--network",
        type=_bitrate,
        metavar="BITRATE",
        help="let systemd-networkd set up the CAN interface",
    )
    parser.add_argument(
        "--channel",
        type=_channel,
        default="can0",
        metavar="NAME",
        help="the CAN interface (default can0)",
    )
    parser.add_argument(
        "--mqtt",
        action="store_true",
        help="a second service that publishes to the broker of the table [mqtt]",
    )
    parser.add_argument(
        "--metrics",
        action="store_true",
        help="a service that serves the statistics for Prometheus on 127.0.0.1:9123",
    )


def main(args: argparse.Namespace) -> int:
    actions = {"install": _install, "status": status, "uninstall": uninstall}
    return actions[args.action](args)


def _instance(text: str) -> str:
    if not _INSTANCE.fullmatch(text) or text == "gateway":
        reason = (
            "is the plain service's configuration"
            if text == "gateway"
            else "is no name: letters, digits, _ . -"
        )
        raise argparse.ArgumentTypeError(f"{text!r} {reason}")
    return text


def _channel(text: str) -> str:
    if not _CHANNEL.fullmatch(text):
        raise argparse.ArgumentTypeError(f"{text!r} is not the name of an interface")
    return text


_bitrate = number_from(
    5_000, 1_000_000, kind=int, problem="is not a bit rate in bit/s, 5000 to 1000000"
)
_lines = number_from(0, 10_000, "number of lines", kind=int)


def _install(args: argparse.Namespace) -> int:
    live = args.root is None
    root = Path("/") if live else args.root
    check_rights(live, root, "install")
    executable = args.executable or own_executable()
    choices = Choices(
        executable,
        check_executable(executable, root),
        files.serial_group(root),
        args.channel,
        args.network,
        args.mqtt,
        args.metrics,
    )
    plan = files.planned(choices, root)
    own = root / files.configuration(args.instance)
    files.check_inside(root, [*(root / file.path for file in plan), own, root / WANTS / "x"])
    for file in plan:
        say(f"{root / file.path}: {file.put(root)}")
    files.remove_obsolete(root)
    if args.network is not None:
        for kind in ("network", "link"):  # an active file replaces its example
            path = root / files.NETWORK / f"50-{NAME}-{args.channel}.{kind}.{files.EXAMPLE}"
            if path.exists():
                files.remove(path)
    if files.read(own) is None:
        files.write(own, _example())
        say(f"{own}: new, an example")
    if live:
        reload(None if args.network is None else args.channel)
    return _enable(args, own, live, root)


def _enable(args: argparse.Namespace, own: Path, live: bool, root: Path) -> int:
    """Enable the service, and start it with --now, if its configuration is usable."""
    unit = files.unit(args.instance)
    if problems := _not_ready(own):
        then = f" When it is right: sudo systemctl enable --now {unit}" if live else ""
        text = [
            *problems,
            f"{unit} was not {'enabled and started' if args.now else 'enabled'}.{then}",
        ]
        if args.now:
            raise RunError(*text)
        for line in text:
            say(line)
        return 0
    _enable_unit(args, unit, live, root, "See: kontronik-can-gw service status")
    if args.mqtt:
        unit = files.companion("mqtt", args.instance)
        if load(own).mqtt.broker is None:
            say(f"{own}: mqtt.broker is not set. {unit} was not enabled.")
        else:
            _enable_unit(args, unit, live, root, f"See: journalctl -u {unit}")
    if args.metrics:
        unit = files.companion("metrics", args.instance)
        _enable_unit(args, unit, live, root, f"See: journalctl -u {unit}")
    return 0


def _enable_unit(args: argparse.Namespace, unit: str, live: bool, root: Path, then: str) -> None:
    if not live:
        template = f"{unit.partition('@')[0]}@.service"
        files.link(
            root / WANTS / unit, f"/{files.UNITS}/{unit if args.instance is None else template}"
        )
        say(f"{unit} is enabled")
        return
    call("systemctl", "enable", unit)
    if args.now:
        call("systemctl", "restart", unit)
        say(f"{unit} is enabled and runs. {then}")
    else:
        say(f"{unit} is enabled. Start it now: sudo systemctl restart {unit}")


def _not_ready(own: Path) -> list[str]:
    """Why the service must not send yet: its configuration is faulty, or the unedited example."""
    import tomllib

    from kontronik_can_gw.config.parse import parse

    try:
        ports = {esc.port for esc in load(own).esc}
    except UserError as error:
        return list(error.problems)
    if ports & {esc.port for esc in parse(tomllib.loads(_example()), "").esc}:
        return [f"{own}: is the example. Set ports, bit rate and motors first."]
    return []


def _example() -> str:
    return (Path(__file__).parent.parent / "example.toml").read_text(encoding="utf-8")
