"""``init``: writes the commented example configuration."""

import argparse
import os
import sys
from pathlib import Path

from kontronik_can_gw.cli.common import say
from kontronik_can_gw.errors import RunError, UserError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "file",
        nargs="?",
        default="gateway.toml",
        metavar="FILE",
        help="where to (default gateway.toml; - for standard output)",
    )
    parser.add_argument("--force", action="store_true", help="replace a file that exists")
    parser.epilog = (
        "Exit code: 0 written, 1 it cannot be written, 2 the file exists, or wrong usage."
    )


def main(args: argparse.Namespace) -> int:
    text = (Path(__file__).parent.parent / "example.toml").read_text(encoding="utf-8")
    if args.file == "-":
        sys.stdout.write(text)
        return 0
    flags = os.O_WRONLY | os.O_CREAT | (os.O_TRUNC if args.force else os.O_EXCL)
    try:
        with os.fdopen(os.open(args.file, flags, 0o644), "w", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise UserError(
            f"{args.file}: exists. Give another name, or --force to replace it."
        ) from None
    except OSError as error:
        raise RunError(f"{args.file}: cannot be written: {error.strerror}") from None
    say(f"{args.file} written. Edit it, then: kontronik-can-gw check -c {args.file}")
    return 0
