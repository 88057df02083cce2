"""The manual page, man(7) macros only, so that groff and mandoc both read it. Commands and options come from the parser."""

import argparse
import re
import textwrap
from collections.abc import Iterable, Iterator

from kontronik_can_gw import __version__
from kontronik_can_gw.cli import COMMANDS, make_parser
from kontronik_can_gw.cli.service_files import CONFIGURATIONS, NAME, UNITS
from kontronik_can_gw.runtime.locks import SYSTEM_FOLDER

_DESCRIPTION = (
    (
        "KONTRONIK motor controllers (ESCs) stream telemetry over a UART: speed, voltages, currents, temperatures, errors, states. This "
        "program runs on a small Linux board between one or more ESCs and a CAN bus. It puts every value on the bus as plain CAN frames, "
        "described by a DBC file, and as a CANopen node for each ESC, described by an EDS; each alone or both at once."
    ),
    "Every value on the bus is true and fresh, or marked as not available. Nothing is ever transmitted to the ESC.",
    "Data goes to standard output, talk to standard error.",
)
_EXIT_CODES = (
    ("0", "done"),
    ("1", "failed while running: a port, an interface, a file"),
    ("2", "wrong usage or configuration"),
    ("3", "of status and service status: the gateway does not run"),
    ("130", "ended by Ctrl-C"),
)
_FILES = (
    (f"/{CONFIGURATIONS}/gateway.toml", "configuration of the service; NAME.toml of a further one"),
    (f"/{UNITS}/{NAME}.service", "the service; NAME as in kontronik-can-gw@NAME for a further one"),
    (f"/var/lib/{NAME}", "parameters that CANopen masters stored, of a gateway that runs as root or as the service"),
    (f"~/.local/state/{NAME}", "the same, of a gateway that another user runs"),
    (str(SYSTEM_FOLDER), "locks by which gateways keep each other from the same node-IDs and messages"),
    (f"/run/{NAME}/status.json", "how the service is, for kontronik-can-gw status"),
)
_ENVIRONMENT = (
    ("STATE_DIRECTORY", "where parameters are kept; systemd sets it for the service"),
    ("XDG_STATE_HOME", "where parameters are kept without a service, instead of ~/.local/state"),
    ("XDG_RUNTIME_DIR", "where gateways of a user who is not the service lock node-IDs, instead of /tmp"),
    ("RUNTIME_DIRECTORY", "where status.json is written; systemd sets it for the service"),
    ("NOTIFY_SOCKET, WATCHDOG_USEC, WATCHDOG_PID", "systemd is told when the gateway is ready, and that it works"),
    ("JOURNAL_STREAM", "log lines get the priorities that the journal reads"),
    ("COLUMNS, NO_COLOR", "width and colour of what is shown on a terminal"),
)
_SIGNALS = (
    ("SIGTERM, SIGINT", "end; run, simulate and the live displays put everything in order first"),
    ("SIGHUP", "run reads its configuration again; a faulty one is refused and the old one stays"),
)
_EXAMPLES = (
    "kontronik-can-gw init gateway.toml",
    "kontronik-can-gw check -c gateway.toml",
    "kontronik-can-gw run -c gateway.toml",
    "kontronik-can-gw describe -c gateway.toml --format html -o gateway.html",
)
_SEE_ALSO = "candump(1), ip(8), systemctl(1)"


def man_page() -> str:
    """The page of the whole program, for section 1."""
    return "\n".join(_lines()) + "\n"


def _lines() -> Iterator[str]:
    parser = make_parser()
    yield f'.TH {_quoted(NAME.upper())} 1 "" {_quoted(f"{NAME} {__version__}")} "User Commands"'
    yield from (".SH NAME", rf"{_escaped(NAME)} \- gateway from KONTRONIK ESC telemetry to CAN and CANopen")
    yield ".SH SYNOPSIS"
    yield from (rf".B {_escaped(NAME)}", r"\fICOMMAND\fR [\fIOPTION\fR ...]", ".br")
    yield from (rf".B {_escaped(NAME)}", r"\fICOMMAND\fR \-\-help", ".br")
    yield from (rf".B {_escaped(NAME)}", r"\-\-version")
    yield ".SH DESCRIPTION"
    yield ".PP\n".join(f"{_flowing(text)}\n" for text in _DESCRIPTION).strip()
    yield ".SH COMMANDS"
    yield from _items(COMMANDS.items())
    yield ".SH OPTIONS OF THE COMMANDS"
    yield from _commands(parser, "")
    for title, items in (
        ("EXIT STATUS", _EXIT_CODES),
        ("FILES", _FILES),
        ("ENVIRONMENT", _ENVIRONMENT),
        ("SIGNALS", _SIGNALS),
    ):
        yield f".SH {title}"
        yield from _items(items)
    yield ".SH EXAMPLES"
    yield from (".nf", *map(_escaped, _EXAMPLES), ".fi")
    yield from (".SH SEE ALSO", _escaped(_SEE_ALSO))


def _commands(parser: argparse.ArgumentParser, prefix: str) -> Iterator[str]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            lines = {choice.dest: choice.help or "" for choice in action._get_subactions()}
            for name, sub in action.choices.items():
                yield from _command(sub, f"{prefix}{name}", lines[name])


def _command(parser: argparse.ArgumentParser, name: str, line: str) -> Iterator[str]:
    yield f".SS {_quoted(name)}"
    yield _flowing(f"{line[:1].upper()}{line[1:]}.")
    yield from (".PP", rf"\fB{_escaped(_usage(parser))}\fR")
    for group in parser._action_groups:
        actions = [a for a in group._group_actions if a.help != argparse.SUPPRESS and "-h" not in a.option_strings]
        actions = [a for a in actions if not isinstance(a, argparse._SubParsersAction)]
        if not actions:
            continue
        if group not in (parser._positionals, parser._optionals) and group.title:
            yield from (".PP", f"{_escaped(group.title)}:")
        for action in actions:
            yield from (".TP", _invocation(parser, action), _flowing(_help(parser, action)))
    yield from _epilog((parser.epilog or "").replace("%(prog)s", parser.prog))
    yield from _commands(parser, f"{name} ")


def _formatter(parser: argparse.ArgumentParser) -> argparse.HelpFormatter:
    return argparse.HelpFormatter(parser.prog, width=100_000)


def _usage(parser: argparse.ArgumentParser) -> str:
    formatter = _formatter(parser)
    formatter.add_usage(parser.usage, parser._actions, parser._mutually_exclusive_groups, prefix="")
    return re.sub(r"\x1b\[[0-9;]*m", "", formatter.format_help()).replace(" [-h]", "").strip()


def _help(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    return _formatter(parser)._expand_help(action) if action.help else ""


def _invocation(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    """``-c FILE, --config FILE``: options in bold, what is to be put in for them in italics."""
    formatter = _formatter(parser)
    plain = action.dest if not action.option_strings else action.dest.upper()
    values = "" if action.nargs == 0 else rf"\fI{_escaped(formatter._format_args(action, plain))}\fR"
    if not action.option_strings:
        return values
    return ", ".join(rf"\fB{_escaped(option)}\fR {values}".rstrip() for option in action.option_strings)


def _epilog(text: str) -> Iterator[str]:
    """Lines that are indented or hold columns stay as they are; others flow together, up to one that begins with a title."""
    flowing: list[str] = []
    standing: list[str] = []
    for line in [*text.splitlines(), ""]:
        if re.match(r"\s+\S", line) or re.search(r"\S {2,}\S", line):
            yield from _paragraph(flowing)
            standing.append(line)
            continue
        yield from _as_it_stands(standing)
        if not line.strip():
            yield from _paragraph(flowing)
            continue
        if re.match(r"[a-z][a-z ]*: ", line):  # as in "exit codes: ..."
            yield from _paragraph(flowing)
        flowing.append(line)


def _paragraph(lines: list[str]) -> Iterator[str]:
    if lines:
        yield from (".PP", _flowing(" ".join(lines)))
        lines.clear()


def _as_it_stands(lines: list[str]) -> Iterator[str]:
    if lines:
        yield from (".PP", ".nf", *map(_escaped, lines), ".fi")
        lines.clear()


def _items(items: Iterable[tuple[str, str]]) -> Iterator[str]:
    for name, text in items:
        yield from (".TP", rf"\fB{_escaped(name)}\fR", _flowing(text))


_LONGEST_LINE = 72
_NAMED = {"\\": r"\e", "-": r"\-", "'": r"\(aq", "`": r"\(ga", "^": r"\(ha", "~": r"\(ti", '"': r"\(dq"}


def _flowing(text: str) -> str:
    """Running text, in short lines."""
    lines = textwrap.wrap(text, _LONGEST_LINE, break_long_words=False, break_on_hyphens=False)
    return "\n".join(map(_escaped, lines))


def _escaped(text: str) -> str:
    """Text that roff shows as it is, in ASCII; no line of it can be a request."""
    shown = "".join(_NAMED.get(c) or (c if c == "\n" or " " <= c <= "~" else rf"\[u{ord(c):04X}]") for c in text)
    return re.sub(r"^(?=\.)", r"\\&", shown, flags=re.MULTILINE)


def _quoted(text: str) -> str:
    return f'"{_escaped(text)}"'
