"""The command line: ``kontronik-can-gw COMMAND``.

Each command has a module, which is imported only if the command is given.

Exit codes: 0 done, 1 failed while running, 2 wrong usage or configuration, 130 ended by Ctrl-C, 141
the reader of the output has ended. Data is written to standard output, messages to standard error.
"""

import argparse
import errno
import io
import logging
import os
import resource
import signal
import sys
from collections.abc import Collection, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TextIO

from kontronik_can_gw import __version__
from kontronik_can_gw.cli.arguments import Parser, add_options, refuse_removed_options
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.printable import printable

CLOSED_OUTPUT = 128 + signal.SIGPIPE
"""Exit code if the reader of the output has closed it.

A shell shows this code for a program that SIGPIPE ended.
"""
_INTERRUPTED = 128 + signal.SIGINT
"""Exit code after Ctrl-C."""
COMMANDS = {
    "demo": "show a simulated ESC on a simulated CAN bus, no hardware needed",
    "run": "run the gateway: send ESC telemetry as DBC messages, CANopen and DroneCAN",
    "status": "show the state of the running gateways",
    "check": "check a configuration and print the messages that it sends",
    "doctor": "check machine, ports, CAN interface and configuration, and name remedies",
    "service": "install the gateway as a systemd service, or remove it",
    "init": "write a commented example configuration",
    "dbc": "write the DBC for several ESCs or for a configuration",
    "eds": "write the EDS, or the DCF of a CANopen node",
    "monitor": "show a live screen of the ESCs, from the CAN bus or a recording",
    "web": "serve a page of the ESCs for phones, and the recorded flights",
    "convert": "convert recordings and CAN logs to tables or to other log formats",
    "report": "write an HTML page about a recording: summary, plots, events",
    "decode": "decode recorded UART bytes to JSON lines or CSV",
    "replay": "play a recording on a CAN bus or on pseudo terminals",
    "simulate": "simulate ESCs on pseudo terminals",
    "mqtt": "publish the ESCs' values from the bus to an MQTT broker",
    "metrics": "serve a gateway's statistics for Prometheus",
    "export": "write the core in C and the tables of a DBC, for a firmware",
    "conformance": "test a CANopen slave on a bus against CiA 301, 305 and 306",
    "schema": "print the JSON Schema of the configuration",
    "describe": "describe the messages, objects and errors of the gateway, with remedies",
    "completion": "print the completion script of a shell",
}
FIRST_COMMANDS = ("demo", "init", "check", "doctor", "run", "status", "monitor", "convert")
"""The commands that the help of a call without a command shows."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    try:
        return _run(list(sys.argv[1:] if argv is None else argv))
    except BrokenPipeError:  # the reader of the output has ended, for example `| head`
        discard_output()
        return CLOSED_OUTPUT
    except KeyboardInterrupt:
        return _INTERRUPTED


def _run(words: list[str]) -> int:
    """Run one command.

    Raises BrokenPipeError if a reader has closed its output or messages, and KeyboardInterrupt.
    """
    command = next((word for word in words if not word.startswith("-")), None)
    try:
        _prepare_streams()
        if not words:
            print(_short_help(), file=sys.stderr)
            return UserError.exit_code
        refuse_removed_options(command, words)
        args = _parsed(command, words)
        # until here, while modules were loaded, Ctrl-C ended the process (see __main__)
        if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        code: int = args.main(args)
        sys.stdout.flush()
        return code
    except UserError as error:
        for problem in error.problems:
            say(problem, command)
        return error.exit_code
    except BrokenPipeError:
        raise
    except OSError as error:
        if error.errno == errno.ENOSPC:
            discard_output()
            say(f"standard output: cannot be written: {error.strerror}", command)
        elif error.errno in (errno.EMFILE, errno.ENFILE):
            say(
                "too many open files. Raise the limit: ulimit -n, for a service LimitNOFILE",
                command,
            )
        elif error.filename is not None and command != "run":
            say(f"{error.filename}: {error.strerror}", command)
        else:
            raise
    return RunError.exit_code


def _short_help() -> str:
    """Return the usage and the most useful commands."""
    from textwrap import fill  # only needed here

    rows = [
        fill(f"  {name:8} {COMMANDS[name]}", 80, subsequent_indent=" " * 11)
        for name in FIRST_COMMANDS
    ]
    return "\n".join(
        [
            "usage: kontronik-can-gw COMMAND ...",
            "",
            *rows,
            "",
            "kontronik-can-gw --help lists all commands.",
            "kontronik-can-gw COMMAND --help describes one.",
        ]
    )


def _parsed(command: str | None, words: list[str]) -> argparse.Namespace:
    parser = make_parser([] if command is None else [command])
    try:
        return parser.parse_args(words)
    except SystemExit:
        # if this failed when Python exits, Python would print an error
        sys.stdout.flush()
        sys.stderr.flush()
        raise


def discard_output() -> None:
    """Discard the buffered part of standard output, and all further output.

    Messages are discarded, too, if their reader has closed standard error.
    """
    _discard(sys.stdout)
    try:
        sys.stderr.flush()
    except BrokenPipeError:
        _discard(sys.stderr)


def _discard(stream: TextIO) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def say(text: str, command: str | None = None) -> None:
    """Print one line on standard error."""
    name = "kontronik-can-gw"
    if command is not None:
        name += f" {command}"
    print(printable(f"{name}: {text}"), file=sys.stderr)


def show(text: str = "") -> None:
    """Print one printable line on standard output."""
    print(printable(text))


def make_parser(complete: Collection[str] = tuple(COMMANDS)) -> argparse.ArgumentParser:
    """Return the parser of the program.

    Only the commands in ``complete`` have their options, because their modules must be imported. A
    run needs the options of one command.
    """
    parser = Parser(
        prog="kontronik-can-gw",
        description="Gateway from KONTRONIK ESC telemetry (UART) to CAN: "
        "messages of a DBC, CANopen nodes of an EDS, and DroneCAN.",
        epilog="kontronik-can-gw COMMAND --help describes a command.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "-V",
        "--version",
        action="version",
        version=f"%(prog)s {__version__}",
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, line in COMMANDS.items():
        text = line[0].upper() + line[1:] + "."
        sub = commands.add_parser(
            name,
            help=line,
            description=text,
            allow_abbrev=False,
        )
        if name in complete:
            _complete(sub, import_module(f"kontronik_can_gw.cli.{name}"))
    return parser


def _complete(parser: argparse.ArgumentParser, module: ModuleType) -> None:
    """Add the options, help and main function of a command's module to its parser.

    The module has OPTIONS, EPILOG and ``main``. It may have ACTIONS, each with a line of help and
    its options.
    """
    add_options(parser, module.OPTIONS)
    parser.epilog = module.EPILOG
    if "\n" in module.EPILOG:
        parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.set_defaults(main=module.main)
    actions = getattr(module, "ACTIONS", None)
    if actions:
        subs = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
        for name, (line, options) in actions.items():
            text = line[0].upper() + line[1:] + "."
            sub = subs.add_parser(
                name,
                help=line,
                description=text,
                allow_abbrev=False,
            )
            add_options(sub, options)


class _Plain(logging.Formatter):
    """Formats log records of libraries that have no handler.

    They are made printable, because they contain the names and contents of files.
    """

    def format(self, record: logging.LogRecord) -> str:
        return printable(f"kontronik-can-gw: {record.getMessage()}")


def _prepare_streams() -> None:
    """Make the three standard streams safe, and allow the greatest number of open files.

    A closed stream is replaced. Otherwise a serial port could get its number, and messages would be
    sent to an ESC.
    """
    with suppress(ValueError, OSError):
        _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(_Plain())
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:  # it is closed
            os.open(os.devnull, os.O_RDWR)
    for name in ("stdout", "stderr"):  # otherwise messages would be written to standard output
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open("w"))  # noqa: SIM115  for the whole run
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without "µ" shows "?"
