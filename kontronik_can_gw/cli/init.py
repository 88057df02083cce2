"""``init``: writes the commented example configuration."""

import argparse
from pathlib import Path

from kontronik_can_gw.cli.arguments import FORCE, option
from kontronik_can_gw.cli.common import say
from kontronik_can_gw.cli.output import output_of, write_output

OPTIONS = (
    option("FILE", "file to write (default: gateway.toml), or - for standard output", nargs="?"),
    option("-o --output FILE", "another way to give FILE"),
    FORCE,
)
EPILOG = "Exit codes: 0 written, 1 the file cannot be written, 2 the file exists, or wrong usage."


def example() -> str:
    """Return the example configuration."""
    return (Path(__file__).parent.parent / "example.toml").read_text(encoding="utf-8")


def main(args: argparse.Namespace) -> int:
    output = output_of(args, "FILE", "gateway.toml")
    write_output(output, example(), force=args.force)
    if output != "-":
        say(f"Edit it, then: kontronik-can-gw check -c {output}")
    return 0
