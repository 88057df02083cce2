"""``service``: installs the gateway as a systemd service, shows its state, removes it.

Without --root it works on this machine, as root, and calls systemd's tools; with it only files below that folder are changed.
"""

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

from kontronik_can_gw.cli import service_files as files
from kontronik_can_gw.cli.arguments import number_from
from kontronik_can_gw.cli.common import say
from kontronik_can_gw.cli.service_files import NAME, WANTS, Choices, State
from kontronik_can_gw.cli.service_machine import (
    call,
    check_executable,
    check_rights,
    make_lock_folder,
    make_user,
    own_executable,
    reload_devices,
    reload_network,
)
from kontronik_can_gw.cli.service_removal import uninstall
from kontronik_can_gw.cli.service_status import status
from kontronik_can_gw.config.parse import load
from kontronik_can_gw.errors import RunError, UserError

_INSTANCE = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,31}")
_CHANNEL = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,14}")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "install and uninstall need root, except with --root or --dry-run, and print what they do. "
        "Exit code: 0 done, 1 something failed, 2 wrong usage; of status 0 running, 3 not running."
    )
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    install_parser = actions.add_parser(
        "install", help="write units, udev rules, user and an example configuration; enable"
    )
    status_parser = actions.add_parser(
        "status", help="state, configuration and last log lines; exit code 0 running, 3 not"
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
        sub.add_argument(
            "--dry-run", "--print", action="store_true", help="only show what would be done"
        )
    install_parser.add_argument("--now", action="store_true", help="start it too, or restart it")
    install_parser.add_argument(
        "--executable", metavar="PATH", help="the program (default: this one)"
    )
    install_parser.add_argument(
        "--force",
        action="store_true",
        help="replace files that were changed by hand; they are kept as .bak",
    )
    install_parser.add_argument(
        "--network",
        type=_bitrate,
        metavar="BITRATE",
        help="let systemd-networkd set up the CAN interface",
    )
    install_parser.add_argument(
        "--channel",
        type=_channel,
        default="can0",
        metavar="NAME",
        help="the CAN interface (default can0)",
    )
    install_parser.add_argument(
        "--prometheus",
        action="store_true",
        help="allow the service loopback IP, for statistics.prometheus",
    )
    install_parser.add_argument(
        "--mqtt",
        action="store_true",
        help="a second service that publishes to the broker of the table [mqtt]",
    )
    uninstall_parser.add_argument(
        "--purge",
        action="store_true",
        help="remove configurations, stored parameters and the user too",
    )
    status_parser.add_argument(
        "-n", "--lines", type=_lines, default=10, metavar="N", help="lines of the log (default 10)"
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
    if not args.dry_run:
        check_rights(live, root, "install")
    executable = args.executable or own_executable()
    choices = Choices(
        executable,
        check_executable(executable, root),
        files.serial_group(root),
        args.channel,
        args.network,
        args.prometheus,
        args.mqtt,
    )
    plan = [(file, file.state(root)) for file in files.planned(choices, root)]
    own = root / files.configuration(args.instance)
    files.check_inside(root, [*(root / file.path for file, _ in plan), own, root / WANTS / "x"])
    if args.dry_run:
        return _show(plan, root, args)
    changed = [root / file.path for file, state in plan if state is State.CHANGED]
    if changed and not args.force:
        raise UserError(
            *(
                f"{path}: was changed by hand. --force replaces it and keeps it as {path.name}.bak."
                for path in changed
            )
        )
    for file, state in plan:
        path = root / file.path
        if state is State.CHANGED:
            files.put_aside(path)
        if state is not State.SAME:
            files.write(path, file.text)
        say(f"{path}: {state.value}")
    if args.network is not None:
        _remove_examples(root, args.channel)
    if files.read(own) is None:
        files.write(own, _example())
        say(f"{own}: new, an example")
    if live:
        make_user(choices.group)
        make_lock_folder()
        call("systemctl", "daemon-reload")
        reload_devices()
        if args.network is not None:
            reload_network(args.channel)
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
        unit = files.mqtt_unit(args.instance)
        if load(own).mqtt.broker is None:
            say(f"{own}: mqtt.broker is not set. {unit} was not enabled.")
        else:
            _enable_unit(args, unit, live, root, f"See: journalctl -u {unit}")
    return 0


def _enable_unit(args: argparse.Namespace, unit: str, live: bool, root: Path, then: str) -> None:
    if not live:
        link = root / WANTS / unit
        template = f"{unit.partition('@')[0]}@.service"
        target = f"/{files.UNITS}/{unit if args.instance is None else template}"
        try:
            link.parent.mkdir(parents=True, exist_ok=True)
            link.unlink(missing_ok=True)
            link.symlink_to(target)
        except OSError as error:
            raise RunError(f"{link}: cannot be made: {error.strerror}") from None
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


def _show(
    plan: Sequence[tuple[files.PlannedFile, State]], root: Path, args: argparse.Namespace
) -> int:
    for file, state in plan:
        print(f"##### {root / file.path}: {state.value}")
        print(file.text)
    own = root / files.configuration(args.instance)
    print(f"##### {own}: {'new, an example' if files.read(own) is None else 'kept'}")
    if args.root is None:
        print(
            f"##### user {NAME}; systemctl daemon-reload; systemctl enable {files.unit(args.instance)}",
            end="",
        )
        print(f"; systemctl restart {files.unit(args.instance)}" if args.now else "")
    return 0


def _example() -> str:
    return (Path(__file__).parent.parent / "example.toml").read_text(encoding="utf-8")


def _remove_examples(root: Path, channel: str) -> None:
    """Remove the examples that active network files replace."""
    for path in files.installed(root):
        if path.name.endswith(f"-{channel}.network.{files.EXAMPLE}") or path.name.endswith(
            f"-{channel}.link.{files.EXAMPLE}"
        ):
            files.remove(path)
