"""Feeds changed DBC text to both cores, which must agree:  fuzz_dbc.py TEXTS SEED CORE

Coverage does not guide the random changes, because libFuzzer cannot measure it in Python. A DBC is
refused by a UserError, or by NotInCore of the C core. Any other exception is a fault for the seed
that was printed last, and so is a text that takes five minutes.
"""

import faulthandler
import logging
import random
import re
import sys
from pathlib import Path
from typing import Any

import equality

from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.dbc.reader import parse_database
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.native.binding import load
from kontronik_can_gw.native.rows import NotInCore

STEPS = 40
LIMIT_S = 300
NUMBERS = (
    "0",
    "1",
    "-1",
    "2",
    "7",
    "8",
    "9",
    "15",
    "16",
    "31",
    "32",
    "33",
    "62",
    "63",
    "64",
    "65",
    "255",
    "256",
    "511",
    "512",
    "65535",
    "65536",
    "2147483647",
    "2147483648",
    "4294967295",
    "9223372036854775807",
    "-9223372036854775808",
    "18446744073709551615",
    "0.1",
    "-0.5",
    "1e-9",
    "1e9",
    "1e18",
    "1e300",
    "0.00592884289493769",
    "1e-320",
    "nan",
    "inf",
)
HERE = Path(__file__).parents[1]
PATHS = shipped("dbc/kontronik_esc.dbc"), HERE / "dbc/rich.dbc", HERE / "benchmarks/five.dbc"
FILES = [path.read_text(encoding="latin-1") for path in PATHS]


def changed(chance: random.Random, text: str) -> str:
    """Change a number, a line, a sign, a byte order or a character of the text."""
    for _ in range(chance.choice((1, 1, 2, 3, 8))):
        what = chance.random()
        if what < 0.6:
            found = list(re.finditer(r"(?<![A-Za-z_\d])-?\d+(\.\d+)?", text))
            one = chance.choice(found)
            text = text[: one.start()] + chance.choice(NUMBERS) + text[one.end() :]
        elif what < 0.85:
            lines = text.split("\n")
            at = chance.randrange(len(lines))
            to = chance.randrange(len(lines))
            line = lines[at] if chance.random() < 0.5 else lines.pop(at)
            lines.insert(to, line)
            text = "\n".join(lines)
        elif what < 0.95:
            found = list(re.finditer(r"@[01][+-]", text))
            if found:
                one = chance.choice(found)
                new = chance.choice(("@0+", "@0-", "@1+", "@1-"))
                text = text[: one.start()] + new + text[one.end() :]
        else:
            at = chance.randrange(len(text))
            text = text[:at] + chr(chance.randrange(256)) + text[at + 1 :]
    return text


def one(library: Any, seed: int) -> int:
    """Return the number of compared frames, or 0 if a core refuses the DBC."""
    chance = random.Random(seed)
    escs = equality.some_escs(chance)
    chosen = DbcConfig()
    if chance.random() < 0.7:
        text, chosen = equality.dbc(chance, escs)
    else:
        text = chance.choice(FILES)
    text = changed(chance, text)
    try:
        database = parse_database(text.encode("latin-1", "ignore"), "x.dbc")
        layout = prepare(database, "x.dbc", escs, chosen, is_fd_allowed=True)
        both = equality.Both(library, chance, escs, layout)
    except (UserError, NotInCore):
        return 0
    return both.run(STEPS)


def main(texts: str, first: str, core: str) -> None:
    logging.disable()
    library = load(Path(core))
    found: list[int] = []
    for seed in range(int(first), int(first) + int(texts)):
        print(f"seed {seed}", flush=True)  # a sanitizer ends the process
        faulthandler.dump_traceback_later(LIMIT_S, exit=True)
        found.append(one(library, seed))
    print(f"{found.count(0)} of {len(found)} refused, {sum(found)} frames compared")
    assert 0 < found.count(0) < len(found)


if __name__ == "__main__":
    main(*sys.argv[1:])
