"""Options of commands as rows of a table, and what several commands share of them."""

import argparse
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from kontronik_can_gw.errors import UserError, did_you_mean

REMOVED_OPTIONS: dict[tuple[str, str], str] = {
    (command, removed): advice
    for command, rows in tomllib.loads(
        Path(__file__).with_name("removed_options.toml").read_text(encoding="ascii")
    ).items()
    for removed, advice in rows.items()
}
"""By command and option, and what to type instead."""


class Parser(argparse.ArgumentParser):
    """A parser of one command. A mistake shows the usage of this command, and what was meant."""

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse. Exits with the usage for options that do not exist, so that no word is left over."""
        if unknown := self._unknown_options(args or ()):
            self._refuse(unknown)
        found, rest = super().parse_known_args(args, namespace)
        for action in self._actions:
            # argparse takes an optional argument for missing if it comes after an option
            is_text = not action.option_strings and action.type is None
            is_missing = is_text and action.nargs == "?" and getattr(found, action.dest) is None
            if is_missing and rest and (rest[0] == "-" or not rest[0].startswith("-")):
                setattr(found, action.dest, rest.pop(0))
        if rest:
            self._refuse(rest)
        return found, rest

    def _unknown_options(self, args: Sequence[str]) -> list[str]:
        """The long options that do not exist. argparse often names only missing arguments."""
        has_commands = any(isinstance(one, argparse._SubParsersAction) for one in self._actions)
        unknown = []
        for word in args:
            if word == "--" or (has_commands and not word.startswith("-")):
                break  # the options of a command are checked by its own parser
            if word.startswith("--") and word.partition("=")[0] not in self._option_string_actions:
                unknown.append(word)
        return unknown

    def _refuse(self, words: Sequence[str]) -> None:
        """Exit with an error that names words without a meaning."""
        known = [name[2:] for name in self._option_string_actions if name.startswith("--")]
        # the dashes, which all have, would make any two names look alike
        near = did_you_mean(words[0].partition("=")[0].lstrip("-"), known, show="--{}".format)
        self.error(f"unrecognized arguments: {' '.join(words)}{near and '.'}{near}")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            near = did_you_mean(str(value).lower(), map(str, action.choices), or_known=True)
            raise argparse.ArgumentError(action, f"there is no {value!r}.{near}")


class Option(NamedTuple):
    """An option or argument, with the words for ``add_argument``."""

    names: Sequence[str]
    settings: dict[str, Any]


Rows = Sequence["Option | str | Rows"]
"""Options of a command. A text is the title of the group of those after it; of rows in a row only one may be given."""


def option(typed: str, text: str, **settings: Any) -> Option:
    """An option by what is typed, as "-c --config FILE", a switch as "--json", or an argument as "FILE"; ``text`` is its help."""
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
    """Declare options."""
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
    """An argparse type: a number within a range. ``kind``: ``int`` for whole ones."""

    def read(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not a {what}, {low:g} to {high:g}")
        return value

    return read


class _Named(argparse.Action):
    """Stores the configuration that stands without -c; where there is none, what -c has given stays."""

    def __call__(self, _parser: object, namespace: object, values: Any, _: object = None) -> None:
        if values is not None:
            setattr(namespace, self.dest, values)


CONFIG_PLACES = (Path("gateway.toml"), Path("/etc/kontronik-can-gw/gateway.toml"))
"""Where a configuration is looked for that is not named, in this order."""
_DEFAULTS = " or ".join(map(str, CONFIG_PLACES))
# fmt: off
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
    option("--dbc FILE", "DBC of the frames (default on a live bus: the DBC of gateway.toml; otherwise the shipped one)", type=Path),
)
LOG_CHANNEL = option("--channel NAME", "channel of a CAN log, for example can0 or 1 (default: the only one with messages of the DBC)")
# fmt: on


def config_file(given: Path | None) -> Path:
    """The configuration that is named, or the first of CONFIG_PLACES that exists. UserError where there is none."""
    found = given or default_config()
    if found is None:
        raise UserError(
            f"there is no {_DEFAULTS}. Name the configuration: -c FILE; kontronik-can-gw init writes an example."
        )
    return found


def default_config() -> Path | None:
    """The first of CONFIG_PLACES that is there: a link that leads nowhere, and what a closed folder hides, too."""
    for place in CONFIG_PLACES:
        try:
            place.lstat()
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError:
            pass  # reading it says why it cannot be
        return place
    return None


def refuse_removed_options(command: str | None, words: Sequence[str]) -> None:
    """UserError with the replacement where a command line has a removed option, or a removed action after the command."""
    options = words[: words.index("--")] if "--" in words else words
    parts = [
        part
        for word in options
        for part in (word.split("=", 1) if word.startswith("--") else [word])
    ]
    for before, part, value in zip(["", *parts], parts, [*parts[1:], ""], strict=False):
        if not part.startswith("-") and before != command:
            continue  # the value of an option
        for removed in (part, f"{part} {value}"):
            if (advice := REMOVED_OPTIONS.get((command or "", removed))) is not None:
                raise UserError(f"{removed}: was removed. {advice}")
