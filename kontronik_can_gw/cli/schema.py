"""``schema``: prints the JSON Schema of the configuration, for editors."""

import argparse
import json

from kontronik_can_gw.config.export import schema

OPTIONS = ()
EPILOG = "Editors with TOML support (taplo, Even Better TOML) check and complete gateway.toml with it. Exit code: 0."


def main(_args: argparse.Namespace) -> int:
    print(json.dumps(schema(), indent=2))
    return 0
