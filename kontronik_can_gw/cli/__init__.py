"""The command line: ``kontronik-can-gw COMMAND``. One module per command, which is imported only when it is given.

Exit codes: 0 done, 1 failed while running, 2 wrong usage or configuration. Data goes to standard output, messages to standard error.
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

_CLOSED_OUTPUT = 128 + signal.SIGPIPE
"""Exit code if nobody reads the output any more: a shell shows this for a program that SIGPIPE ended."""
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
    "convert": "convert recordings and CAN logs to tables or to other log formats",
    "report": "write an HTML page about a recording: summary, plots, events",
    "decode": "decode recorded UART bytes to JSON lines or CSV",
    "replay": "play a recording on a CAN bus or on pseudo terminals",
    "simulate": "simulate ESCs on pseudo terminals",
    "mqtt": "publish the ESCs' values from the bus to an MQTT broker",
    "metrics": "serve a gateway's statistics for Prometheus",
    "export": "write the core in C and the tables of a DBC, for a firmware",
    "schema": "print the JSON Schema of the configuration",
    "describe": "describe the messages, objects and errors of the gateway, with remedies",
    "completion": "print the completion script of a shell",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    try:
        return _run(list(sys.argv[1:] if argv is None else argv))
    except BrokenPipeError:  # the reader of our output has ended, as `| head` does
        discard_output()
        return _CLOSED_OUTPUT


def _run(words: list[str]) -> int:
    """Run one command. BrokenPipeError if nobody reads its output or its messages any more."""
    command = next((word for word in words if not word.startswith("-")), None)
    try:
        _prepare_streams()
        refuse_removed_options(command, words)
        args = _parsed(command, words)
        # before, while modules are loaded, Ctrl-C ends the process (see __main__)
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
            say("too few files may be open: raise ulimit -n (of a service LimitNOFILE)", command)
        elif error.filename is not None and command != "run":
            say(f"{error.filename}: {error.strerror}", command)
        else:
            raise
    except KeyboardInterrupt:
        return 130
    return RunError.exit_code


def _parsed(command: str | None, words: list[str]) -> argparse.Namespace:
    try:
        return make_parser([] if command is None else [command]).parse_args(words)
    except SystemExit:
        for stream in (
            sys.stdout,
            sys.stderr,
        ):  # a failure at the very end would be reported by Python
            stream.flush()
        raise


def discard_output() -> None:
    """Discard the buffered part of standard output and all further output, and so for messages that nobody reads."""
    _discard(sys.stdout)
    try:
        sys.stderr.flush()
    except BrokenPipeError:
        _discard(sys.stderr)


def _discard(stream: TextIO) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def say(text: str, command: str | None = None) -> None:
    """Print one line on standard error."""
    print(
        printable(f"kontronik-can-gw{'' if command is None else f' {command}'}: {text}"),
        file=sys.stderr,
    )


def show(text: str = "") -> None:
    """Print one line on standard output, made printable."""
    print(printable(text))


def make_parser(complete: Collection[str] = tuple(COMMANDS)) -> argparse.ArgumentParser:
    """The parser of the program. Only commands in ``complete`` get their options; a run needs only those of one command."""
    parser = Parser(
        prog="kontronik-can-gw",
        description="Gateway from KONTRONIK ESC telemetry (UART) to CAN: messages of a DBC, CANopen nodes of an EDS, and "
        "DroneCAN.",
        epilog="kontronik-can-gw COMMAND --help describes a command.",
        allow_abbrev=False,
    )
    parser.add_argument("-V", "--version", action="version", version=f"%(prog)s {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, line in COMMANDS.items():
        text = line[0].upper() + line[1:] + "."
        sub = commands.add_parser(name, help=line, description=text, allow_abbrev=False)
        if name in complete:
            _complete(sub, import_module(f"kontronik_can_gw.cli.{name}"))
    return parser


def _complete(parser: argparse.ArgumentParser, module: ModuleType) -> None:
    """Declare what a command's module has: OPTIONS, EPILOG, ``main``, and ACTIONS (each a line and its options) if there are any."""
    add_options(parser, module.OPTIONS)
    parser.epilog = module.EPILOG
    if "\n" in module.EPILOG:
        parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.set_defaults(main=module.main)
    if actions := getattr(module, "ACTIONS", None):
        subs = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
        for name, (line, options) in actions.items():
            text = line[0].upper() + line[1:] + "."
            sub = subs.add_parser(name, help=line, description=text, allow_abbrev=False)
            add_options(sub, options)


class _Plain(logging.Formatter):
    """Formats log records of libraries without a handler of their own; made printable, since they quote files."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(f"kontronik-can-gw: {record.getMessage()}")


def _prepare_streams() -> None:
    """Make the three standard streams safe to use, and allow as many open files as can be.

    A closed one is replaced: if a serial port got its number, messages would be sent to an ESC.
    """
    with suppress(ValueError, OSError):
        _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(_Plain())
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:  # closed: no serial port may get this number, see below
            os.open(os.devnull, os.O_RDWR)
    for name in ("stdout", "stderr"):  # messages must not go to standard output instead
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open("w"))  # noqa: SIM115  for the whole run
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without "µ" gets a "?"
