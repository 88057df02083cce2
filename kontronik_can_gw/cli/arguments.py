"""Declares options of commands as rows of a table, and defines options of several commands."""

import argparse
import tomllib
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from kontronik_can_gw.errors import UserError, did_you_mean
from kontronik_can_gw.printable import printable

REMOVED_OPTIONS: dict[tuple[str, str], str] = {}
"""The replacement of each removed option, by command and option."""
_removed_text = Path(__file__).with_name("removed_options.toml").read_text(encoding="ascii")
for _command, _rows in tomllib.loads(_removed_text).items():
    for _removed, _advice in _rows.items():
        REMOVED_OPTIONS[_command, _removed] = _advice


class Parser(argparse.ArgumentParser):
    """The parser of one command.

    For a mistake it prints one line, and suggests the closest option.
    """

    def error(self, message: str) -> NoReturn:
        """Exit with a line that says how to get the help."""
        sentence = message if message.endswith((".", "?")) else f"{message}."
        self.exit(2, printable(f"{self.prog}: {sentence} Help: {self.prog} --help") + "\n")

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse arguments. Exits with an error if an option does not exist.

        So the returned list of remaining words is always empty.
        """
        unknown = self._unknown_options(args or ())
        if unknown:
            self._refuse(unknown)
        found, rest = super().parse_known_args(args, namespace)
        for action in self._actions:
            # argparse treats an optional argument as missing if it follows an option
            is_text = not action.option_strings and action.type is None
            is_missing = is_text and action.nargs == "?" and getattr(found, action.dest) is None
            if is_missing and rest and (rest[0] == "-" or not rest[0].startswith("-")):
                setattr(found, action.dest, rest.pop(0))
        if rest:
            self._refuse(rest)
        return found, rest

    def _unknown_options(self, args: Sequence[str]) -> list[str]:
        """Return the long options that do not exist.

        argparse often reports only missing arguments in this case.
        """
        has_commands = any(isinstance(one, argparse._SubParsersAction) for one in self._actions)
        unknown = []
        for word in args:
            if word == "--" or (has_commands and not word.startswith("-")):
                break  # the options of a command are checked by its own parser
            name = word.partition("=")[0]
            if name.startswith("--") and name not in self._option_string_actions:
                unknown.append(word)
        return unknown

    def _refuse(self, words: Sequence[str]) -> None:
        """Exit with an error that lists the unknown words."""
        known = [name[2:] for name in self._option_string_actions if name.startswith("--")]
        # names are compared without their dashes, which would make any two of them similar
        name = words[0].partition("=")[0].lstrip("-")
        near = did_you_mean(name, known, show="--{}".format)
        text = f"unrecognized arguments: {' '.join(words)}"
        if near:
            text += f".{near}"
        self.error(text)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            near = did_you_mean(str(value).lower(), map(str, action.choices), or_known=True)
            raise argparse.ArgumentError(action, f"{value!r} is unknown.{near}")


class Option(NamedTuple):
    """An option or argument with its parameters for ``add_argument``."""

    names: Sequence[str]
    settings: dict[str, Any]


Rows = Sequence["Option | str | Rows"]
"""Options of a command.

A text is the title of the group of options after it. Of the rows in an inner sequence only one may
be given.
"""


def option(typed: str, text: str, **settings: Any) -> Option:
    """Return an option by its spelling, with ``text`` as its help.

    Examples are the option "-c --config FILE", the switch "--json", and the argument "FILE".
    """
    *names, last = typed.split()
    if last.startswith("-"):
        names.append(last)
        if "choices" not in settings:
            settings["action"] = "store_true"
    else:
        settings["metavar"] = last
        names = names or [settings.pop("dest", last.lower())]
    return Option(names, {"help": text, **settings})


def add_options(parser: "argparse._ActionsContainer", rows: Rows) -> None:
    """Add options to a parser."""
    group = parser
    for row in rows:
        if isinstance(row, str):
            group = parser.add_argument_group(row)
        elif isinstance(row, Option):
            group.add_argument(*row.names, **row.settings)
        else:
            add_options(parser.add_mutually_exclusive_group(), row)


def number_from(
    low: float,
    high: float,
    what: str = "number of seconds",
    *,
    kind: Callable[[str], float] = float,
) -> Callable[[str], float]:
    """Return a type for argparse: a number within a range. ``kind``: ``int`` for whole numbers."""

    def read(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not a {what} from {low:g} to {high:g}")
        return value

    return read


class _Named(argparse.Action):
    """Stores the configuration that is given without -c.

    If there is none, the configuration given with -c is kept.
    """

    def __call__(self, _parser: object, namespace: object, values: Any, _: object = None) -> None:
        if values is not None:
            setattr(namespace, self.dest, values)


CONFIG_PLACES = (Path("gateway.toml"), Path("/etc/kontronik-can-gw/gateway.toml"))
"""The places of the default configuration, in the order in which they are tried."""
_DEFAULTS = " or ".join(map(str, CONFIG_PLACES))
_NONE_EXISTS = f"neither {' nor '.join(map(str, CONFIG_PLACES))} exists"
CONFIG = (
    option("-c --config FILE", f"TOML configuration (default: {_DEFAULTS})", type=Path),
    option("config FILE", "TOML configuration, as with -c", type=Path, nargs="?", action=_Named),
)
JSON = option("--json", "one JSON document on standard output")
FORCE = option("--force", "replace the output file if it exists")
OUTPUT: "Rows" = (
    option("-o --output FILE", "file to write (default: standard output)", default="-"),
    FORCE,
)
LAYOUT = (
    option("-c --config FILE", "TOML configuration of the gateway that sent the frames", type=Path),
    option(
        "--dbc FILE",
        "DBC of the frames (default on a live bus: the DBC of gateway.toml; "
        "otherwise the shipped one)",
        type=Path,
    ),
)
LOG_CHANNEL = option(
    "--channel NAME",
    "channel of a CAN log, for example can0 or 1 (default: the only one with messages of the DBC)",
)


def config_file(given: Path | None) -> Path:
    """Return the given configuration, or the first of CONFIG_PLACES that exists.

    Raises UserError if there is none.
    """
    found = given or default_config()
    if found is None:
        raise UserError(
            f"no configuration: {_NONE_EXISTS}. "
            "Give one with -c FILE, or write an example with kontronik-can-gw init."
        )
    return found


def default_config() -> Path | None:
    """Return the first of CONFIG_PLACES that exists.

    A broken link counts as existing, and so does a file in an inaccessible folder.
    """
    for place in CONFIG_PLACES:
        try:
            place.lstat()
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError:
            pass  # reading it will raise an error with the reason
        return place
    return None


def refuse_removed_options(command: str | None, words: Sequence[str]) -> None:
    """Raise UserError with the replacement if the command line has a removed option or action.

    An action is the word after the command.
    """
    parts: list[str] = []
    for word in words:
        if word == "--":
            break
        parts += word.split("=", 1) if word.startswith("--") else [word]
    before = ""
    for part, value in pairwise([*parts, ""]):
        is_action = before == command
        before = part
        if not part.startswith("-") and not is_action:
            continue  # the value of an option
        for removed in (part, f"{part} {value}"):
            advice = REMOVED_OPTIONS.get((command or "", removed))
            if advice is not None:
                raise UserError(f"{removed}: was removed. {advice}")
