"""``init``: writes the commented example configuration."""

import argparse
import sys
from pathlib import Path

from kontronik_can_gw.cli.arguments import option
from kontronik_can_gw.cli.common import say
from kontronik_can_gw.errors import RunError, UserError

# fmt: off
OPTIONS = (
    option("FILE", "where to (default gateway.toml; - for standard output)", nargs="?", default="gateway.toml"),
    option("--force", "replace a file that exists"),
)
# fmt: on
EPILOG = "Exit code: 0 written, 1 it cannot be written, 2 the file exists, or wrong usage."


def example() -> str:
    """The example configuration."""
    return (Path(__file__).parent.parent / "example.toml").read_text(encoding="utf-8")


def main(args: argparse.Namespace) -> int:
    if args.file == "-":
        sys.stdout.write(example())
        return 0
    try:
        with Path(args.file).open("w" if args.force else "x", encoding="utf-8") as file:
            file.write(example())
    except FileExistsError:
        raise UserError(
            f"{args.file}: exists. Give another name, or --force to replace it."
        ) from None
    except OSError as error:
        raise RunError(f"{args.file}: cannot be written: {error.strerror}") from None
    say(f"{args.file} written. Edit it, then: kontronik-can-gw check -c {args.file}")
    return 0
