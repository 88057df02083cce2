"""Proves the DBC of a configuration: ``make prove ARGS='-c gateway.toml'``.

Exit codes: 0 every signal is proven; 1 the proof or its output failed; 2 the configuration cannot
be used; 3 nothing is refuted, but not every signal is proven; 4 a signal or message is refuted;
141 the reader of the output has ended. docs/your-own-dbc.md explains the output.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from kontronik_can_gw import __version__
from kontronik_can_gw.assembly.assemble import Loaded, load_configuration
from kontronik_can_gw.cli import CLOSED_OUTPUT, discard_output
from kontronik_can_gw.dbc.reader import listed
from kontronik_can_gw.errors import RunError, UserError

if TYPE_CHECKING:
    from dbc_proof.proof import Findings

NOT_PROVEN = 3
REFUTED = 4
"""Not 1, because Python ends with 1 after any exception."""


def main(words: Sequence[str]) -> int:
    """Prove the DBC of a configuration and return the exit code."""
    try:
        code = prove(words)
        sys.stdout.flush()
        return code
    except UserError as error:
        for problem in error.problems:
            print(f"make prove: {problem}", file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:
        discard_output()
        return CLOSED_OUTPUT
    except OSError as error:
        discard_output()
        where = error.filename or "standard output"
        print(f"make prove: {where}: {error.strerror}", file=sys.stderr)
        return RunError.exit_code


def prove(words: Sequence[str]) -> int:
    """Prove the DBC and print the findings. Return the exit code.

    Raises UserError if nothing can be proven, and OSError if the output cannot be written.
    """
    parser = argparse.ArgumentParser(
        prog="make prove ARGS=",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("-c", required=True, type=Path, metavar="FILE", help="the configuration")
    parser.add_argument("-v", action="store_true", help="also print the names of proven signals")
    parser.add_argument("--json", action="store_true", help="print a JSON document")
    args = parser.parse_args(words)
    loaded = load_configuration(args.c)
    findings = proof_of(loaded)
    if args.json:
        print(json.dumps(asdict(findings), indent=2))
    else:
        for line in result_lines(args.c, loaded, findings, args.v):
            print(line)
    if findings.refuted:
        return REFUTED
    return NOT_PROVEN if findings.unproven else 0


def proof_of(loaded: Loaded) -> "Findings":
    """Prove the DBC of a configuration. Raises UserError if no DBC is sent or z3 is missing."""
    if loaded.database is None:
        raise UserError(
            f"{loaded.config.file}: dbc.enabled is false, so there is nothing to prove. "
            "Set it to true."
        )
    try:
        from dbc_proof.proof import Proof  # imports z3
    except ImportError as error:
        raise RunError(f"{error.name}: {error}. Install it: tests/bootstrap.sh prove") from None
    config = loaded.config
    quiet_after_ns = config.can.quiet_after_ns
    proof = Proof(loaded.database, loaded.layout, loaded.escs, config.dbc, quiet_after_ns)
    for name in proof.messages():
        if sys.stderr.isatty():
            print(f"\r\x1b[K{name}", end="", file=sys.stderr)
    if sys.stderr.isatty():
        print("\r\x1b[K", end="", file=sys.stderr)
    return proof.findings


def result_lines(path: Path, loaded: Loaded, findings: "Findings", is_long: bool) -> Iterator[str]:
    """Yield the results of a proof. ``is_long``: with the names of all proven signals."""
    proven = len(findings.proven)
    total = proven + len(findings.unproven) + len(findings.refuted_signals)
    core = "both cores"
    if findings.only_python:
        core = f"the core in Python, because the core in C cannot run: {findings.only_python}"
    yield f"{path}: layout {loaded.layout.fingerprint} of version {__version__}"
    yield f"  proof     {proven} of {total} signals proven for all values and settings"
    yield f"            {core}"
    for text in findings.refuted:
        yield f"  REFUTED   {text}"
    for text in findings.unproven:
        yield f"  not proven: {text}"
    if findings.without_code:
        names = listed(findings.without_code, len(findings.without_code) if is_long else 3)
        yield f'  no code for "not available", which is sent as a value: {names}'
    if is_long:
        for name in findings.proven:
            yield f"  proven    {name}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
