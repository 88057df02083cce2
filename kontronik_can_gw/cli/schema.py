"""``schema``: prints the JSON Schema of the configuration, for editors."""

import argparse
import json

from kontronik_can_gw.cli.arguments import OUTPUT
from kontronik_can_gw.cli.output import write_output
from kontronik_can_gw.config.export import schema

OPTIONS = OUTPUT
EPILOG = (
    "Editors with TOML support (taplo, Even Better TOML) use it to check and complete "
    "gateway.toml. "
    "Exit codes: 0 done, 1 the file cannot be written, 2 wrong usage."
)


def main(args: argparse.Namespace) -> int:
    text = json.dumps(schema(), indent=2)
    write_output(args.output, text + "\n", force=args.force)
    return 0
