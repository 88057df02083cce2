"""``completion``: prints a script for a shell to complete commands, options and file names.

shtab makes it from the parser.
"""

import argparse
from collections.abc import Iterator

import shtab

from kontronik_can_gw.cli import make_parser
from kontronik_can_gw.cli.arguments import OUTPUT, option
from kontronik_can_gw.cli.output import write_output
from kontronik_can_gw.desk.libraries import install_command
from kontronik_can_gw.errors import RunError

_SHELLS = ("bash", "zsh", "tcsh", "fish")
OPTIONS = (option("SHELL", ", ".join(_SHELLS), choices=_SHELLS), *OUTPUT)
EPILOG = """\
The shells look for the script in these places:

  bash  ~/.local/share/bash-completion/completions/kontronik-can-gw
  zsh   ~/.zfunc/_kontronik-can-gw, with ~/.zfunc in fpath before compinit
  tcsh  ~/.kontronik-can-gw.tcsh, with "source ~/.kontronik-can-gw.tcsh" in
        ~/.tcshrc
  fish  ~/.config/fish/completions/kontronik-can-gw.fish

examples:
  kontronik-can-gw completion zsh -o ~/.zfunc/_kontronik-can-gw
  eval "$(kontronik-can-gw completion bash)"    # for this shell only

exit codes: 0 done; 1 the installed shtab does not know this shell, or the file
cannot be written; 2 wrong usage
"""
_KINDS = {
    "FILE": shtab.FILE,
    "SOURCE": shtab.FILE,
    "PATH": shtab.FILE,
    "IN": shtab.FILE,
    "OUT": shtab.FILE,
    "DIR": shtab.DIRECTORY,
}
"""Completions of options and arguments, by the name of their value."""
_ENDINGS = {
    "config": ("*.toml",),
    "dbc": ("*.dbc", "*.DBC"),
    "from": ("*.dbc", "*.DBC"),
}
"""Endings of file names for options, by the attribute name of the option."""


def main(args: argparse.Namespace) -> int:
    """Print the script. Raises RunError if the installed shtab is too old for the shell."""
    if args.shell not in shtab.SUPPORTED_SHELLS:
        raise RunError(
            f"{args.shell}: needs a newer shtab than {shtab.__version__}. "
            f"Install it: {install_command('shtab')}"
        )
    parser = make_parser()
    for action in _actions(parser):
        complete = _KINDS.get(str(action.metavar))
        endings = _ENDINGS.get(action.dest)
        if endings:
            complete = shtab.glob(*endings)
        if complete is not None:
            action.complete = complete  # type: ignore[attr-defined]
    script = shtab.complete(parser, args.shell)
    write_output(args.output, script + "\n", force=args.force)
    return 0


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Yield all options and arguments of a parser and of its commands."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                yield from _actions(sub)
